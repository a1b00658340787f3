import math

import cv2
import numpy as np
import pytest
import trimesh

from splatart_ns.capture.capture import Camera
from splatart_ns.capture.light import Light
from splatart_ns.capture.ray_caster import RayCaster
from splatart_ns.capture.surface import Surface, join, merge_coincident

CAMERA = Camera(100.0, 100.0, 32.0, 32.0, 64, 64)
SKY = Light(direction=(0.0, 0.0, 1.0), ambient=1.0, shadows=False)


def above(height, camera_x=0.0):
    """A camera that looks straight down; x runs to the right and y up in its image."""
    T = np.eye(4)
    T[:3, 3] = (camera_x, 0.0, height)
    return T


def of_mesh(mesh):
    return Surface.of(np.asarray(mesh.vertices)[np.asarray(mesh.faces)])


def square(z=0.0, half=1.0, **kwargs):
    x, y = (-half, half, half, -half), (-half, -half, half, half)
    corners = np.stack([x, y, np.full(4, z)], axis=-1)
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=float)
    faces = np.array([(0, 1, 2), (0, 2, 3)])
    return Surface.of(corners[faces], uv[faces], **kwargs)


def test_a_sphere_is_a_disc_of_the_right_size_at_the_right_depth():
    seen = RayCaster({3: of_mesh(trimesh.creation.icosphere(subdivisions=5))}).render(CAMERA, above(5.0), SKY)
    radius = 100.0 * math.tan(math.asin(1.0 / 5.0))
    y, x = np.mgrid[:64, :64] + 0.5
    distance = np.hypot(x - 32.0, y - 32.0)
    assert (seen.part_ids[distance < radius - 0.2] == 3).all()
    assert (seen.part_ids[distance > radius + 0.2] == 0).all()
    assert (seen.silhouette == (seen.part_ids == 3)).all()
    assert seen.depth[32, 32] == pytest.approx(4.0, abs=1e-3)
    assert seen.depth[0, 0] == 0.0
    coverage = seen.rgba[..., 3].astype(float).sum() / 255.0
    assert coverage == pytest.approx(math.pi * radius**2, rel=0.01)


def test_edges_are_partly_covered_with_the_colour_not_darkened():
    # The square's edge lies at a quarter of a pixel.
    colour = np.broadcast_to([0.0, 1.0, 0.0], (2, 3, 3))
    caster = RayCaster({1: square(half=0.5125, colours=colour)})
    seen = caster.render(CAMERA, above(5.0), SKY, samples=4)
    edge = seen.rgba[32, 42]
    assert edge[3] == 64
    assert edge[:3].tolist() == seen.rgba[32, 32, :3].tolist()
    assert seen.rgba[32, 50].tolist() == [255, 255, 255, 0]


def test_depth_is_along_the_optical_axis_not_the_ray():
    seen = RayCaster({1: square()}).render(CAMERA, above(2.0), SKY)
    assert seen.depth[2, 2] == pytest.approx(2.0, abs=1e-5)


def test_the_nearer_part_hides_the_other():
    caster = RayCaster({1: square(z=0.0), 2: square(z=0.5, half=0.2)})
    assert caster.render(CAMERA, above(5.0), SKY).part_ids[32, 32] == 2
    assert caster.render(CAMERA, above(5.0), SKY).part_ids[32, 42] == 1
    below = above(-5.0) @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert caster.render(CAMERA, below, SKY).part_ids[32, 32] == 1


def test_a_texture_is_the_right_way_up():
    texture = np.zeros((2, 2, 3), dtype=np.uint8)
    texture[0, 0], texture[0, 1], texture[1, 0], texture[1, 1] = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0)
    seen = RayCaster({1: square(texture=texture)}).render(CAMERA, above(5.0), SKY)
    # Half way to a corner, the texel's own centre.
    assert np.argmax(seen.rgba[22, 22, :3]) == 0
    assert np.argmax(seen.rgba[22, 42, :3]) == 1
    assert np.argmax(seen.rgba[42, 22, :3]) == 2
    assert seen.rgba[42, 42, :2].min() > 200


def test_a_texture_far_away_is_averaged():
    checks = (np.indices((256, 256)).sum(axis=0) % 2 * 255).astype(np.uint8)
    caster = RayCaster({1: square(texture=np.repeat(checks[..., None], 3, axis=2))})
    far = caster.render(CAMERA, above(5.0), SKY, samples=1).rgba
    inside = far[20:44, 20:44, 0].astype(float)
    assert inside.std() < 4.0
    assert inside.mean() == pytest.approx(127.5, abs=4.0)


def test_each_side_of_a_pair_of_faces_shows_its_own_material():
    red, blue = (np.broadcast_to(c, (2, 3, 3)) for c in ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    front = square(colours=red)
    back = Surface.of(front.corners[:, [0, 2, 1]], colours=blue)
    caster = RayCaster({1: merge_coincident(join([back, front]))})
    below = above(-5.0) @ np.diag([1.0, -1.0, -1.0, 1.0])
    from_above = caster.render(CAMERA, above(5.0), SKY).rgba[24:40, 24:40, :3].reshape(-1, 3)
    from_below = caster.render(CAMERA, below, SKY).rgba[24:40, 24:40, :3].reshape(-1, 3)
    assert from_above[:, 0].min() > 200 and from_above[:, 2].max() == 0
    assert from_below[:, 2].min() > 200 and from_below[:, 0].max() == 0


def test_sunlight_follows_the_cosine():
    brightness = []
    for degrees in (0.0, 60.0, 120.0):
        sun = (math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees)))
        caster = RayCaster({1: square()})
        brightness.append(caster.render(CAMERA, above(5.0), Light(sun, ambient=0.0)).rgba[32, 32, 0])
    assert brightness == pytest.approx([255, 127.5, 0], abs=1.0)


@pytest.mark.parametrize("shadows", [True, False])
def test_a_shadow_falls_where_the_sun_is_hidden(shadows):
    # The light comes at 45 degrees from +x, so the small square's shadow lies at x = -0.5.
    caster = RayCaster({1: square(), 2: square(z=0.5, half=0.1)})
    seen = caster.render(CAMERA, above(5.0), Light((1.0, 0.0, 1.0), ambient=0.2, shadows=shadows)).rgba[..., 0]
    shaded, open_ground = int(seen[32, 22]), int(seen[32, 42])
    assert (shaded < 0.5 * open_ground) if shadows else (shaded == open_ground)


def test_a_distorted_camera_sees_points_where_opencv_projects_them():
    camera = Camera(60.0, 58.0, 33.0, 30.0, 64, 64, distortion=(-0.2, 0.05, 0.0, 0.0, 0.004, -0.003))
    spots = [(0.9, 0.7), (-0.8, 0.5), (0.6, -0.9), (0.0, 0.0)]
    marks = {
        i: of_mesh(trimesh.creation.box((0.04, 0.04, 0.01)).apply_translation((x, y, 0.0)))
        for i, (x, y) in enumerate(spots, start=1)
    }
    seen = RayCaster(marks).render(camera, above(2.0), SKY)
    k1, k2, _, _, p1, p2 = camera.distortion
    points = np.array([(x, -y, 2.0) for x, y in spots])  # OpenCV axes
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, np.array([k1, k2, p1, p2]))
    for i, pixel in enumerate(expected[:, 0], start=1):
        rows, columns = np.nonzero(seen.part_ids == i)
        assert np.allclose([columns.mean() + 0.5, rows.mean() + 0.5], pixel, atol=0.5)
