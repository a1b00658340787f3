import numpy as np
import pytest
import torch
from tray_scene import photograph, to_tray

from splatart_ns.stages import planar_region, stereo
from splatart_ns.stages.hull import surface, visual_hull
from splatart_ns.stages.stereo import stereo_surface

pytest.importorskip("numba", reason="stereo is found by numba kernels")


def plain(x, normal):
    """Grey of the tray's sides, each its own; the bottom's is another than the floor's."""
    return 120 + normal @ np.array([30, 50, 40]) + 15 * (x[..., 2] < -0.2)


@pytest.fixture(scope="module")
def views():
    return photograph(plain)


@pytest.fixture(scope="module")
def hull(views):
    voxels, size = visual_hull(views)
    return voxels[surface(voxels, size)], size


@pytest.fixture(scope="module")
def found(views, hull):
    return stereo_surface(views, *hull)


@pytest.fixture(scope="module")
def by_stereo(views, hull):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stereo, "with_planes", alone)
        return stereo_surface(views, *hull)


def alone(views, others, found, *_):
    return found


def inside(points):
    """Well within the outline from above [N] bool."""
    return (points[:, :2].abs() < 0.3).all(-1)


def on(found, z, up):
    """How many places with a normal along z `up` lie at this height."""
    return int((inside(found.xyz) & ((found.xyz[:, 2] - z).abs() < 0.02) & (up * found.normals[:, 2] > 0.95)).sum())


def test_sides_of_one_colour_are_found(found, by_stereo):
    for z, up in ((-0.25, 1), (-0.3, -1)):
        assert on(found, z, up) > 75 and on(by_stereo, z, up) < 10
    assert to_tray(found.xyz).median() < 0.012


def test_planes_are_told_by_what_other_views_see_there(views, hull, found, by_stereo, monkeypatch):
    """Over the opening there is one through the rim."""

    def above(surface):
        return int((inside(surface.xyz) & (surface.xyz[:, 2] > -0.15)).sum())

    for name in ("_UNLIKE", "_PLACE_UNLIKE", "_PASSED"):
        monkeypatch.setattr(planar_region, name, 100)
    assert above(found) < above(by_stereo) + 20 < above(stereo_surface(views, *hull)) - 40


def test_a_hollow_is_passed_and_surfaces_are_not(hull, found, by_stereo):
    x, y, z = torch.linspace(-0.3, 0.3, 7), torch.linspace(-0.2, 0.2, 3), torch.linspace(-0.1, 0.1, 5)
    hollow, wide = torch.cartesian_prod(x, y, z), torch.tensor(0.1)
    shares = [surface.passed(hollow, wide, hull[1]).float().mean() for surface in (found, by_stereo)]
    assert shares[0] > 0.93 > shares[1]
    assert not found.passed(found.xyz[to_tray(found.xyz) < 0.01], wide, hull[1]).any()
