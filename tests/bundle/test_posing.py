import math

import numpy as np
import pytest
import torch

from splatart_ns.bundle import (
    Joint,
    configured_motions,
    joint_motion,
    moved_splat,
    observed_motions,
    observed_values,
    part_features,
    posed_splat,
)
from splatart_ns.errors import InputError

D = torch.float64


def joint(kind: str, pitch: float = 0.0) -> Joint:
    axis, origin = torch.tensor([0.0, 0, 1], dtype=D), torch.tensor([1.0, 0, 0], dtype=D)
    return Joint("j", kind, "a", "b", axis, origin, torch.zeros(2, dtype=D), None, pitch=pitch)


@pytest.mark.parametrize(
    ("kind", "pitch", "value", "expected"),
    [
        ("revolute", 0.0, math.pi / 2, [1.0, 1.0, 0.0]),
        ("prismatic", 0.0, 0.5, [2.0, 0.0, 0.5]),
        ("screw", 0.1, math.pi, [0.0, 0.0, 0.1 * math.pi]),
        ("cylindrical", 0.0, [0.3, math.pi / 2], [1.0, 1.0, 0.3]),
        ("spherical", 0.0, [0.0, math.pi / 2, 0.0], [1.0, 0.0, -1.0]),
        ("free", 0.0, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0], [3.0, 2.0, 3.0]),
        ("fixed", 0.0, 0.0, [2.0, 0.0, 0.0]),
    ],
)
def test_a_point_moves_as_the_joint_says(kind, pitch, value, expected):
    T = joint_motion(joint(kind, pitch), value)
    moved = T[:3, :3] @ torch.tensor([2.0, 0, 0], dtype=D) + T[:3, 3]
    torch.testing.assert_close(moved, torch.tensor(expected, dtype=D))


@pytest.mark.parametrize("kind", ["revolute", "screw", "cylindrical", "spherical", "free", "fixed"])
def test_a_batch_of_values_gives_the_motions_one_by_one(kind):
    dofs = {"cylindrical": [2], "spherical": [3], "free": [6]}.get(kind, [])
    values = torch.randn(4, 3, *dofs, dtype=D, generator=torch.Generator().manual_seed(0))
    T = joint_motion(joint(kind, 0.1), values)
    assert T.shape == (4, 3, 4, 4)
    torch.testing.assert_close(T[2, 1], joint_motion(joint(kind, 0.1), values[2, 1]))


@pytest.mark.parametrize(
    ("kind", "value", "found"),
    [
        ("spherical", 0.1, r"takes 3 values, not shape \[\]"),
        ("spherical", [[0.1, 0.2]], r"takes 3 values, not shape \[1, 2\]"),
        ("revolute", "wide", "'wide' are no numbers"),
        ("revolute", [0.1, math.nan], "not finite"),
        ("revolute", 10**400, "are no numbers"),
        ("revolute", [[0.1, 0.2], [0.3]], "are no numbers"),
        ("revolute", np.array([0.1, 1j]), "are no numbers"),
        ("revolute", np.complex128(1j), "are no numbers"),
        ("revolute", [np.complex128(1j)], "are no numbers"),
        ("revolute", torch.tensor(1j), "are no numbers"),
        ("revolute", np.ma.masked_array([0.1, 0.2], [False, True]), "are no numbers"),
        ("revolute", [np.ma.masked], "are no numbers"),
        ("revolute", torch.tensor([0.1]).to_sparse(), "are no numbers"),
    ],
)
def test_a_value_that_cannot_be_is_refused(kind, value, found):
    with pytest.raises(InputError, match=found):
        joint_motion(joint(kind), value)


def test_values_are_read_from_views_of_arrays_and_lists_of_tensors():
    values = np.linspace(0.0, 0.6, 5)
    torch.testing.assert_close(
        joint_motion(joint("revolute"), values[::-1]).flip(0), joint_motion(joint("revolute"), values)
    )
    value = torch.tensor(0.1, requires_grad=True)
    T = joint_motion(joint("revolute"), [value, torch.tensor(0.2)])
    (slope,) = torch.autograd.grad(T.sum(), value)
    assert T.shape == (2, 4, 4) and slope != 0


@pytest.mark.parametrize(
    "value",
    [
        np.array(0.3),
        np.array(0.3, ">f8"),
        np.ma.masked_array(0.3, False),
        np.array(0.3, np.longdouble),
        np.float64(0.3),
        torch.tensor(0.3, dtype=D),
    ],
)
def test_one_number_in_any_wrapping_is_no_batch(value):
    assert torch.equal(joint_motion(joint("revolute"), value), joint_motion(joint("revolute"), 0.3))
    batch = joint_motion(joint("revolute"), [value, value])
    assert batch.shape == (2, 4, 4) and torch.equal(batch[1], joint_motion(joint("revolute"), 0.3))


def test_observed_values_give_the_observed_motions(bundle):
    observed = observed_motions(bundle, 1)
    for name, T in configured_motions(bundle, observed_values(bundle, 1)).items():
        torch.testing.assert_close(T, observed[name])


def test_a_childs_axis_turns_with_its_parent(bundle):
    T = configured_motions(bundle, {"hinge": math.pi / 2, "slide": 1.0})["latch"]
    # The latch at (2, 0, 0) slides to (3, 0, 0), and the door's quarter turn about (1, 0, 0) brings that to (1, 2, 0).
    moved = T[:3, :3] @ torch.tensor([2.0, 0, 0], dtype=D) + T[:3, 3]
    torch.testing.assert_close(moved, torch.tensor([1.0, 2.0, 0.0], dtype=D))


def test_no_values_give_state_0(bundle):
    splat = posed_splat(bundle, {})
    torch.testing.assert_close(splat.means, torch.cat([part.splat.means for part in bundle.parts]))
    assert splat.sh.shape == (18, 4, 3)


def test_a_part_that_hangs_on_nothing_stays_with_the_root(bundle):
    bundle.joints = [joint for joint in bundle.joints if joint.name != "slide"]
    assert torch.equal(configured_motions(bundle, {"hinge": 1.0})["latch"], torch.eye(4, dtype=D))


def test_a_joint_may_be_called_by_the_part_that_it_moves(bundle):
    by_part = configured_motions(bundle, {"door": 0.3, "slide": 0.1})
    for name, T in configured_motions(bundle, {"hinge": 0.3, "slide": 0.1}).items():
        assert torch.equal(by_part[name], T)
    with pytest.raises(InputError, match="hinge, door name a joint twice"):
        configured_motions(bundle, {"hinge": 0.3, "door": 0.3})


def test_an_unknown_joint_is_refused(bundle):
    with pytest.raises(InputError, match="no tree joint is called closure; there are hinge, slide"):
        posed_splat(bundle, {"closure": 0.0})


def test_features_tell_the_parts_apart(bundle):
    features = part_features(bundle)
    assert features.shape == (18, 3)
    assert features.argmax(-1).tolist() == [0] * 5 + [1] * 6 + [2] * 7
    assert len(moved_splat(bundle, observed_motions(bundle, 1))) == 18
