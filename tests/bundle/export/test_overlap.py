import pytest
import trimesh

from splatart_ns.bundle.export.overlap import common_ball, overlaps


def box(x, size=1.0):
    return trimesh.creation.box([size] * 3).apply_translation([x, 0, 0])


@pytest.mark.parametrize(("x", "radius"), [(0.0, 0.5), (0.8, 0.1), (1.0, 0.0), (1.5, 0.0)])
def test_the_largest_common_ball_of_two_boxes(x, radius):
    assert common_ball(box(0), box(x)) == pytest.approx(radius, abs=1e-7)


def test_boxes_about_bodies_may_overlap_where_the_bodies_do_not():
    ball = trimesh.creation.icosphere(radius=1.0)
    assert common_ball(ball, ball.copy().apply_translation([1.5, 1.5, 1.5])) == 0
    assert common_ball(ball, ball.copy().apply_translation([1.0, 1.0, 1.0])) > 0.1


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_the_unit_does_not_matter(scale):
    assert common_ball(box(0, scale), box(0.8 * scale, scale)) == pytest.approx(0.1 * scale)


def test_neighbours_are_skipped_and_others_reported():
    bodies = {"a": [box(0)], "b": [box(0.8)], "c": [box(5), box(1.6)], "empty": []}
    assert overlaps(bodies, {frozenset(("b", "a"))}) == {("b", "c"): pytest.approx(0.1)}
