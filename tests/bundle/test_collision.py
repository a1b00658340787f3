import sys

import numpy as np
import pytest
import trimesh

from splatart_ns.bundle.collision import _hull_of, convex_pieces


def tray() -> trimesh.Trimesh:
    """A box 1 x 0.6 x 0.4, open at the top, with walls 0.06 thick."""
    hollow = trimesh.creation.box((0.88, 0.48, 0.4), transform=trimesh.transformations.translation_matrix([0, 0, 0.06]))
    return trimesh.boolean.difference([trimesh.creation.box((1, 0.6, 0.4)), hollow])


def test_a_convex_body_is_one_piece():
    (piece,) = convex_pieces(trimesh.creation.box((1, 2, 3)))
    assert piece.is_watertight
    assert piece.volume == pytest.approx(6)


def test_a_round_body_has_few_vertices():
    (piece,) = convex_pieces(trimesh.creation.icosphere(4))
    assert piece.is_convex and piece.is_watertight
    assert len(piece.vertices) <= 32
    assert piece.volume > 0.75 * 4 / 3 * np.pi


def test_a_tray_stays_open():
    pytest.importorskip("coacd")
    pieces = convex_pieces(tray())
    assert len(pieces) > 1
    assert all(piece.is_watertight and piece.is_convex and len(piece.vertices) <= 32 for piece in pieces)
    inside = np.array([[0, 0, 0.1], [0.3, 0.1, 0], [-0.3, -0.1, 0.05]])
    assert not any(piece.contains(inside).any() for piece in pieces)
    assert sum(piece.volume for piece in pieces) == pytest.approx(tray().volume, rel=0.3)


def test_pieces_are_the_same_every_time():
    pytest.importorskip("coacd")
    upright = trimesh.creation.box((0.2, 0.5, 1), transform=trimesh.transformations.translation_matrix([-0.4, 0, 0.5]))
    angle = trimesh.boolean.union([trimesh.creation.box((1, 0.5, 0.2)), upright])
    first, second = convex_pieces(angle), convex_pieces(angle)
    assert len(first) > 1
    assert [p.vertices.tolist() for p in first] == [p.vertices.tolist() for p in second]


def test_without_coacd_the_hull_stands_for_the_mesh(monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "coacd", None)
    (piece,) = convex_pieces(tray())
    assert piece.volume == pytest.approx(0.24)
    assert "coacd" in caplog.text


def test_a_thin_rough_sheet_stays_whole():
    """A blade of many triangles, as marching cubes leave it, thinner than what coarsening it may move."""
    pytest.importorskip("coacd")
    blade = trimesh.creation.annulus(0.4, 0.5, 0.004, sections=128)
    blade = trimesh.boolean.intersection([blade, trimesh.creation.box((0.8, 2, 1))])
    while len(blade.faces) < 8000:
        blade = blade.subdivide()
    rough = np.random.default_rng(0).normal(scale=4e-4, size=blade.vertices.shape)
    blade.vertices += rough
    assert blade.is_volume
    points = blade.sample(500, seed=0)
    outside = [np.maximum(-trimesh.proximity.signed_distance(piece, points), 0) for piece in convex_pieces(blade)]
    assert np.min(outside, axis=0).max() < 0.02


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("twice", [False, True], ids=["a volume by rounding", "a volume of 0"])
def test_points_of_a_plane_but_for_rounding_have_no_hull(twice):
    plane = [[1.222, 1.162, 1.502], [1.223, 1.343, 1.524], [1.185, 1.105, 1.464], [1.0210000000000001, 1.301, 1.348]]
    plane += [[0.891, 1.011, 1.2040000000000002], [0.9650000000000001, 1.125, 1.28]]
    if twice:
        plane.insert(2, plane[0])
    assert _hull_of(np.array(plane)) is None
