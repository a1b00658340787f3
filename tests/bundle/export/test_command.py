"""`splatart export`, as a user types it."""

import json
import re

import pytest
import torch

from splatart_ns.bundle import export as exports
from splatart_ns.bundle import save_bundle


@pytest.fixture
def folder(objects, tmp_path, monkeypatch):
    """A saved bundle whose parts are boxes."""
    save_bundle(objects.chain(["revolute", "prismatic"], length_unit="unknown"), tmp_path / "my box")
    monkeypatch.setattr(exports, "part_shapes", objects.shapes)
    return tmp_path / "my box"


def plain(text):
    return re.sub(r"\s+", " ", text)


def test_an_export_is_checked_and_reported(run_main, folder):
    code, output, errors = run_main("export", folder, "--format", "urdf")
    assert (code, errors) == (0, "")
    assert (folder / "export" / "urdf" / "my_box.urdf").is_file()
    output = plain(output)
    assert "The bundle's unit of length is 'unknown': taken as metres; say better with --scale." in output
    assert re.search(r"yourdfpy link poses passed error \de-\d+ at most of 20", output)
    assert "overlap at rest note none but neighbours" in output


def test_several_formats_get_a_folder_each(run_main, folder, tmp_path):
    options = ("--output", tmp_path / "out", "--scale", 0.1, "--no-validate")
    code, output, _ = run_main("export", folder, "--format", "glb", "ply", "--format", "html", "glb", *options)
    assert code == 0 and "passed" not in output
    for form in ("glb", "ply", "html"):
        assert (tmp_path / "out" / form / f"my_box.{form}").is_file()
    assert json.loads((tmp_path / "out" / "glb" / "export.json").read_text())["metres_per_unit"] == 0.1


def test_a_page_needs_no_meshes_and_has_the_bundles_own_units(run_main, folder, monkeypatch):
    monkeypatch.delattr(exports, "part_shapes")
    code, output, errors = run_main("export", folder, "--format", "html")
    assert (code, errors) == (0, "") and "note" not in output
    assert (folder / "export" / "html" / "my_box.html").is_file()
    assert re.search(r"splatart Gaussians passed 18 of 18, in 3 parts", plain(output))


def test_one_format_goes_where_it_is_told_and_may_go_there_again(run_main, folder, tmp_path):
    for _ in range(2):
        code, _, errors = run_main("export", folder, "--format", "glb", "--output", tmp_path / "out")
        assert (code, errors) == (0, "")
    assert (tmp_path / "out" / "my_box.glb").is_file()


def test_a_failed_check_is_exit_code_1(run_main, folder, monkeypatch):
    bad = exports.Check("mujoco", "10 s under gravity", "failed", "exploded")
    monkeypatch.setattr(exports, "validate", lambda *_: [bad])
    code, output, errors = run_main("export", folder, "--format", "glb")
    assert (code, errors) == (1, "") and "exploded" in output


def test_the_bundle_itself_is_not_overwritten(run_main, folder):
    code, _, errors = run_main("export", folder, "--format", "ply", "--output", folder)
    assert code == 2
    assert errors.endswith("which no export wrote; give another folder with --output.\n")
    assert (folder / "articulation.json").is_file()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("scale", 0),
        ("scale", "nan"),
        ("density", -1),
        ("density", "inf"),
        ("limit-margin", -0.1),
        ("scale", 1e300),
        ("limit-margin", 1e308),
    ],
)
def test_numbers_that_make_no_sense_are_refused(run_main, folder, option, value):
    code, _, errors = run_main("export", folder, "--format", "urdf", f"--{option}", value)
    assert code == 2
    assert errors.startswith(f"error: --{option} is ") and "; give a number " in errors


@pytest.mark.parametrize(("form", "option"), [("html", "scale"), ("html", "density"), ("ply", "limit-margin")])
def test_options_that_change_nothing_are_refused(run_main, folder, form, option):
    code, _, errors = run_main("export", folder, "--format", form, f"--{option}", 0.5)
    assert code == 2 and f"error: --{option} changes nothing of {form}; leave it out." in errors


def test_what_cannot_be_written_is_said_before_any_mesh_is_made(run_main, folder, tmp_path, monkeypatch):
    monkeypatch.setattr(exports, "part_shapes", lambda bundle: pytest.fail("made meshes"))
    (tmp_path / "out" / "glb").mkdir(parents=True)
    (tmp_path / "out" / "glb" / "mine.txt").touch()
    code, _, errors = run_main("export", folder, "--format", "urdf", "glb", "--output", tmp_path / "out")
    assert code == 2 and "'mine.txt'" in errors
    for nothing in ((), ("--format",)):
        code, _, errors = run_main("export", folder, *nothing)
        assert code == 2 and errors.startswith("error: --format names none; give one or more of urdf, ")


def test_a_part_that_cannot_be_seen_is_exported_without_a_mesh(run_main, objects, tmp_path):
    bundle = objects.make_bundle(["ghost"], [])
    bundle.parts[0].splat.opacity_logits = torch.full((6,), -20.0)
    save_bundle(bundle, tmp_path / "ghost")
    code, output, _ = run_main("export", tmp_path / "ghost", "--format", "urdf")
    assert code == 0 and "Part 'ghost' has no surface" in output
