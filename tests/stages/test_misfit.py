from dataclasses import replace

import torch
from part_scene import box, photograph

from splatart_ns.stages.misfit import FAR, HARDLY, misfit


def test_a_splat_that_is_moved_is_far_from_its_images():
    splat = box(1, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    views = photograph(splat, 20)
    assert misfit(splat, views) < 0.1 * HARDLY
    assert misfit(replace(splat, means=splat.means + 0.2), views) > FAR * HARDLY
    masked = [replace(view, mask=torch.zeros(view.height, view.width, dtype=torch.bool)) for view in views]
    assert misfit(replace(splat, means=splat.means + 0.2), masked) == 0
