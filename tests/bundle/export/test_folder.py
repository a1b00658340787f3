import json
from pathlib import Path

import pytest

from splatart_ns.bundle.export.folder import MANIFEST, export_folder, remove_exports
from splatart_ns.errors import InputError


def write(path, *names):
    with export_folder(path, {"of": "test"}) as folder:
        for name in names:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(name)


def test_an_export_takes_the_place_of_an_earlier_one(tmp_path):
    write(tmp_path / "out", "old.txt", "meshes/a.obj")
    write(tmp_path / "out", "new.txt")
    assert {p.name for p in (tmp_path / "out").rglob("*")} == {"new.txt", MANIFEST}
    assert json.loads((tmp_path / "out" / MANIFEST).read_text())["files"] == ["new.txt"]
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("manifest", [None, "{}", '{"format": "other", "files": ["notes.txt"]}'])
def test_files_of_others_are_not_touched(tmp_path, manifest):
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    if manifest is not None:
        (out / MANIFEST).write_text(manifest)
    with pytest.raises(InputError):
        write(out, "new.txt")
    assert (out / "notes.txt").read_text() == "mine" and not (out / "new.txt").exists()


def test_a_file_that_was_added_to_an_export_is_named(tmp_path):
    write(tmp_path / "out", "a.txt")
    (tmp_path / "out" / "mine.txt").touch()
    with pytest.raises(InputError, match="'mine.txt', which no export wrote; give another folder with --output"):
        write(tmp_path / "out", "b.txt")


def test_exports_in_a_folder_are_told_from_files_of_others(tmp_path):
    write(tmp_path / "out/glb", "a.glb")
    with pytest.raises(InputError, match="holds an export in its folder 'glb'; give another folder"):
        write(tmp_path / "out", "b.urdf")


def test_exports_are_removed_and_files_of_others_are_not(tmp_path):
    out = tmp_path / "export"
    for form in ("urdf", "glb", "damaged"):
        write(out / form, "a.txt", "meshes/a.obj")
    (out / "damaged" / MANIFEST).write_text("{")
    theirs = [out / "urdf/mine.txt", out / "notes.txt", tmp_path / "outside.txt"]
    for file in theirs:
        file.write_text("mine")
    listed = json.loads((out / "urdf" / MANIFEST).read_text())
    (out / "urdf" / MANIFEST).write_text(json.dumps({**listed, "files": ["a.txt", "../../outside.txt", "gone.txt"]}))
    remove_exports(out)
    left = {f.relative_to(tmp_path).as_posix() for f in tmp_path.rglob("*") if f.is_file()}
    damaged = {f"export/damaged/{name}" for name in ("a.txt", "meshes/a.obj", MANIFEST)}
    assert left == damaged | {f.relative_to(tmp_path).as_posix() for f in theirs} | {"export/urdf/meshes/a.obj"}
    assert not (out / "glb").exists()


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "out").touch()
    with pytest.raises(InputError, match="is a file"):
        write(tmp_path / "out", "a.txt")


def test_the_folder_that_one_is_in_is_not_replaced(tmp_path, monkeypatch):
    write(tmp_path / "out", "a.txt", "in/b.txt")
    monkeypatch.chdir(tmp_path / "out" / "in")
    with pytest.raises(InputError, match="the folder that you are in"):
        write(tmp_path / "out", "a.txt")
    assert (tmp_path / "out" / "in" / "b.txt").is_file()


def test_a_run_that_breaks_leaves_the_last_export(tmp_path):
    write(tmp_path / "out", "a.txt")
    with pytest.raises(RuntimeError), export_folder(tmp_path / "out", {}) as folder:
        (folder / "half.txt").touch()
        raise RuntimeError
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"a.txt", MANIFEST}
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_an_empty_folder_and_missing_parents_are_filled(tmp_path):
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "empty", tmp_path / "a" / "b"):
        write(path, "a.txt")
        assert (path / "a.txt").exists()


def test_a_mount_gets_the_export_in_place_of_the_one_before(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "is_mount", lambda path: path.name == "out")
    (tmp_path / "out").mkdir()
    for name in ("first", "second"):
        write(tmp_path / "out", f"meshes/{name}")
    left = {path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*")}
    assert left == {"meshes", "meshes/second", MANIFEST}
