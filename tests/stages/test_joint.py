import json
import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatart_ns.geometry.se3 import adjoint, from_rotation_translation, inverse, se3_exp, se3_log
from splatart_ns.stages.joint import fit_joint, fit_joints, surface_noise
from splatart_ns.stages.joint_fit import JointFit, free_joint
from splatart_ns.stages.joint_parameters import joint_motion

seeds = given(seed=st.integers(0, 2**31))


class Scene:
    """A random box-shaped child of a random joint, within an object of radius 1."""

    def __init__(self, seed: int, size: float = 0.3):
        self.generator = torch.Generator().manual_seed(seed)
        shape = size * (0.3 + torch.rand(3, generator=self.generator, dtype=torch.float64))
        self.points = self.normal(400, 3).clamp(-1.5, 1.5) * shape + 0.5 * self.normal(3)
        self.axis = torch.nn.functional.normalize(self.normal(3), dim=0)
        self.origin = self.points.mean(0) + 0.3 * self.normal(3)

    def normal(self, *shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64)

    def motions(self, kind: str, values: list[float], noise: float = 0.0, pitch: float = 0.0) -> torch.Tensor:
        """Motions whose errors at the child's surface are about `noise`."""
        T = joint_motion(kind, self.axis, self.origin, pitch, torch.tensor(values, dtype=torch.float64))
        if noise > 0:
            about = from_rotation_translation(torch.eye(3, dtype=torch.float64), self.points.mean(0))
            spread = torch.linalg.cholesky(surface_noise(self.points, noise, 1.0))
            error = about @ se3_exp((spread @ self.normal(len(values), 6, 1))[..., 0]) @ inverse(about)
            T = torch.cat([T[:1], (T @ error)[1:]])
        return T

    def axis_error(self, fit) -> float:
        """Radians between the lines, folded."""
        return math.asin(min(1.0, float(torch.linalg.vector_norm(torch.linalg.cross(fit.axis, self.axis)))))

    def line_error(self, fit) -> float:
        """Distance of the fitted origin from the true line."""
        return float(torch.linalg.vector_norm(torch.linalg.cross(fit.origin - self.origin, self.axis)))


CASES = [
    ("revolute", [0.0, 0.8]),
    ("revolute", [0.0, -0.3, 2.0, 3.1]),
    ("prismatic", [0.0, -0.4]),
    ("prismatic", [0.0, 0.1, 0.4, -0.2, 0.3]),
]


def test_the_turn_of_a_thin_part_about_itself_is_known_as_by_a_tenth_of_its_radius():
    rod = torch.linspace(-0.5, 0.5, 101).double()[:, None] * torch.tensor([1.0, 0.0, 0.0]).double()
    radius = float(rod.square().sum(1).mean().sqrt())
    about_itself, across, _ = surface_noise(rod, 0.003, 1.0).diagonal()[3:].sqrt()
    assert float(about_itself) == pytest.approx(0.003 / (0.1 * radius))
    assert float(across) == pytest.approx(0.003 / radius, rel=0.01)
    speck = surface_noise(1e-4 * rod, 0.003, 1.0).diagonal()[3:].sqrt()
    assert speck == pytest.approx(torch.full((3,), 0.003 / 0.005).numpy(), rel=1e-3)


@given(seed=st.integers(0, 2**31), case=st.sampled_from(CASES))
@settings(max_examples=15, deadline=None, derandomize=True)
def test_exact_motions_give_the_exact_joint(seed, case):
    scene, (kind, values) = Scene(seed), case
    fit = fit_joint(scene.motions(kind, values), scene.points, object_radius=1.0)
    assert fit.type == kind and fit.converged and fit.residual < 1e-12
    assert scene.axis_error(fit) < 1e-10
    sign = math.copysign(1.0, max(values, key=abs))
    assert torch.allclose(fit.values, sign * torch.tensor(values, dtype=torch.float64), atol=1e-10)
    assert fit.limits == (float(fit.values.min()), float(fit.values.max()))
    if kind == "revolute":
        assert scene.line_error(fit) < 1e-10
        assert abs(float((fit.origin - scene.points.mean(0)) @ fit.axis)) < 1e-12


@pytest.mark.parametrize(("kind", "values"), CASES)
def test_noise_of_the_expected_size_leaves_type_and_errors_within_reach(kind, values):
    scenes = [Scene(seed) for seed in range(30)]
    T = torch.stack([scene.motions(kind, values, noise=0.001) for scene in scenes])
    for scene, fit in zip(scenes, fit_joints(T, [scene.points for scene in scenes], 1.0), strict=True):
        assert fit.type == kind and fit.converged
        assert scene.axis_error(fit) < math.radians(4)
        assert fit.residual < 0.01
        assert torch.allclose(fit.values.abs(), torch.tensor(values, dtype=torch.float64).abs(), atol=0.05)


def test_errors_are_as_large_as_their_covariance_says():
    scenes = [Scene(seed) for seed in range(100)]
    T = torch.stack([scene.motions("revolute", [0.0, 0.8, -0.6], noise=0.003) for scene in scenes])
    axis, origin, value = [], [], []
    for scene, fit in zip(scenes, fit_joints(T, [scene.points for scene in scenes], 1.0), strict=True):
        C = {k: torch.tensor(block, dtype=torch.float64) for k, block in fit.covariance.items()}
        assert C["values"][0].tolist() == [0, 0, 0]
        tilt = fit.axis - scene.axis
        # Where the true line passes nearest the centroid, as the fitted origin does.
        foot = scene.origin + scene.axis * (scene.axis @ (scene.points.mean(0) - scene.origin))
        axis.append(float(tilt @ torch.linalg.pinv(C["axis"], rtol=1e-6) @ tilt))
        origin.append(float((fit.origin - foot) @ torch.linalg.pinv(C["origin"], rtol=1e-6) @ (fit.origin - foot)))
        value.append(float((fit.values[1] - 0.8) ** 2 / C["values"][1, 1]))
    # chi^2 of 2, 2 and 1 degrees of freedom; the means of 100 have deviations of 0.2, 0.2 and 0.14.
    assert 1.4 < sum(axis) / 100 < 2.6
    assert 1.4 < sum(origin) / 100 < 2.6
    assert 0.6 < sum(value) / 100 < 1.4


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_axis_and_origin_err_together_as_their_covariance_says(way):
    scene, small = Scene(4), 0.1
    T = scene.motions("revolute", [0.0, 0.2 * way, -0.9 * way])
    about = from_rotation_translation(torch.eye(3, dtype=torch.float64), scene.points.mean(0))
    here = fit_joint(T, scene.points, object_radius=1.0, types=["revolute"])
    expected = torch.zeros(3, 3, dtype=torch.float64)
    for state in (1, 2):
        for error in torch.linalg.cholesky(surface_noise(scene.points, 0.003, 1.0)).mT:
            moved = T.clone()
            moved[state] = T[state] @ about @ se3_exp(small * error) @ inverse(about)
            there = fit_joint(moved, scene.points, object_radius=1.0, types=["revolute"])
            expected += torch.outer(there.axis - here.axis, there.origin - here.origin) / small**2
    expected -= torch.outer(expected @ here.axis, here.axis)  # along itself an axis has no place
    found = torch.tensor(here.covariance["axis_origin"], dtype=torch.float64)
    assert (found - expected).norm() < 0.1 * expected.norm()


def test_no_nearby_joint_fits_better():
    scene = Scene(2)
    T = scene.motions("revolute", [0.0, 0.8, -0.6], noise=0.003)
    fit = fit_joint(T, scene.points, object_radius=1.0, noise=0.003)
    about = from_rotation_translation(torch.eye(3, dtype=torch.float64), scene.points.mean(0))
    weight = torch.linalg.inv(surface_noise(scene.points, 0.003, 1.0))

    def chi2(axis, origin, values):
        x = se3_log(inverse(about) @ inverse(joint_motion("revolute", axis, origin, 0.0, values)) @ T @ about)
        return float((x[:, None] @ weight @ x[..., None]).sum())

    assert chi2(fit.axis, fit.origin, fit.values) == pytest.approx(fit.chi2, rel=1e-9)
    for _ in range(100):
        axis = torch.nn.functional.normalize(fit.axis + 1e-3 * scene.normal(3), dim=0)
        assert chi2(axis, fit.origin + 1e-3 * scene.normal(3), fit.values + 1e-3 * scene.normal(3)) > fit.chi2


def test_two_states_that_turn_within_the_noise_are_a_slide_and_beyond_it_a_turn():
    scene = Scene(3)
    slide = scene.motions("prismatic", [0.0, 0.3])
    across = torch.nn.functional.normalize(torch.linalg.cross(scene.axis, scene.normal(3)), dim=0)
    fits = {}
    for degrees in (0.2, 20.0):
        turn = se3_exp(torch.cat([torch.zeros(3).double(), math.radians(degrees) * across]))
        about = from_rotation_translation(torch.eye(3, dtype=torch.float64), scene.points.mean(0))
        wobble = torch.stack([torch.eye(4, dtype=torch.float64), about @ turn @ inverse(about)])
        fits[degrees] = fit_joint(slide @ wobble, scene.points, object_radius=1.0)
    assert fits[0.2].type == "prismatic" and not fits[0.2].ambiguous
    # A bare residual would have preferred the turn.
    alternative = {a["type"]: a for a in fits[0.2].alternatives}["revolute"]
    assert alternative["residual"] < fits[0.2].residual and alternative["score"] > fits[0.2].score
    assert fits[20.0].type == "revolute"


def test_a_tiny_part_that_seems_to_turn_by_five_degrees_slides():
    """The turn of a finger a few pixels wide is hardly observed, and the fit says so."""
    scene = Scene(5, size=0.02)
    T = scene.motions("prismatic", [0.0, 0.05])
    about = from_rotation_translation(torch.eye(3, dtype=torch.float64), scene.points.mean(0))
    turn = se3_exp(torch.tensor([0, 0, 0, math.radians(5), 0, 0], dtype=torch.float64))
    fit = fit_joint(torch.stack([T[0], T[1] @ about @ turn @ inverse(about)]), scene.points, object_radius=1.0)
    assert fit.type == "prismatic" and fit.ambiguous


def test_rendering_decides_between_turn_and_slide_where_it_was_asked():
    scene = Scene(8)
    turning, sliding = scene.motions("revolute", [0.0, 0.5]), scene.motions("prismatic", [0.0, 0.5])
    assert fit_joint(turning, scene.points, object_radius=1.0, render_ratio=1.01).type == "prismatic"
    fit = fit_joint(sliding, scene.points, object_radius=1.0, render_ratio=9.0)
    assert fit.type == "revolute" and not fit.ambiguous
    still = scene.motions("revolute", [0.0, 0.0])
    assert fit_joint(still, scene.points, object_radius=1.0, render_ratio=9.0).type == "fixed"


def test_rendering_makes_no_hinge_of_a_round_lid_that_slid():
    """A lid's turn about its own axis shows by light alone: no reason to leave it without a joint."""
    scene = Scene(8)
    T = scene.motions("prismatic", [0.0, 0.1])
    spin = torch.cat([torch.linalg.cross(scene.points.mean(0), scene.axis), scene.axis])
    T = torch.stack([T[0], T[1] @ se3_exp(math.radians(5) * spin)])
    unseen = {"covariance": 3 * spin.outer(spin).expand(2, 6, 6), "object_radius": 1.0, "noise": 0.001}
    fit = fit_joint(T, scene.points, render_ratio=1.5, **unseen)
    assert fit.type == "prismatic" and fit.accepted and scene.axis_error(fit) < 0.01
    assert math.isclose(float(fit.values[1].abs()), 0.1, rel_tol=0.01)
    tilted = scene.motions("revolute", [0.0, 0.5])
    across = torch.linalg.svd(scene.axis[None], full_matrices=True).Vh[1]
    spin = torch.cat([torch.linalg.cross(scene.points.mean(0), across), across])
    unseen["covariance"] = 3 * spin.outer(spin).expand(2, 6, 6)
    assert fit_joint(tilted, scene.points, render_ratio=1.5, **unseen).type == "revolute"


def test_a_known_covariance_overrules_the_default_noise():
    """The same turn of 4 degrees: significant by default, not where the images leave it open."""
    scene = Scene(9)
    about = from_rotation_translation(torch.eye(3, dtype=torch.float64), scene.points.mean(0))
    turn = about @ se3_exp(torch.tensor([0, 0, 0, math.radians(4), 0, 0], dtype=torch.float64)) @ inverse(about)
    T = scene.motions("prismatic", [0.0, 0.3])
    T = torch.stack([T[0], T[1] @ turn])
    loose = torch.diag(torch.tensor([0, 0, 0, 1, 1, 1], dtype=torch.float64)) * math.radians(4) ** 2
    centre = from_rotation_translation(torch.eye(3, dtype=torch.float64), (T[1] @ about)[:3, 3])
    covariance = (adjoint(centre) @ loose @ adjoint(centre).mT).expand(2, 6, 6)
    assert fit_joint(T, scene.points, object_radius=1.0).type == "revolute"
    assert fit_joint(T, scene.points, object_radius=1.0, covariance=covariance).type == "prismatic"


@pytest.mark.parametrize("values", [[0.0, 0.0], [0.0, math.radians(0.01)], [0.0, 1e-4, 0.0, -1e-4]])
def test_a_joint_that_did_not_move_is_fixed_and_undetermined(values):
    scene = Scene(11)
    for noise in (0.0, 0.001):
        fit = fit_joint(scene.motions("revolute", values, noise), scene.points, object_radius=1.0)
        assert fit.type == "fixed" and fit.values.tolist() == [0.0] * len(values)
        assert "undetermined" in fit.undetermined[0] and not fit.covariance


def test_a_turn_of_a_hundredth_of_a_degree_is_found_in_exact_data_and_called_undetermined():
    scene = Scene(12)
    fit = fit_joint(
        scene.motions("revolute", [0.0, math.radians(0.01)]), scene.points, object_radius=1.0, types=("revolute",)
    )
    assert scene.axis_error(fit) < 1e-9 and scene.line_error(fit) < 1e-9
    assert len(fit.undetermined) == 2  # axis and origin: at the assumed noise neither means anything


def test_half_a_turn():
    scene = Scene(13)
    fit = fit_joint(scene.motions("revolute", [0.0, math.pi]), scene.points, object_radius=1.0)
    assert fit.type == "revolute" and scene.axis_error(fit) < 1e-10 and scene.line_error(fit) < 1e-10
    assert float(fit.values[1]) == pytest.approx(math.pi)


def test_a_screw_is_found_with_its_pitch():
    scene = Scene(14)
    types = ("fixed", "prismatic", "revolute", "screw")
    T = scene.motions("screw", [0.0, 1.0, -0.8, 2.5], pitch=0.1)
    fit = fit_joint(T, scene.points, object_radius=1.0, types=types)
    assert fit.type == "screw" and abs(fit.pitch) == pytest.approx(0.1) and scene.line_error(fit) < 1e-9
    assert torch.allclose(fit.motion(fit.values), T, atol=1e-9)
    plain = fit_joint(scene.motions("revolute", [0.0, 1.0, -0.8]), scene.points, object_radius=1.0, types=types)
    assert plain.type == "revolute"


MANY_VALUES = {
    "cylindrical": [[0.0, 0.0], [0.3, -0.9], [-0.1, 2.0], [0.2, 0.4]],
    "spherical": [[0.0, 0.0, 0.0], [0.5, -0.2, 0.9], [-1.5, 0.3, 0.2], [0.1, 1.0, 2.0]],
}


@pytest.mark.parametrize("kind", MANY_VALUES)
def test_exact_motions_give_the_exact_joint_of_more_freedom(kind):
    scene = Scene(17)
    T = scene.motions(kind, MANY_VALUES[kind])
    fit = fit_joint(T, scene.points, object_radius=1.0)
    assert fit.type == kind and fit.converged and fit.residual < 1e-12 and fit.limits is None
    assert torch.allclose(fit.motion(fit.values), T, atol=1e-9)
    assert fit.values.shape == (4, fit.dofs) and torch.all(fit.values[0] == 0)
    assert torch.tensor(fit.covariance["values"]).shape == (4 * fit.dofs, 4 * fit.dofs)
    if kind == "spherical":
        assert torch.allclose(fit.origin, scene.origin, atol=1e-9)
    else:
        assert scene.axis_error(fit) < 1e-9 and scene.line_error(fit) < 1e-9


@pytest.mark.parametrize("kind", MANY_VALUES)
def test_reversing_a_joint_of_more_freedom(kind):
    scene, other = Scene(18), Scene(19)
    T = scene.motions(kind, MANY_VALUES[kind], noise=0.001)
    for fit in (fit_joint(T, scene.points, object_radius=1.0), free_joint(T, scene.points)):
        back = fit.reversed(other.points, inverse(T))
        assert torch.allclose(back.motion(back.values), inverse(fit.motion(fit.values)), atol=1e-12)
        assert back.residual < 0.02


def test_a_fixed_joint_reversed_is_at_the_other_part():
    scene, other, eye = Scene(18), Scene(19), torch.eye(4).double().expand(3, 4, 4)
    back = fit_joint(eye, scene.points, object_radius=1.0).reversed(other.points, eye)
    assert torch.equal(back.origin, other.points.mean(0)) and not torch.signbit(back.values).any()


@pytest.mark.parametrize(
    "degrees, span",
    [
        ((60, 120, 179), 179),
        ((60, 120, 181), 181),
        ((100, 170, 200), 200),
        ((-100, -250), 210),
        ((150, 210), 210),
        ((-170,), 170),
        ((190,), 170),
    ],
)
def test_turns_past_half_a_turn_stay_together(degrees, span):
    scene = Scene(3)
    values = [0.0, *map(math.radians, degrees)]
    fit = fit_joint(scene.motions("revolute", values), scene.points, object_radius=1.0)
    assert fit.type == "revolute" and fit.values[0] == 0
    low, high = fit.limits
    assert math.degrees(high - low) == pytest.approx(span)
    assert torch.allclose(fit.motion(fit.values), scene.motions("revolute", values), atol=1e-6)


def test_noise_that_was_underestimated_does_not_buy_freedom():
    scenes = [Scene(seed) for seed in range(40)]
    T = torch.stack([scene.motions("revolute", [0.0, 0.7, -0.5, 1.2], noise=0.003) for scene in scenes])
    fits = fit_joints(T, [scene.points for scene in scenes], 1.0, noise=0.001)
    assert sum(fit.type == "revolute" for fit in fits) >= 32
    assert sum(fit.chi2 for fit in fits) / 40 > 5 * 11  # 11 numbers are left over
    loosest = [min(a["score"] for a in fit.alternatives) for fit in fits]
    assert all(score > fit.score for score, fit in zip(loosest, fits, strict=True))
    squares = [
        float((fit.values[1] - 0.7) ** 2 / fit.covariance["values"][1][1]) for fit in fits if fit.type == "revolute"
    ]
    assert 0.5 < sum(squares) / len(squares) < 1.7  # its errors are told as they are, not as the noise says


def test_parts_of_two_points_or_one_are_fitted():
    scene = Scene(15)
    T = scene.motions("prismatic", [0.0, 0.3])
    for count in (1, 2):
        fit = fit_joint(T, scene.points[:count], object_radius=1.0)
        assert fit.type == "prismatic" and scene.axis_error(fit) < 1e-9


@seeds
@settings(max_examples=6, deadline=None, derandomize=True)
def test_reversing_exchanges_parent_and_child(seed):
    scene, other = Scene(seed), Scene(seed + 1)
    T = scene.motions("revolute", [0.0, 0.5, -1.1], noise=0.001)
    fit = fit_joint(T, scene.points, object_radius=1.0)
    back = fit.reversed(other.points, inverse(T))
    assert torch.allclose(back.motion(back.values), inverse(fit.motion(fit.values)), atol=1e-12)
    assert torch.allclose(back.values, fit.values) and back.residual < 0.05
    again = back.reversed(scene.points, T)
    assert torch.allclose(again.axis, fit.axis) and torch.allclose(again.origin, fit.origin, atol=1e-10)
    assert again.residual == pytest.approx(fit.residual)
    for name in fit.covariance:
        before, after = torch.tensor(fit.covariance[name]), torch.tensor(again.covariance[name])
        assert torch.allclose(before, after, rtol=1e-4, atol=1e-4 * float(before.abs().max()))


def test_the_result_is_plain_enough_for_json_and_one_state_is_refused():
    scene = Scene(16)
    T = scene.motions("revolute", [0.0, 0.5])
    fit = fit_joint(T, scene.points)
    json.dumps([fit.type, fit.pitch, fit.residual, fit.covariance, fit.ambiguous, fit.alternatives, fit.undetermined])
    with pytest.raises(ValueError, match="two states"):
        fit_joint(T[:1], scene.points)


def test_limits_are_of_the_states_that_tell_the_value():
    variances = torch.diag(torch.tensor([0.0, 1e-6, 10.0]))
    z = torch.tensor([0.0, 0.0, 1.0]).double()
    fit = JointFit("revolute", z, 0 * z, 0.0, torch.tensor([0.0, 0.5, 2.0]).double(), residual=0.0)
    assert fit.limits == (0, 2)
    assert replace(fit, covariance={"values": variances.tolist()}).limits == (0, 0.5)
    assert replace(fit, covariance={"values": (variances + 10).tolist()}).limits == (-math.pi, math.pi)
