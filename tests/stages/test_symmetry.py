import math

import pytest
import torch
from part_scene import angle_deg, box, disc, inverse, motion, photograph

from splatart_ns.geometry.se3 import se3_exp
from splatart_ns.stages.joint import fit_joint
from splatart_ns.stages.pose_evidence import refine_poses
from splatart_ns.stages.symmetry import settle_turn
from splatart_ns.stages.unseen import may_have_turned

TILT = motion((30, 20, 0), (0.2, 0.1, -0.1))
"""How the part lies at state 0, so that its axis is none of the world's."""
TURNED = TILT @ motion((0, 0, 70), (0, 0, 0)) @ inverse(TILT)
EYE = torch.eye(4, dtype=torch.float64)


def scene(shape, T, **kwargs):
    """Splats and views of a part at two states, a little noise on its colours."""
    splats = tuple(shape(2, M @ TILT, **kwargs) for M in (EYE, T))
    views = tuple(photograph(s) for s in splats)
    for k, s in enumerate(splats):
        s.sh = s.sh + 0.02 * torch.randn(s.sh.shape, generator=torch.Generator().manual_seed(k))
    return splats, views


def tilted_box(part, T, size):
    return box(part, size, (0.0, 0.0, 0.0)).transformed(T)


@pytest.fixture(scope="module")
def plain():
    return scene(disc, TURNED)


@pytest.mark.parametrize("size", [(0.5, 0.08), (0.2, 0.5)])
def test_the_turn_of_a_plain_round_part_is_untold_wherever_it_is_put(size):
    splats, views = scene(disc, TURNED, size=size)
    for T in (EYE, TURNED):
        settled, untold = settle_turn(splats, views, 2, T)
        assert angle_deg(settled, EYE) < 3
        assert float(untold[3:, 3:].trace()) == pytest.approx(math.pi**2 / 3, rel=1e-6)
        axis = torch.linalg.eigh(untold[3:, 3:]).eigenvectors[:, -1]
        assert abs(float(axis @ TILT[:3, 2])) > math.cos(math.radians(2))


def test_the_untold_turn_leaves_the_axis_in_place(plain):
    """A turn of that variance about the world's origin moves with it the part's centre back to where it was."""
    _, untold = settle_turn(*plain, 2, EYE)
    twist = torch.linalg.eigh(untold).eigenvectors[:, -1]
    turn = se3_exp(2.0 * twist / twist[3:].norm())
    centre = TILT[:3, 3]
    assert (turn[:3, :3] @ centre + turn[:3, 3] - centre).norm() < 0.01


def test_a_plain_round_part_that_merely_shifted_has_not_turned():
    """A button that was pushed: whatever turn it was found with, a slide explains it."""
    along = torch.eye(4, dtype=torch.float64)
    along[:3, 3] = 0.1 * TILT[:3, 2]
    splats, views = scene(disc, along)
    settled, _ = settle_turn(splats, views, 2, along @ TURNED)
    assert angle_deg(settled, EYE) < 3
    assert (settled[:3] @ TILT[:, 3] - along[:3] @ TILT[:, 3]).norm() < 0.01


def test_a_plain_round_part_that_also_turned_otherwise_stays_where_it_was_put():
    carried = motion((40, 0, 0), (0, 0, 0)) @ TURNED
    splats, views = scene(disc, carried)
    settled, untold = settle_turn(splats, views, 2, carried)
    assert torch.equal(settled, carried)
    assert untold.any()


def test_a_mark_on_a_round_part_tells_its_turn():
    splats, views = scene(disc, TURNED, mark=True)
    for T in (EYE, TURNED):
        settled, untold = settle_turn(splats, views, 2, T)
        assert angle_deg(settled, TURNED) < 6
        assert not untold.any()


@pytest.mark.parametrize("size", [(0.7, 0.4, 0.12), (0.2, 0.2, 0.8), (0.5, 0.5, 0.5)])
def test_a_box_is_left_alone(size):
    splats, views = scene(tilted_box, TURNED, size=size)
    settled, untold = settle_turn(splats, views, 2, TURNED)
    assert torch.equal(settled, TURNED)
    assert not untold.any()


def poses(splats, views, T):
    """Poses and covariances after the last refinement of the part, held at T."""
    start = torch.stack([EYE.expand(2, 4, 4), torch.stack([EYE, T])])
    return refine_poses(splats, views, start, torch.ones(2, 2, dtype=torch.bool))


def test_a_plain_disc_that_seems_still_may_have_turned_and_its_joint_says_so(plain):
    T, covariance = poses(*plain, EYE)
    assert torch.equal(T[1, 1], EYE)
    assert may_have_turned(covariance[:, 1]).tolist() == [False, True]
    joint = fit_joint(T[:, 1], plain[0][0].means.double(), covariance=covariance[:, 1], object_radius=1.0)
    assert joint.type == "fixed"
    assert joint.ambiguous
    assert "revolute" in [other["type"] for other in joint.alternatives]
    assert any("turned unseen" in note for note in joint.undetermined)


def test_a_marked_disc_that_seems_still_is_turned_to_where_its_mark_is():
    T, covariance = poses(*scene(disc, TURNED, mark=True), EYE)
    assert angle_deg(T[1, 1], TURNED) < 6  # so near with 10 views of 64 pixels and its light against it
    assert not may_have_turned(covariance[:, 1]).any()
