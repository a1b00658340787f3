import errno
import json
import math
import os
from pathlib import Path

import pytest

from splatart_ns.errors import InputError
from splatart_ns.files import new_folder, replacing, replacing_all, require_writable, write_json


def test_a_block_that_ends_well_puts_the_file_in_place(tmp_path):
    path = tmp_path / "new" / "a.txt"
    with replacing(path) as temporary:
        assert temporary.parent == path.parent and temporary.suffix == ".txt"
        temporary.write_text("whole")
        assert not path.exists()
    assert path.read_text() == "whole"
    assert list(path.parent.iterdir()) == [path]


def test_a_block_that_fails_leaves_the_last_good_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("good")
    with pytest.raises(RuntimeError), replacing(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "good"
    assert list(tmp_path.iterdir()) == [path]


def test_files_that_belong_together_change_all_or_none(tmp_path):
    (tmp_path / "a.txt").write_text("good")
    paths = [tmp_path / "a.txt", tmp_path / "new/deep/b.txt"]
    with pytest.raises(RuntimeError), replacing_all(paths) as temporary:
        for file in temporary:
            file.write_text("half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == [tmp_path / "a.txt"] and paths[0].read_text() == "good"
    with replacing_all(paths) as temporary:
        for file in temporary:
            file.write_text("whole")
        assert paths[0].read_text() == "good"
    assert [path.read_text() for path in paths] == ["whole", "whole"]


@pytest.mark.parametrize("name", [".", "../here", "inner/.."])
def test_the_folder_that_one_is_in_is_refused_before_the_work(tmp_path, monkeypatch, name):
    (tmp_path / "here/inner").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(InputError, match="is the folder that you are in"), new_folder(Path(name)):
        raise AssertionError


def test_a_link_to_an_empty_folder_and_one_to_none_lead_to_the_new_folder(tmp_path):
    (tmp_path / "empty").mkdir()
    for name in ("empty", "none"):
        (tmp_path / f"to_{name}").symlink_to(tmp_path / name)
        with new_folder(tmp_path / f"to_{name}") as folder:
            (folder / "a").touch()
        assert (tmp_path / name / "a").is_file() and (tmp_path / f"to_{name}").is_symlink()
    assert {path.name for path in tmp_path.iterdir()} == {"empty", "none", "to_empty", "to_none"}


def test_a_mount_gets_what_the_new_folder_holds(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "is_mount", lambda path: path.name == "out")
    (tmp_path / "out").mkdir()
    before = (tmp_path / "out").stat().st_ino
    with new_folder(tmp_path / "out") as folder:
        assert folder.is_relative_to(tmp_path / "out")
        (folder / "inner").mkdir()
        (folder / "inner/a").touch()
    assert [path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*")] == [
        "inner",
        "inner/a",
    ]
    assert (tmp_path / "out").stat().st_ino == before


def test_what_somebody_has_put_there_since_stays(tmp_path):
    with pytest.raises(OSError, match="not empty"), new_folder(tmp_path / "out"):
        (tmp_path / "out").mkdir()
        (tmp_path / "out/theirs").touch()
    assert (tmp_path / "out/theirs").is_file()


def test_a_new_folder_lets_in_whom_the_mask_lets_in(tmp_path):
    before = os.umask(0o027)
    try:
        with new_folder(tmp_path / "out"):
            pass
    finally:
        os.umask(before)
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o750


def test_a_folder_in_which_nothing_can_be_written_is_told(tmp_path):
    require_writable(tmp_path, "go elsewhere")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    for folder in (tmp_path / "missing", tmp_path / "file"):
        with pytest.raises(InputError, match=f"{folder}: cannot be written .*; go elsewhere"):
            require_writable(folder, "go elsewhere")


@pytest.mark.parametrize("writing", [replacing, new_folder])
def test_errors_name_what_shall_be_written_not_the_temporary(tmp_path, writing):
    path, full = tmp_path / "a", OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(FileNotFoundError) as about_file, writing(path) as temporary:
        (temporary / "new/b").open()
    assert about_file.value.filename == str(path / "new/b")
    with pytest.raises(OSError, match="No space") as about_disk, writing(path):
        raise full
    assert about_disk.value.filename == str(path)
    with pytest.raises(FileNotFoundError) as about_other, writing(path):
        (tmp_path / "other").open()
    assert about_other.value.filename == str(tmp_path / "other")
    assert list(tmp_path.iterdir()) == []


def test_what_is_not_finite_becomes_null(tmp_path):
    write_json(tmp_path / "a.json", {"a": [1, (math.nan, 2.5)], "b": {"c": -math.inf}, "d": True, "e": "NaN"})
    value = json.loads((tmp_path / "a.json").read_text())
    assert value == {"a": [1, [None, 2.5]], "b": {"c": None}, "d": True, "e": "NaN"}
