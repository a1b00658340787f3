from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from part_scene import cameras

from splatart_ns.capture.seen_surface import SeenSurface, _normals, cells, measured_surface
from splatart_ns.capture.view import View
from splatart_ns.stages.hull import seed_points, seen_surface, visual_hull
from splatart_ns.stages.semantic import depth_loss

PIXELS, RADIUS = 96, 0.6


def ball(count: int = 24) -> list[View]:
    """Views of a grey ball with the depth of its surface: without texture, so that stereo says nothing."""
    K = torch.tensor([[1.8 * PIXELS, 0, PIXELS / 2], [0, 1.8 * PIXELS, PIXELS / 2], [0, 0, 1]])
    row, column = torch.meshgrid(*[torch.arange(PIXELS) + 0.5] * 2, indexing="ij")
    rays = torch.stack([column, row, torch.ones_like(row)], -1) @ torch.linalg.inv(K).mT
    views = []
    for k, viewmat in enumerate(cameras(count)):
        centre, a = viewmat[:3, 3], rays.square().sum(-1)
        b = rays @ centre
        inside = b**2 - a * (centre @ centre - RADIUS**2)
        depth = torch.where(inside > 0, (b - inside.clamp_min(0).sqrt()) / a, 0)
        alpha = 255 * (depth > 0).to(torch.uint8)
        rgb = torch.full((PIXELS, PIXELS, 3), 99, dtype=torch.uint8)
        views.append(View(f"{k:04d}", viewmat, K, PIXELS, PIXELS, rgb, alpha, labels=alpha.clamp_max(1), depth=depth))
    return views


@pytest.fixture(scope="module")
def views() -> list[View]:
    return ball()


@pytest.fixture(scope="module")
def found(views):
    return measured_surface(views)


def test_points_and_normals_are_those_of_the_surface(found):
    assert len(found.xyz) > 1000 and found.confirmed > 0.95
    radius = found.xyz.norm(dim=-1)
    assert (radius - RADIUS).abs().max() < 1e-4
    known = found.normals.norm(dim=-1) > 0
    assert known.float().mean() > 0.75  # not at the rims
    assert ((found.normals * found.xyz).sum(-1) / radius)[known].quantile(0.05) > 0.97  # outwards


def test_a_view_whose_depth_is_wrong_is_not_believed(views):
    wrong = [replace(view, depth=1.1 * view.depth) if k == 5 else view for k, view in enumerate(views)]
    again = measured_surface(wrong)
    trusted = again.trusted_views()
    assert not trusted[5].depth.any()  # nor what is confirmed by chance
    assert (again.xyz.norm(dim=-1) - RADIUS).abs().max() < 1e-4
    assert (trusted[9].depth > 0).sum() > 0.9 * (views[9].depth > 0).sum()
    kept = trusted[9].depth > 0
    assert torch.equal(trusted[9].depth[kept], views[9].depth[kept])


@pytest.mark.parametrize("factor", [1e-3, 0.4, 1000.0])
def test_depth_of_another_unit_is_not_used(views, factor):
    found = measured_surface([replace(view, depth=factor * view.depth) for view in views])
    assert found.confirmed < 0.3 and len(found.xyz) == 0
    assert not any(view.depth.any() for view in found.trusted_views())


def test_depth_that_others_confirm_by_chance_alone_is_not_used(views):
    rng = torch.Generator().manual_seed(0)
    factors = (0.5 * torch.randn(len(views), generator=rng)).exp()
    found = measured_surface([replace(v, depth=f * v.depth) for v, f in zip(views, factors, strict=True)])
    assert 0.02 < found.confirmed < 0.3 and len(found.xyz) == 0
    assert not any(view.depth.any() for view in found.trusted_views())


def test_steps_have_no_normals(views):
    """A near plate before a far one: along its rim neighbours lie on both."""
    depth = torch.full((8, 9), 3.0)
    depth[:, :5] = 1.0
    normals = _normals(views[0], depth, stride=3)
    known = normals.norm(dim=-1) > 0
    assert not known[:, 4:6].any() and not known[0].any() and not known[:, -1].any()
    assert known[1:-1, 1:4].all() and known[1:-1, 6:-1].all()
    assert torch.allclose(normals[known], torch.tensor([0.0, 0.0, -1.0]), atol=1e-5)


def test_what_no_view_knows_is_not_found(views):
    none = [replace(view, depth=torch.zeros_like(view.depth)) for view in views]
    found = measured_surface(none)
    assert len(found.xyz) == 0 and not any(view.depth.any() for view in found.trusted_views())
    without = [replace(view, depth=None) for view in views]
    assert measured_surface(without).trusted_views() == without and measured_surface(without).confirmed == 1
    assert len(measured_surface([]).xyz) == 0
    masked = [replace(view, mask=torch.zeros(PIXELS, PIXELS, dtype=torch.bool)) for view in views]
    assert len(measured_surface(masked).xyz) == 0


def test_some_frames_may_lack_a_depth(views):
    half = [replace(view, depth=None) if k % 2 else view for k, view in enumerate(views)]
    found = measured_surface(half)
    assert len(found.xyz) > 400 and found.confirmed > 0.9
    assert [view.depth is None for view in found.trusted_views()] == [k % 2 == 1 for k in range(len(views))]
    voxels, size = visual_hull(half)
    at_surface = (voxels.norm(dim=-1) - RADIUS).abs() < size
    assert found.judged(voxels[at_surface], size)[1].median() < 0.2  # blank in few of those that have a depth


@pytest.mark.parametrize("count, finds", [(0, False), (1, False), (2, True), (3, True)])
def test_a_single_depth_is_not_believed_and_two_are(views, count, finds):
    few = [view if k < count else replace(view, depth=None) for k, view in enumerate(views)]
    found = measured_surface(few)
    assert (len(found.xyz) > 50) == finds
    assert len(found.trusted_views()) == len(views)


def test_what_views_see_past_and_none_sees_is_passed(views, found):
    points = torch.cat([F.normalize(found.xyz, dim=-1) * (RADIUS + up) for up in (0.25, 0.2, 0.005, -0.2)])
    wide = torch.full((len(points),), 0.1)
    passed = found.passed(points, wide, 0.01).view(4, -1).float().mean(-1)
    assert passed[:2].amin() > 0.85 and passed[2:].amax() == 0
    assert not found.passed(points, wide / 10, 0.01).any()  # cells miss what is so narrow
    # But for what one view sees there.
    row, column, z, inside = cells(views[3], points[:1], found.stride)
    depth = found.depth.clone()
    depth[3, row, column] = z
    assert inside and not replace(found, depth=depth).passed(points[:1], wide[:1], 0.01)
    assert not SeenSurface.nothing(views).passed(points, wide, 0.01).any()


def test_gaussians_start_on_what_is_measured(views):
    hull = visual_hull(views)
    points = seed_points(views, 1, 1000, torch.Generator().manual_seed(0), hull, seen_surface(views, *hull))
    assert (points.xyz.norm(dim=-1) - RADIUS).abs().quantile(0.9) < 0.01
    assert (points.normals.norm(dim=-1) > 0).float().mean() > 0.7


def test_the_loss_is_the_mean_distance_where_depth_is_known():
    seen = torch.zeros(4, 6)
    seen[1, 2], seen[3, 5] = 2.0, 3.0
    depth, accumulation = torch.full((4, 6), 2.5), torch.full((4, 6), 0.5)
    accumulation[3, 5] = 1.0
    assert float(depth_loss(depth, accumulation, seen)) == pytest.approx((0.5 * 0.5 + 0.5) / 24)
    assert float(depth_loss(depth, accumulation, torch.zeros(4, 6))) == 0
