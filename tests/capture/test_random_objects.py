import json
import re

import numpy as np
import pytest
from scipy.spatial import cKDTree

from splatart_ns.capture.articulated_object import ArticulatedObject, Joint, Link
from splatart_ns.capture.families import FAMILIES
from splatart_ns.capture.interpenetration import Interpenetration
from splatart_ns.capture.procedural import build_object, is_object_name, synthesize_object
from splatart_ns.capture.random_objects import MOST_PARTS, random_joint_values, random_object
from splatart_ns.capture.robot import read_urdf
from splatart_ns.capture.shapes import drum, rounded_box
from splatart_ns.capture.synthesis_options import SynthesisOptions
from splatart_ns.errors import InputError

SEEDS = range(30)


def values_of(made, states, seed):
    texts = random_joint_values(made, states, seed)
    return [{name: float(v) for name, v in (item.split("=") for item in text.split(","))} for text in texts]


def test_the_first_seeds_show_every_family():
    assert {random_object(seed).name.split("-")[0] for seed in SEEDS} == set(FAMILIES)


def test_an_object_has_the_number_of_parts_asked_for():
    for parts in range(2, MOST_PARTS + 1):
        made = random_object(3, parts)
        assert len(made.links) == parts
        assert len(made.joints) == parts - 1


def test_one_seed_writes_the_same_bytes_and_another_one_others(tmp_path):
    for folder, name in (("a", "random-3-4"), ("b", "random-3-4"), ("c", "random-4-4")):
        build_object(name).write(tmp_path / folder)
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert files == sorted(path.name for path in (tmp_path / "b").iterdir())
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)
    first, other = (sorted((tmp_path / folder).glob("*.urdf"))[0].read_bytes() for folder in ("a", "c"))
    assert first != other


def test_joint_values_of_one_seed_are_the_same():
    made = random_object(3)
    assert random_joint_values(made, 3, 3) == random_joint_values(made, 3, 3)


@pytest.mark.parametrize("seed", SEEDS)
def test_every_joint_moves_noticeably_and_no_part_reaches_into_another(seed):
    made = random_object(seed)
    interpenetration = Interpenetration(made)
    states = values_of(made, 3, seed)
    for values in states:
        assert not interpenetration.is_gross(values)
    for before, after in zip(states, states[1:], strict=False):
        for joint in made.joints:
            moved, room = abs(after[joint.name] - before[joint.name]), joint.limits[1] - joint.limits[0]
            if joint.type == "revolute":
                assert np.radians(14.99) < moved < np.radians(150.01)
            else:
                assert 0.199 * room < moved < 0.901 * room


@pytest.mark.parametrize("seed", SEEDS)
def test_parts_touch_at_their_joint_and_are_of_some_size(seed, tmp_path):
    made = random_object(seed)
    robot = read_urdf(made.write(tmp_path))
    surfaces = {part.name: robot.surface(part, {}) for part in robot.parts()}
    points = {name: s.sample(6000, np.random.default_rng(0)) for name, s in surfaces.items()}
    for values in values_of(made, 2, seed):
        poses = robot.link_poses(values)
        placed = {name: p @ poses[name][:3, :3].T + poses[name][:3, 3] for name, p in points.items()}
        length = np.ptp(np.concatenate(list(placed.values())), axis=0).max()
        for joint in robot.movable:
            gap = cKDTree(placed[joint.parent]).query(placed[joint.child])[0].min()
            assert gap < 0.01 * length, joint.name
    for name, surface in surfaces.items():
        size = np.ptp(surface.triangles.reshape(-1, 3), axis=0).max()
        assert size > (0.08 if re.match("finger|knob", name) else 0.12) * length, name
        assert surface.textures[0].astype(float).std() > 40.0


def test_depth_is_that_of_the_overlap_and_contact_has_none():
    grey = ((90, 90, 90),) * 4
    below, above = drum(0.5, 0.0, 1.0), rounded_box((1.0, 1.0, 1.0), 0.1, at=(0.0, 0.0, 1.3))
    links = (Link("below", [below], grey, (0,)), Link("above", [above], grey, (0,)))
    joint = Joint("lift", "prismatic", "below", "above", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0))
    interpenetration = Interpenetration(ArticulatedObject("pair", links, (joint,), 0.1))
    assert interpenetration.depth({"lift": 0.0}) == pytest.approx(0.2, abs=0.01)
    assert interpenetration.is_gross({"lift": 0.0})
    assert interpenetration.depth({"lift": 0.2001}) == 0.0
    assert not interpenetration.is_gross({"lift": 0.2001})


@pytest.mark.parametrize("states", [2, 3])
def test_a_random_object_is_rendered_in_states_of_its_own(states, tmp_path):
    options = SynthesisOptions(states=states, train_views=3, test_views=0, resolution=32, samples=1)
    truth = json.loads((synthesize_object("random-8", tmp_path / "c", options) / "ground_truth.json").read_text())
    assert len(truth["states"]) == states
    for joint in truth["joints"]:
        assert (np.abs(np.diff(joint["values"])) > 1e-3).all()


@pytest.mark.parametrize("name", ["random", "random-", "random-x", "random-3-1", "random-3-11", "random-3-4-5"])
def test_a_malformed_name_is_refused_with_an_example(name):
    assert is_object_name(name)
    with pytest.raises(InputError, match="write for example random-17"):
        build_object(name)


@pytest.mark.parametrize("name", ["robot.urdf", "random-3.urdf", "random/robot", "randomly"])
def test_a_file_is_not_taken_for_an_object(name):
    assert not is_object_name(name)
