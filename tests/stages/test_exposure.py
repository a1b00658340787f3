from dataclasses import replace

import pytest
import torch
from part_scene import box, photograph

from splatart_ns.splats.splat import Splat
from splatart_ns.stages.exposure import FRAMES, at_gain, frame_gains, unevenness


@pytest.fixture(scope="module")
def scene():
    splat = Splat.cat([box(1, (0.9, 0.6, 0.3), (0.0, 0.0, -0.3)), box(2, (0.7, 0.4, 0.12), (0.1, 0.0, 0.2))])
    return splat, photograph(splat)


def exposed(views, gains):
    return [replace(v, rgb=at_gain(v.rgb, 1 / g)) for v, g in zip(views, gains, strict=True)]


def test_frames_of_another_exposure_and_white_balance_are_told(scene):
    splat, views = scene
    gains = 0.7 + 0.6 * torch.rand(len(views), 3, generator=torch.Generator().manual_seed(0))
    found = frame_gains(splat, exposed(views, gains))
    assert torch.allclose(found, gains / gains.log().mean(0).exp(), rtol=0.05)


def test_gains_are_undone_up_to_what_all_frames_share(scene):
    splat, views = scene
    gains = torch.linspace(0.7, 1.3, len(views))[:, None].expand(-1, 3)
    found = frame_gains(splat, exposed(views, gains))
    evened = exposed(exposed(views, gains), 1 / found)
    assert float(frame_gains(splat, evened).log().abs().max()) < 0.02


def test_exact_frames_need_no_gain(scene):
    splat, views = scene
    assert float(frame_gains(splat, views).log().abs().max()) < 0.02


def test_a_frame_that_is_cut_off_everywhere_tells_no_gain(scene):
    splat, views = scene
    dimmed = exposed(views, [torch.full((3,), 0.5)] * len(views))
    white = [replace(v, rgb=torch.full_like(v.rgb, 255)) if k == 0 else v for k, v in enumerate(dimmed)]
    assert torch.allclose(frame_gains(splat, white), torch.ones(len(views), 3), rtol=0.02)
    assert torch.equal(frame_gains(splat, white[:1]), torch.ones(1, 3))


def test_a_dark_channel_tells_no_gain(scene):
    """What rounding leaves of it may be twice what the splat shows."""
    splat, views = scene
    red = replace(splat, sh=splat.sh - torch.tensor([0.0, 3.0, 3.0]))
    faint = [
        replace(v, rgb=v.rgb * torch.tensor([1, 0, 0], dtype=torch.uint8) + 2 * (k % 2)) for k, v in enumerate(views)
    ]
    assert float(frame_gains(red, faint)[:, 1:].log().std()) < 0.02


def test_frames_that_differ_by_chance_are_uneven(scene):
    views = 2 * scene[1]
    logs = 0.15 * torch.randn(len(views), 3, generator=torch.Generator().manual_seed(0))
    for count in (10, 20):
        assert unevenness(logs[:count].exp(), views[:count]) == pytest.approx(0.15, rel=0.25)


def test_of_few_frames_what_the_direction_of_view_takes_up_by_chance_counts(scene):
    views = (2 * scene[1])[:FRAMES]
    logs = 0.15 * torch.randn(200, FRAMES, 3, generator=torch.Generator().manual_seed(0))
    found = torch.tensor([unevenness(gains.exp(), views) for gains in logs])
    assert float(found.mean()) == pytest.approx(0.15, rel=0.1)


def test_light_from_one_side_does_not_make_frames_uneven(scene):
    views = 2 * scene[1]
    light = torch.stack([v.viewmat[2, :3] @ torch.tensor([0.3, -0.2, 0.1]) for v in views])
    assert float(light.std()) > 0.15
    assert unevenness(light.exp()[:, None].expand(-1, 3), views) < 1e-3


def test_frames_all_from_one_direction_are_as_uneven_as_their_gains(scene):
    views = 20 * scene[1][:1]
    logs = 0.15 * torch.randn(len(views), 3, generator=torch.Generator().manual_seed(0))
    assert unevenness(logs.exp(), views) == pytest.approx(0.15, rel=0.25)


def test_a_frame_that_shows_what_is_not_learned_yet_does_not_make_the_others_uneven(scene):
    views = 2 * scene[1]
    gains = torch.ones(len(views), 3)
    gains[3] = torch.tensor([0.8, 0.7, 0.2])
    assert float(gains.log().std()) > 0.1
    assert unevenness(gains, views) < 0.06


def test_an_image_keeps_its_type():
    image = torch.tensor([[[100, 200, 50]]], dtype=torch.uint8)
    gain = torch.tensor([0.5, 0.5, 2.0])
    assert at_gain(image, gain).tolist() == [[[200, 255, 25]]]
    assert torch.allclose(at_gain(image / 255, gain), torch.tensor([[[200 / 255, 1.0, 25 / 255]]]))


def test_what_a_mask_leaves_out_tells_no_gain(scene):
    """A dark hand before a half of every other frame."""
    splat, views = scene
    masks = [torch.arange(v.width).expand(v.height, -1) >= (v.width // 2 if k % 2 else 0) for k, v in enumerate(views)]
    before = [replace(v, rgb=torch.where(m[..., None], v.rgb, 9), mask=m) for v, m in zip(views, masks, strict=True)]
    assert float(frame_gains(splat, before).log().abs().max()) < 0.05
    unmasked = [replace(v, mask=None) for v in before]
    assert float(frame_gains(splat, unmasked).log().abs().max()) > 0.2
