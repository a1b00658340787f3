import json
import shutil

import pytest
import torch

from splatart_ns.errors import InputError
from splatart_ns.evaluation.ground_truth import load_ground_truth


@pytest.fixture
def copied(capture, tmp_path):
    (tmp_path / "ground_truth.json").write_bytes((capture / "ground_truth.json").read_bytes())
    shutil.copytree(capture / "ground_truth_points", tmp_path / "ground_truth_points")
    return tmp_path


def rewrite(folder, edit):
    path = folder / "ground_truth.json"
    value = json.loads(path.read_text())
    edit(value)
    path.write_text(json.dumps(value))


def test_the_file_gives_the_truth(capture, truth):
    read = load_ground_truth(capture)
    assert (read.parts, read.root, read.radius) == (truth.parts, truth.root, truth.radius)
    for a, b in zip(read.joints, truth.joints, strict=True):
        assert (a.name, a.type, a.parent, a.child) == (b.name, b.type, b.parent, b.child)
        for field in ("axis", "origin", "values"):
            torch.testing.assert_close(getattr(a, field), getattr(b, field))
    assert read.novel[0].values == pytest.approx(truth.novel[0].values)
    for part in truth.parts:
        torch.testing.assert_close(read.motions[part], truth.motions[part])
        torch.testing.assert_close(read.novel[0].motions[part], truth.novel[0].motions[part])
        torch.testing.assert_close(read.points[part], truth.points[part])


def test_a_continuous_joint_is_a_hinge(copied):
    rewrite(copied, lambda value: value["joints"][0].update(type="continuous"))
    assert [joint.type for joint in load_ground_truth(copied).joints] == ["revolute", "prismatic"]


def test_a_capture_may_have_none(tmp_path):
    assert load_ground_truth(tmp_path) is None


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda v: v.update(format="x"), "format"),
        (lambda v: v["parts"].clear(), "none with geometry"),
        (lambda v: v["joints"][0].pop("child_id"), "'child_id'.*missing"),
        (lambda v: v["joints"][0].update(child_id=9), "child_id"),
        (lambda v: v["joints"][0].update(axis=[0, 0, 3]), "unit"),
        (lambda v: v["joints"][0].update(values=[0.1]), "values"),
        (lambda v: v["joints"][0].update(type="ball"), "type"),
        (lambda v: v["states"][1]["motion_from_state_0"].pop("door"), "'door'.*missing"),
        (lambda v: v["states"][1]["motion_from_state_0"]["door"][0].__setitem__(0, 5.0), "rigid"),
        (lambda v: v["novel"][0]["joint_values"].pop("hinge"), "'hinge'.*missing"),
        (lambda v: v["cameras"].pop("object_bounding_radius"), "object_bounding_radius"),
    ],
)
def test_what_is_wrong_in_the_file_is_named(copied, edit, message):
    rewrite(copied, edit)
    with pytest.raises(InputError, match=message):
        load_ground_truth(copied)


def test_parts_without_geometry_are_known_by_name_alone(copied):
    def edit(value):
        value["parts"][0].update(id=None, has_geometry=False)
        value["joints"][0].update(parent_id=None)

    rewrite(copied, edit)
    read = load_ground_truth(copied)
    assert (read.parts, read.root) == ({2: "door", 3: "latch"}, 2)
    assert (read.joints[0].parent, read.joints[0].parent_name) == (None, "body")


def test_missing_points_are_named(copied):
    shutil.rmtree(copied / "ground_truth_points")
    with pytest.raises(InputError, match=r"part_1\.ply"):
        load_ground_truth(copied)
