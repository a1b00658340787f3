import math

import numpy as np
import pytest
import torch

from splatart_ns.bundle import JOINT_DOFS, configured_motions
from splatart_ns.bundle.export import PartShape, describe
from splatart_ns.bundle.export.describe import expected_poses


def test_links_have_their_origin_at_the_joint_and_the_root_at_the_world(objects):
    bundle = objects.chain(["revolute", "prismatic"])
    robot = objects.robot(bundle)
    np.testing.assert_array_equal(robot.links["p0"].origin, 0)
    for joint in bundle.joints:
        np.testing.assert_allclose(robot.links[joint.child].origin, joint.origin)
    box = robot.links["p2"].surface
    np.testing.assert_allclose(
        box.bounds.mean(0) + robot.links["p2"].origin, objects.shapes(bundle)["p2"].surface.centroid
    )


@pytest.mark.parametrize(
    ("unit", "given", "scale", "noted"),
    [("metre", None, 1.0, 0), ("millimetre", None, 1e-3, 0), ("cm", None, 0.01, 0), ("unknown", None, 1.0, 1),
     ("unknown", 0.2, 0.2, 0), ("metre", 3.0, 3.0, 0)],
)  # fmt: skip
def test_lengths_are_in_metres(objects, unit, given, scale, noted):
    bundle = objects.chain(["prismatic"], length_unit=unit)
    robot = objects.robot(bundle, scale=given, limit_margin=0.0)
    assert robot.scale == scale
    assert sum("unit of length" in note for note in robot.notes) == noted
    assert robot.freedoms[0].limits == pytest.approx((-0.3 * scale, 0.1 * scale))
    np.testing.assert_allclose(robot.links["p1"].origin, scale * bundle.joints[0].origin.numpy())
    assert robot.links["p0"].surface.volume == pytest.approx(scale**3 * 0.3 * 0.24 * 0.18)


def test_a_loop_is_in_metres(objects):
    bundle = objects.chain(["screw"])
    bundle.joints.append(objects.joint("again", "screw", "p0", "p1", 1, in_tree=False))
    (loop,) = objects.robot(bundle, scale=0.5).loops
    np.testing.assert_allclose(loop.origin, 0.5 * bundle.joints[1].origin.numpy())
    assert loop.pitch == pytest.approx(0.5 * 0.03)


@pytest.mark.parametrize(("scale", "noted"), [(1e-3, True), (0.1, False), (10.0, False), (1000.0, True)])
def test_a_size_that_must_be_a_mistake_is_noted(objects, scale, noted):
    robot = objects.robot(objects.chain(["revolute"]), scale=scale)
    assert any("check --scale" in note for note in robot.notes) == noted


def test_mass_follows_density(objects):
    robot = objects.robot(objects.chain(["fixed"]), density=1000.0)
    assert robot.links["p0"].inertia.mass == pytest.approx(1000 * 0.3 * 0.24 * 0.18)


def test_a_part_that_hangs_on_nothing_is_fixed_to_the_root_and_noted(objects):
    bundle = objects.make_bundle(["base", "lid", "stone"], [objects.joint("j", "revolute", "base", "lid", 1)])
    robot = objects.robot(bundle)
    held = robot.joints[-1]
    assert (held.parent, held.child, held.freedoms, held.source) == ("base", "stone", (), None)
    assert any("'stone' hangs on nothing" in note for note in robot.notes)


def test_a_joint_that_did_not_move_is_fixed_and_noted(objects):
    still = torch.zeros(3, dtype=torch.float64)
    joint = objects.joint("j", "revolute", "p0", "p1", 1, values=still, limits=(0.0, 0.0))
    robot = objects.robot(objects.make_bundle(["p0", "p1"], [joint]))
    assert robot.freedoms == () and "did not move" in robot.notes[0]


def test_a_part_without_a_surface_is_a_link_of_least_mass(objects):
    bundle = objects.chain(["revolute"])
    shapes = objects.shapes(bundle) | {"p1": PartShape(None, ())}
    robot = describe(bundle, shapes, "thing")
    assert robot.links["p1"].surface is None and robot.links["p1"].inertia.mass > 0
    assert "'p1' has no surface" in robot.notes[0]


def test_a_surface_that_is_mostly_a_guess_is_noted(objects):
    bundle = objects.chain(["prismatic"])
    shapes = objects.shapes(bundle)
    shapes["p1"].surface.metadata["unseen_share"], shapes["p0"].surface.metadata["unseen_share"] = 0.25, 0.02
    notes = describe(bundle, shapes, "robot").notes
    assert [note for note in notes if "camera" in note] == [
        "Part 'p1': no camera looked at 25% of its surface, whose shape is a guess."
    ]


def test_names_that_clash_stay_apart(objects):
    # The chain of the joint "a" needs names that another joint and a part have.
    joints = [
        objects.joint("a", "cylindrical", "base", "a_slide_link", 1),
        objects.joint("a_slide", "revolute", "a_slide_link", "b held", 2),
        objects.joint("b held", "revolute", "b held", "world", 3),
    ]
    bundle = objects.make_bundle(["base", "a_slide_link", "b held", "world", "b"], joints)
    robot = objects.robot(bundle)
    joint_names = [f.name for f in robot.freedoms] + [j.name for j in robot.joints if not j.freedoms]
    link_names = [*robot.links, *(name for j in robot.joints for name in j.between)]
    assert len({name.lower() for name in joint_names}) == len(joint_names) == 5
    assert len({name.lower() for name in link_names}) == len(link_names) == 6
    assert "world" not in link_names


def test_overlapping_links_that_are_not_neighbours_are_found(objects):
    bundle = objects.chain(["revolute", "revolute"])
    robot = describe(bundle, {k: s for k, s in objects.shapes(bundle, size=0.3).items()}, "thing")
    assert robot.overlaps == {}
    fat = describe(bundle, objects.shapes(bundle, size=1.6), "thing")
    assert list(fat.overlaps) == [("p0", "p2")]
    assert ("p0", "p2") in fat.uncollided and ("p0", "p1") in fat.uncollided


@pytest.mark.parametrize("kind", list(JOINT_DOFS))
def test_expected_poses_are_the_bundles_motions(objects, kind):
    bundle = objects.chain([kind, "revolute"])
    robot = objects.robot(bundle, scale=0.5)
    values = {f.name: 0.3 for f in robot.freedoms if f.mimic is None and f.type == "revolute"}
    poses = expected_poses(bundle, robot, values)
    # A single-number joint takes its value as it is.
    if kind in ("revolute", "screw"):
        motions = configured_motions(bundle, {"j1": 0.3, "j2": 0.3})
        point = np.array([0.1, 0.2, 0.3])
        moved = poses["p2"][:3, :3] @ point + poses["p2"][:3, 3]
        start = point + robot.links["p2"].origin
        T = motions["p2"].numpy()
        np.testing.assert_allclose(moved, 0.5 * (T[:3, :3] @ (start / 0.5) + T[:3, 3]), atol=1e-12)
    assert all(math.isclose(np.linalg.det(T[:3, :3]), 1.0) for T in poses.values())
