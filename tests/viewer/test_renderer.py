import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatart_ns.bundle.animation import bundle_colours, render_frames
from splatart_ns.bundle.articulated_splat import ArticulatedSplat
from splatart_ns.bundle.camera import bounding_sphere, orbit_camera
from splatart_ns.geometry.se3 import quat_from_matrix
from splatart_ns.viewer.renderer import Eye, Renderer

SIZE = 96


@pytest.fixture
def view(bundle):
    return orbit_camera(*bounding_sphere(bundle, [{}]), 0.6, 0.4, SIZE, SIZE)


@pytest.fixture
def splat(bundle):
    return ArticulatedSplat(bundle)


@pytest.fixture
def eye(view, splat):
    T = splat.normalization.camera_to_normal(view.T_world_camera.numpy())
    R = torch.from_numpy(T[:3, :3] * [1, -1, -1])
    fov = 2 * math.atan(SIZE / 2 / view.K[0, 0])
    return Eye(quat_from_matrix(R).numpy(), T[:3, 3], fov, 1.0)


@pytest.mark.parametrize("q", [{}, {"hinge": -0.7, "runner": 0.3}])
def test_the_viewer_shows_what_render_writes(bundle, view, eye, q):
    lid = bundle.parts[1]
    tail = 0.3 * torch.randn(len(lid.splat), 3, 3, generator=torch.Generator().manual_seed(1))
    lid.splat = replace(lid.splat, sh=torch.cat([lid.splat.sh, tail], 1))  # its colours depend on the view
    splat = ArticulatedSplat(bundle)
    (expected,) = render_frames(splat, [q], view)
    shown = Renderer(splat).image(q, eye, SIZE)
    difference = np.abs(shown.astype(int) - expected)
    assert difference.max() <= 3 and difference.mean() < 0.1
    assert expected.std() > 30


def test_a_hidden_part_is_not_seen(bundle, splat, eye):
    renderer, still = Renderer(splat), {}
    green = [np.all(renderer.image(still, eye, SIZE, hidden) == [0, 255, 0], axis=-1).sum() for hidden in ([], ["lid"])]
    assert green[0] > 200 and green[1] == 0


def test_parts_are_shown_in_their_colours(bundle, splat, eye):
    image = Renderer(splat).image({}, eye, SIZE, hidden=["base", "drawer"], by_part=True)
    seen = image[(image != 255).any(-1)].astype(float)
    darkest = seen[seen.sum(1).argmin()]
    expected = bundle_colours(bundle)[1].numpy()
    assert darkest / np.linalg.norm(darkest) == pytest.approx(expected / np.linalg.norm(expected), abs=0.05)


def test_without_any_part_the_image_is_white(bundle, splat, eye):
    image = Renderer(splat).image({}, replace(eye, aspect=2.0), 10, bundle.part_names)
    assert image.shape == (10, 20, 3) and (image == 255).all()


def test_a_selected_part_stands_out(splat, eye):
    renderer = Renderer(splat)
    for by_part in (False, True):
        plain, selected = (renderer.image({}, eye, SIZE, (), by_part, name).astype(int) for name in (None, "lid"))
        lid = np.abs(plain - renderer.image({}, eye, SIZE, ["lid"], by_part)).max(-1) > 100
        base = (plain.min(-1) < 150) & ~lid
        assert lid.sum() > 100 and base.sum() > 100
        assert np.abs(selected - plain)[lid].mean() < 25 and (selected - plain)[base].min(-1).mean() > -1
        assert (selected - plain)[base].max(-1).mean() > 80


@pytest.mark.parametrize("q", [{}, {"hinge": -0.7, "runner": 0.3}])
def test_the_part_at_a_place_is_the_one_that_is_shown_there(splat, view, eye, q):
    renderer = Renderer(splat)
    picture = splat.render(view, q)
    inside = (picture.part_shares.max(-1).values > 0.95) | (picture.alpha < 0.02)
    places = inside.nonzero()[:: int(inside.sum()) // 40]
    names = {0: None} | {part.id: part.name for part in splat.bundle.parts}
    expected = [names[int(picture.part_ids[row, column])] for row, column in places]
    found = [renderer.part_at(q, eye, ((column + 0.5) / SIZE, (row + 0.5) / SIZE)) for row, column in places.tolist()]
    assert found == expected and set(found) == {None, "base", "lid", "drawer"}
    assert renderer.part_at(q, eye, (0.5, 0.5), hidden=splat.part_names) is None
