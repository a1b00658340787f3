import numpy as np
import pytest
import trimesh

from splatart_ns.bundle.export.inertia import MIN_MASS, solid_inertia


def is_physical(inertia):
    a, b, c = np.linalg.eigvalsh(inertia.tensor)
    return a > 0 and a + b >= c * (1 - 1e-9) and inertia.mass > 0


def test_of_a_box_as_in_the_textbook():
    box = trimesh.creation.box([2.0, 1.0, 0.5]).apply_translation([3, 4, 5])
    inertia = solid_inertia(box, (), density=100.0)
    assert inertia.mass == pytest.approx(100)
    np.testing.assert_allclose(inertia.centre, [3, 4, 5])
    expected = 100 / 12 * np.diag([1 + 0.25, 4 + 0.25, 4 + 1])
    np.testing.assert_allclose(inertia.tensor, expected, atol=1e-3)


def test_of_pieces_where_the_surface_is_open():
    whole = trimesh.creation.box([2.0, 1.0, 0.5])
    opened = trimesh.Trimesh(whole.vertices, whole.faces[1:], process=False)
    halves = [trimesh.creation.box([1.0, 1.0, 0.5]).apply_translation([x, 0, 0]) for x in (-0.5, 0.5)]
    closed, split = solid_inertia(whole, (), 10.0), solid_inertia(opened, halves, 10.0)
    assert split.mass == pytest.approx(closed.mass)
    np.testing.assert_allclose(split.tensor, closed.tensor, atol=1e-9)


@pytest.mark.parametrize("size", [[1e-5] * 3, [1.0, 1e-7, 1e-7], [1.0, 1.0, 1e-6]], ids=["speck", "needle", "foil"])
def test_tiny_and_thin_bodies_have_a_physical_inertia(size):
    box = trimesh.creation.box(size)
    inertia = solid_inertia(box, (box,), 400.0)
    assert inertia.mass >= MIN_MASS
    assert is_physical(inertia)


def test_a_surface_turned_inside_out_is_not_trusted():
    box = trimesh.creation.box([1.0, 1.0, 1.0])
    inside_out = trimesh.Trimesh(box.vertices, box.faces[:, ::-1], process=False)
    inertia = solid_inertia(inside_out, (box,), 1.0)
    assert inertia.mass == pytest.approx(1.0)
    assert is_physical(inertia)


def test_nothing_is_a_small_ball():
    inertia = solid_inertia(None, (), 400.0)
    assert inertia.mass == MIN_MASS
    assert is_physical(inertia)
