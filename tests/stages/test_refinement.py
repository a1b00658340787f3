import math
from dataclasses import replace

import pytest
import torch
from part_scene import angle_deg, box, inverse, motion, nearby, photograph, two_states

from splatart_ns.geometry.se3 import se3_log, transform_points
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.part_pair import part_pair
from splatart_ns.stages.refinement import STEP, increment, linearized, motion_covariance, refine, rotation_held_ratio

TURN = motion((10, 0, 40), (0.3, -0.2, 0.1))
SLIDE = motion((0, 0, 0), (0.3, 0.2, 0.0))


def pair_of(T: torch.Tensor, noise: float = 0.0):
    splats, views = two_states(T)
    if noise > 0:
        g = torch.Generator().manual_seed(0)
        for splat in splats:
            splat.means += noise * torch.randn(splat.means.shape, generator=g)
    return part_pair(splats, views, 2, num_views=5, pixels=5000)


@pytest.fixture(scope="module")
def turned():
    return pair_of(TURN)


def test_an_increment_turns_about_the_moved_centroid(turned):
    xi = torch.tensor([[0.1, 0.0, 0.0, 0.3, 0.2, 0.1]]).double()
    before, after = (transform_points(T, turned.centroid[None])[0] for T in (TURN, increment(TURN, xi, *of(turned))[0]))
    assert torch.allclose(after - before, torch.tensor([0.1 * turned.radius, 0, 0]).double())
    assert angle_deg(increment(TURN, xi, *of(turned))[0], TURN) == pytest.approx(math.degrees(xi[0, 3:].norm()))


def of(pair):
    return pair.centroid, pair.radius


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_refining_finds_the_motion(turned, seed):
    start = nearby(TURN, 0.04, seed)
    found = refine(turned, start, 15)
    assert angle_deg(found.T, TURN) < 0.2
    shift = transform_points(inverse(TURN) @ found.T, turned.centroid[None])[0] - turned.centroid
    assert shift.norm() < 0.005 * turned.radius
    assert found.cost < float(turned.cost(start[None])[0])


def test_refining_never_makes_it_worse(turned):
    far = nearby(TURN, 0.5)
    assert refine(turned, far, 3).cost <= float(turned.cost(far[None])[0])


def test_holding_the_rotation_moves_only_the_centroid(turned):
    start = nearby(TURN, 0.04)
    held = refine(turned, start, hold_rotation=True)
    assert torch.allclose(held.T[:3, :3], start[:3, :3], atol=1e-12)
    assert not torch.allclose(held.T[:3, 3], start[:3, 3])


def test_a_slide_fits_as_well_with_the_rotation_held_and_a_turn_does_not(turned):
    eye = torch.eye(3, dtype=torch.float64)
    slid = pair_of(SLIDE, noise=0.01)
    assert rotation_held_ratio(slid, SLIDE, eye) < 1.2
    assert rotation_held_ratio(turned, TURN, eye) > 3


def test_the_covariance_covers_the_error():
    pair = pair_of(TURN, noise=0.02)
    found = refine(pair, TURN, 15)
    covariance = motion_covariance(pair, found.T)
    assert torch.allclose(covariance, covariance.T)
    assert (torch.linalg.eigvalsh(covariance) > 0).all()
    xi = se3_log(found.T @ inverse(TURN))
    assert xi @ torch.linalg.solve(covariance, xi) < 9 * 6
    assert xi.norm() > 1e-4


@pytest.mark.parametrize("state", [0, 1])
def test_where_outlines_are_rendered_those_that_were_given_say_how_far_the_splat_may_be_off(state):
    splats, views = two_states(TURN)
    off = motion((1.0, 0, -1.0), (0.02, -0.01, 0.01))
    splats, views = list(splats), [list(of_state) for of_state in views]
    splats[state] = splats[state].transformed(off)
    rendered = [replace(view, outlined_by_splat=True) for view in photograph(splats[state])]
    views[state] = [
        given if k % 3 == 0 else own for k, (given, own) in enumerate(zip(views[state], rendered, strict=True))
    ]

    def deviations(of_views) -> float:
        pair = part_pair(tuple(splats), of_views, 2, num_views=10, pixels=5000)
        T = refine(pair, TURN, 15).T
        xi = se3_log(T @ inverse(TURN))
        assert xi[:3].norm() > 0.005
        return float((xi @ torch.linalg.solve(motion_covariance(pair, T), xi)).sqrt())

    told = deviations(tuple(views))
    untold = deviations(tuple([replace(view, outlined_by_splat=False) for view in some] for some in views))
    assert told < 3.5 < untold  # 95 % of six unknowns


def test_a_tiny_part_turns_less_certainly_than_a_large_one():
    def sigma(size: float) -> float:
        part = box(2, (size, 0.6 * size, 0.5 * size), (0.0, 0.0, 0.0), spacing=size / 8)
        part.means += 0.02 * size * torch.randn(part.means.shape, generator=torch.Generator().manual_seed(0))
        splats = (part, part.transformed(TURN))
        pair = part_pair(splats, tuple(photograph(s) for s in splats), 2, num_views=5, pixels=5000)
        covariance = motion_covariance(pair, refine(pair, TURN, 10).T)
        return float(covariance[3:, 3:].trace().sqrt())

    assert sigma(0.15) > 2 * sigma(1.0)


def rod_of(n: int, size: float) -> Splat:
    """Balls in a row along z, of part 2."""
    return Splat(
        means=torch.tensor([0.0, 0.0, 1.0]) * torch.linspace(-0.5, 0.5, n)[:, None],
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        log_scales=torch.full((n, 3), math.log(size)),
        opacity_logits=torch.full((n,), 2.0),
        sh=torch.linspace(-1, 1, n)[:, None, None].expand(n, 1, 3),
        part_logits=torch.tensor([-8.0, -8.0, 0.0]).repeat(n, 1),
    )


def test_a_turn_that_no_image_shows_is_uncertain():
    rod = rod_of(8, 0.1)
    pair = part_pair((rod, rod), (photograph(rod), photograph(rod)), 2, num_views=5, pixels=5000)
    sigma = motion_covariance(pair, torch.eye(4)).diagonal().sqrt()
    assert sigma[5] > 1
    assert (sigma[:5] < 0.01).all()


def test_a_turn_that_no_outline_shows_is_uncertain_by_half_a_turn():
    ball = rod_of(1, 0.4)
    moved = ball.transformed(motion((0, 0, 0), (0.03, 0.0, 0.0)))
    shown = zip(photograph(ball), photograph(moved), strict=True)
    views = [given if k % 3 == 0 else own for k, (given, own) in enumerate(shown)]

    def variances(rendered: bool):
        flagged = [replace(view, outlined_by_splat=rendered and k % 3 > 0) for k, view in enumerate(views)]
        pair = part_pair((moved, moved), (flagged, flagged), 2, num_views=10, pixels=5000)
        return motion_covariance(pair, torch.eye(4))[3:, 3:].diagonal()

    added = variances(True) - variances(False)  # by each of the two states
    assert (added > 1).all() and (added < 2.01 * math.pi**2).all()


def test_large_residuals_that_bend_hardly_mislead_the_search():
    x = torch.tensor([0.0, STEP])
    residuals = torch.stack([1 + x**2, x], -1)[:, None, None]  # the least sum of squares is at 0
    H, g, _ = linearized(0.01 * residuals, torch.ones(1, 1))
    assert abs(float(g / H)) < 1e-3


def test_equations_after_a_converged_step_are_those_measured_there(turned):
    found = refine(turned, nearby(TURN, 0.02), max_iterations=30)
    again = refine(turned, found.T, max_iterations=0)
    assert found.converged and found.cost == pytest.approx(again.cost)
    covariance, measured = (motion_covariance(turned, found.T, r.equations) for r in (found, again))
    assert torch.linalg.norm(covariance - measured) < 0.2 * torch.linalg.norm(measured)


def test_a_motion_that_two_directions_disagree_about_is_less_certain(turned):
    equations = refine(turned, TURN, max_iterations=0).equations
    counts = [len(views) for views in reversed(turned.views)]
    # As far from their mean, view by view.
    alike = torch.tensor([1.0, -1.0]).repeat(sum(counts) // 2)
    apart = torch.tensor([1.0, -1.0]).repeat_interleave(torch.tensor(counts))
    pull = equations.H.sum(0).diagonal().mean().sqrt()
    agreed, disagreed = (
        motion_covariance(turned, TURN, replace(equations, g=pull * ways[:, None].expand(-1, 6).double()))
        for ways in (alike, apart)
    )
    assert disagreed.trace() > 2 * agreed.trace()
