import math
from dataclasses import replace

import pytest
import torch
from tray_scene import photograph, texture, textured, to_tray

from splatart_ns.capture.seen_surface import agreed, neighbours
from splatart_ns.capture.view import View
from splatart_ns.stages import stereo
from splatart_ns.stages.hull import _places, seed_points, seen_surface, surface, visual_hull
from splatart_ns.stages.stereo import stereo_surface

pytest.importorskip("numba", reason="stereo is found by numba kernels")


@pytest.fixture(scope="module")
def views() -> list[View]:
    return photograph(textured(40))


@pytest.fixture(scope="module")
def hull(views):
    return visual_hull(views)


def outer(hull):
    voxels, size = hull
    return voxels[surface(voxels, size)], size


@pytest.fixture(scope="module")
def found(views, hull):
    return stereo_surface(views, *outer(hull))


def test_points_lie_on_walls_and_on_the_floor_of_a_hollow(found):
    assert len(found.xyz) > 2000
    distance = to_tray(found.xyz)
    assert distance.median() < 0.006 and distance.quantile(0.95) < 0.03
    on_floor = (found.xyz[:, :2].abs() < 0.3).all(-1) & (found.xyz[:, 2] > -0.28)
    assert on_floor.sum() > 50  # the hull is 0.4 higher there
    assert (found.xyz[on_floor, 2] + 0.25).abs().median() < 0.01


def test_points_have_the_colour_of_their_place(found):
    wrong = found.rgb[:, 0] - (128 + 40 * torch.from_numpy(texture(found.xyz.double().numpy())))
    assert wrong.abs().median() < 5


def test_a_depth_that_no_other_view_finds_does_not_count(views, found):
    others = neighbours(torch.stack([v.viewmat for v in views]).double(), torch.zeros(3, dtype=torch.float64))
    depth = found.depth.clone()
    depth[5] *= 1.1
    again = agreed(views, others, depth, torch.zeros(*depth.shape, 3), found.stride)
    assert again.depth[5].isfinite().sum() < 0.2 * depth[5].isfinite().sum()
    assert again.depth[9].isfinite().sum() > 0.9 * depth[9].isfinite().sum()


def test_normals_point_to_who_looks(views, found):
    assert torch.allclose(found.normals.norm(dim=-1), torch.ones(len(found.normals)), atol=1e-5)
    assert (found.normals.abs().amax(-1) > math.cos(math.radians(15))).float().mean() > 0.85  # along an axis
    above = (found.xyz[:, :2].abs() < 0.3).all(-1) & (found.xyz[:, 2] > -0.28)
    assert (found.normals[above, 2] > 0.9).float().mean() > 0.85
    below = (found.xyz[:, :2].abs() < 0.3).all(-1) & (found.xyz[:, 2] < -0.28)
    assert (found.normals[below, 2] < -0.9).float().mean() > 0.85


def test_a_hollow_is_free_and_walls_are_not(hull, found):
    voxels, size = hull
    free, blank = found.judged(voxels, size)
    in_hollow = (voxels[:, :2].abs() < 0.3).all(-1) & (voxels[:, 2] > -0.15) & (voxels[:, 2] < 0.1)
    assert in_hollow.sum() > 1000 and free[in_hollow].float().mean() > 0.9
    assert free[to_tray(voxels) < 0.5 * size].float().mean() < 0.02
    assert blank.median() < 0.2


def test_seed_points_start_on_the_surface_that_is_found(views, hull, found):
    points = seed_points(views, 1, 3000, torch.Generator().manual_seed(0), hull, seen_surface(views, *hull))
    assert to_tray(points.xyz).quantile(0.8) < 0.02
    on_surface = points.normals.norm(dim=-1) > 0
    assert on_surface.float().mean() > 0.8
    assert points.rgb.std() > 5 and points.rgb.isfinite().all()
    # Beside a place that was found, but not before or behind it.
    xyz, normals = points.xyz[on_surface], points.normals[on_surface]
    same = (normals[:200, None] == found.normals).all(-1)
    off = ((xyz[:200, None] - found.xyz) * normals[:200, None]).sum(-1).abs().where(same, torch.tensor(torch.inf))
    assert off.amin(1).max() < 1e-5 and torch.cdist(xyz[:200], found.xyz).amin(1).max() > 1e-4
    again = seed_points(views, 1, 3000, torch.Generator().manual_seed(0), hull, seen_surface(views, *hull))
    assert torch.equal(points.xyz, again.xyz)


def test_every_voxel_is_left_to_parts_that_have_no_other_places(hull, found):
    places = _places(*hull, found)
    voxel = places.rgb.isnan().all(-1)
    assert (places.weight > 0).all()
    beside = voxel & (to_tray(places.xyz) < hull[1])
    assert places.weight[beside].median() <= 1e-5 < places.weight[~voxel].min()


def test_plain_walls_are_not_found(hull):
    assert len(stereo_surface(photograph(textured(0)), *outer(hull)).xyz) == 0


def test_faint_textures_are_found(hull, found):
    faint = stereo_surface(photograph(textured(4)), *outer(hull))
    assert len(faint.xyz) > 0.5 * len(found.xyz)
    assert to_tray(faint.xyz).median() < 0.01


def test_masked_pixels_find_nothing(views, hull):
    masked = [replace(view, mask=torch.zeros(128, 128, dtype=torch.bool)) for view in views]
    assert len(stereo_surface(masked, *outer(hull)).xyz) == 0
    half = torch.arange(128) < 64
    masked = [replace(view, mask=half.expand(128, 128)) for view in views]
    assert 0 < len(stereo_surface(masked, *outer(hull)).xyz) < 15_000


def test_threads_do_not_change_what_is_found(views, hull, found):
    threads = torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            again = stereo_surface(views, *outer(hull))
            assert torch.equal(again.xyz, found.xyz) and torch.equal(again.normals, found.normals)
    finally:
        torch.set_num_threads(threads)


def test_images_of_several_sizes_are_matched(views, hull):
    half = torch.tensor([[0.5], [0.5], [1.0]])
    mixed = [
        replace(v, K=half * v.K, width=64, height=64, rgb=v.rgb[::2, ::2], alpha=v.alpha[::2, ::2]) if i % 2 else v
        for i, v in enumerate(views)
    ]
    surface = stereo_surface(mixed, *outer(hull))
    assert len(surface.xyz) > 1000 and to_tray(surface.xyz).median() < 0.02


@pytest.mark.parametrize("pixels", [1, 2, 4])
def test_images_of_a_few_pixels_do_no_harm(hull, pixels):
    found = stereo_surface(photograph(textured(40), pixels=pixels), *outer(hull))
    assert found.xyz.isfinite().all() and not found.judged(*hull)[0].all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_views_find_nothing(views, hull, count):
    surface = stereo_surface(views[:count], *outer(hull))
    assert len(surface.xyz) == 0 and not surface.judged(*hull)[0].any()
    assert (surface.judged(*hull)[1] == 1).all()


def test_without_numba_points_start_in_and_on_the_hull(views, hull, monkeypatch):
    monkeypatch.setattr(stereo, "has_numba", lambda: False)
    assert len(stereo_surface(views, *outer(hull)).xyz) == 0
    points = seed_points(views, 1, 1000, torch.Generator().manual_seed(0), hull, seen_surface(views, *hull))
    assert (points.normals == 0).all() and points.rgb.isfinite().all() and len(points.xyz) >= 1000
    # The hollow is full of them.
    assert ((points.xyz[:, :2].abs() < 0.3).all(-1) & (points.xyz[:, 2] > -0.1)).sum() > 50
