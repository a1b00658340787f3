import torch
from part_scene import box, motion, photograph

from splatart_ns.stages.part_pair import part_pair
from splatart_ns.stages.render_choice import appearance_cost
from splatart_ns.stages.shading import hue, without_shading


def test_a_hue_does_not_depend_on_how_bright_the_light_is():
    colours = torch.tensor([[0.9, 0.5, 0.2], [0.3, 0.6, 0.7]])
    assert torch.allclose(hue(colours), hue(0.6 * colours), atol=0.06)
    assert not torch.allclose(colours, 0.6 * colours, atol=0.06)
    assert torch.allclose(hue(torch.tensor([0.2, 0.2, 0.2])), hue(torch.tensor([0.8, 0.8, 0.8])))


def test_gaussians_and_views_get_the_same_hues():
    splat = box(1, (0.8, 0.5, 0.3), (0.0, 0.0, 0.0))
    views = photograph(splat, 4)
    pair = part_pair((splat, splat), (views, views), 1, num_views=4, pixels=10000)
    motions = torch.stack([torch.eye(4, dtype=torch.float64), motion((0, 0, 10), (0.0, 0.0, 0.0))])
    right, wrong = without_shading(pair).cost(motions)
    assert right < 0.01 * wrong


def test_a_plate_that_the_light_makes_look_turned_over_is_not():
    """A sun from above dims the side that is below, and the plate has turned over."""
    plate = box(1, (1.0, 0.7, 0.1), (0.0, 0.0, 0.0))
    T = motion((180, 0, 0), (0.0, 0.0, 0.0))
    splats = []
    for splat in (plate, plate.transformed(T)):
        above = splat.means[:, 2:] > 0.02
        rgb = (0.5 + 0.28209479 * splat.sh[:, 0]) * torch.where(above, 1.0, 0.15)
        splat.sh = ((rgb - 0.5) / 0.28209479)[:, None]
        splats.append(splat)
    views = tuple(photograph(s) for s in splats)
    pair = part_pair(tuple(splats), views, 1, num_views=5, pixels=10000)
    candidates = torch.stack([T, torch.eye(4, dtype=torch.float64)])
    lit, hues = pair.cost(candidates), without_shading(pair).cost(candidates)
    assert lit[0] > lit[1]  # the light deceives
    assert hues[0] < 0.5 * hues[1]
    assert appearance_cost(pair, candidates).argmin() == 0
