import json

import numpy as np
import pytest

from splatart_ns.capture.procedural import build_object, synthesize_object
from splatart_ns.capture.robot import read_urdf
from splatart_ns.capture.shapes import blocks, drum, rounded_box
from splatart_ns.capture.synthesis_options import OBJECTS, SynthesisOptions
from splatart_ns.errors import InputError

SOLIDS = {
    "rounded_box": rounded_box((1.0, 2.0, 3.0), 0.2, at=(1.0, 0.0, 0.0)),
    "drum_x": drum(0.5, -1.0, 2.0, "x", chamfer=0.1),
    "drum_y": drum(0.5, -1.0, 2.0, "y", at=(0.0, 5.0, 0.0)),
    "drum_z": drum(0.5, -1.0, 2.0),
    "blocks": blocks(((0, 1, 3), (0, 1, 2), (0, 1)), lambda i, j, k: (i, j) != (1, 1)),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed_and_wound_outwards(name):
    assert SOLIDS[name].is_watertight
    assert SOLIDS[name].is_winding_consistent
    assert SOLIDS[name].volume > 0.0


def test_solids_have_the_size_and_place_asked_for():
    assert SOLIDS["rounded_box"].bounds == pytest.approx(np.array([[0.5, -1.0, -1.5], [1.5, 1.0, 1.5]]))
    assert SOLIDS["drum_x"].bounds[:, 0] == pytest.approx([-1.0, 2.0])
    assert SOLIDS["drum_y"].bounds[:, 1] == pytest.approx([4.0, 7.0])
    assert SOLIDS["blocks"].volume == pytest.approx(4.0)


@pytest.mark.parametrize("name", OBJECTS)
def test_an_object_is_a_urdf_with_textured_parts(name, tmp_path):
    robot = read_urdf(build_object(name).write(tmp_path))
    parts = robot.parts()
    assert len(parts) == len(robot.movable) + 1
    for part in parts:
        surface = robot.surface(part, {})
        assert all(min(t.shape[:2]) > 16 for t in surface.textures)
        # High contrast: a registration by colour has something to hold on to.
        assert surface.textures[0].astype(float).std() > 40.0
        assert surface.uv.min() >= 0.0 and surface.uv.max() <= 1.0


def test_an_object_is_written_the_same_each_time(tmp_path):
    build_object("arm").write(tmp_path / "a")
    build_object("arm").write(tmp_path / "b")
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


@pytest.mark.parametrize("name", OBJECTS)
def test_an_object_is_rendered_with_all_its_parts_in_view(name, tmp_path):
    options = SynthesisOptions(train_views=4, test_views=0, resolution=48, samples=1)
    folder = synthesize_object(name, tmp_path / "c", options)
    truth = json.loads((folder / "ground_truth.json").read_text())
    assert truth["source"]["robot_name"] == name
    assert all(abs(j["values"][0] - j["values"][1]) > 0.1 for j in truth["joints"])


def test_joint_values_given_replace_the_objects_own(tmp_path):
    options = SynthesisOptions(
        joint_values=("drawer_joint=0", "drawer_joint=0.1"), train_views=1, test_views=0, resolution=16, samples=1
    )
    truth = json.loads((synthesize_object("drawer", tmp_path / "c", options) / "ground_truth.json").read_text())
    assert truth["joints"][0]["values"] == [0.0, 0.1]


def test_an_unknown_object_is_answered_with_those_there_are():
    with pytest.raises(InputError, match="hinge, drawer, arm"):
        build_object("spoon")
