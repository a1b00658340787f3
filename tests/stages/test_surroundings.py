import torch

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import inverse
from splatart_ns.stages.surroundings import surrounding_points

WIDTH, HEIGHT = 64, 48


def view_of_floor(x: float, y: float) -> View:
    """A camera at (x, y, 3) that looks down at a floor of many colours."""
    T = torch.eye(4)
    T[:3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    T[:3, 3] = torch.tensor([x, y, 3.0])
    K = torch.tensor([[60.0, 0, WIDTH / 2], [0, 60.0, HEIGHT / 2], [0, 0, 1]])
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    ground = torch.stack([x + (u - WIDTH / 2) / 20, y - (v - HEIGHT / 2) / 20], -1)
    waves = torch.tensor([[5.0, 1.0], [-2.0, 6.0], [4.0, 4.0]])
    rgb = (127.5 + 120 * torch.sin(ground @ waves.T + ground.square() @ waves.T)).to(torch.uint8)
    return View("", inverse(T), K, WIDTH, HEIGHT, rgb)


VIEWS = [view_of_floor(0.5 * i, 0.4 * j) for i in (-1, 0, 1) for j in (-1, 0, 1)]


def test_points_lie_where_the_views_colours_agree():
    points = surrounding_points(VIEWS, 400, torch.Generator().manual_seed(0))
    assert points.xyz.shape == (400, 3)
    assert (points.xyz[:, 2].abs() < 0.15).float().mean() > 0.85


def test_points_have_the_colours_of_their_pixels_and_repeat_by_seed():
    first, again = (surrounding_points(VIEWS, 50, torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first.xyz, again.xyz)
    colours = torch.cat([view.rgb.reshape(-1, 3) for view in VIEWS]).float()
    assert (torch.cdist(first.rgb, colours).amin(1) == 0).all()


def test_a_single_view_still_gives_points_before_it():
    points = surrounding_points(VIEWS[:1], 30, torch.Generator().manual_seed(0))
    assert points.xyz.isfinite().all() and (points.xyz[:, 2] < 3).all()
