import numpy as np
import pytest
import trimesh

from splatart_ns.capture.surface import Surface, join, merge_coincident, smooth_normals

TRIANGLE = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
RED = np.full((2, 2, 3), (255, 0, 0), dtype=np.uint8)


def test_opposite_faces_on_the_same_points_become_two_sides_of_one_triangle():
    front, back = Surface.of(TRIANGLE), Surface.of(TRIANGLE[:, [1, 0, 2]])
    away = Surface.of(TRIANGLE + 5.0)
    merged = merge_coincident(join([front, back, away]))
    assert len(merged.triangles) == 2
    assert sorted(sorted(pair) for pair in merged.sides.tolist()) == [[0, 1], [2, 2]]


def test_a_textured_face_shows_before_a_plain_one_with_the_same_winding():
    uv = np.zeros((1, 3, 2))
    merged = merge_coincident(join([Surface.of(TRIANGLE), Surface.of(TRIANGLE[:, [1, 2, 0]], uv, texture=RED)]))
    assert merged.sides.tolist() == [[1, 1]]


def test_joining_keeps_a_shared_texture_once():
    uv = np.zeros((1, 3, 2))
    both = join([Surface.of(TRIANGLE, uv, texture=RED), Surface.of(TRIANGLE + 1.0, uv, texture=RED.copy())])
    assert len(both.textures) == 1
    assert both.texture.tolist() == [0, 0]


def test_samples_fall_by_area_and_within_the_triangles():
    surface = join([Surface.of(TRIANGLE), Surface.of(TRIANGLE * 3.0 + [0.0, 0.0, 1.0])])
    points = surface.sample(20_000, np.random.default_rng(0))
    large = points[:, 2] > 0.5
    assert large.mean() == pytest.approx(0.9, abs=0.01)
    assert (points[:, :2] >= 0.0).all()
    assert points[large][:, :2].sum(axis=1).max() <= 3.0
    assert points[large][:, :2].mean(axis=0) == pytest.approx([1.0, 1.0], abs=0.02)


def test_both_sides_of_a_triangle_are_sampled_as_one():
    pair = join([Surface.of(TRIANGLE), Surface.of(TRIANGLE[:, ::-1])])
    merged = merge_coincident(join([pair, Surface.of(TRIANGLE + 5.0)]))
    points = merged.sample(10_000, np.random.default_rng(0))
    assert (points[:, 2] > 1.0).mean() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (2.0, 1.0, 0.5), (-1.0, 1.0, 1.0)])
def test_moving_keeps_normals_outward(scale):
    sphere = trimesh.creation.icosphere(subdivisions=2)
    surface = Surface.of(sphere.vertices[sphere.faces]).moved(np.diag([*scale, 1.0]))
    corners = surface.corners
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fk,fk->f", flat, corners.mean(axis=1)) > 0.0).all()
    assert np.linalg.norm(surface.normals, axis=-1) == pytest.approx(1.0)
    # The normal of an ellipsoid.
    expected = corners / np.square(scale)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    assert np.einsum("fck,fck->fc", expected, surface.normals).min() > 0.98


def test_normals_are_smooth_on_a_sphere_and_sharp_on_a_box():
    sphere = trimesh.creation.icosphere(subdivisions=3)
    corners = sphere.vertices[sphere.faces]
    assert np.einsum("fck,fck->fc", smooth_normals(corners), corners).min() > 0.999
    box = trimesh.creation.box()
    normals = smooth_normals(box.vertices[box.faces])
    assert np.abs(normals).max(axis=-1) == pytest.approx(1.0)


def test_faces_without_area_are_left_out():
    flat = np.concatenate([TRIANGLE, np.zeros((1, 3, 3))])
    assert len(Surface.of(flat).corners) == 1
