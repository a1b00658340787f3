import torch

from splatart_ns.capture.part_votes import PartVotes, read_ballots
from splatart_ns.capture.view import View

SIZE = 0.05
K = torch.tensor([[64.0, 0, 32], [0, 64, 32], [0, 0, 1]])


def layer(depth):
    """Voxels [400, 3] of a square across the view."""
    x = (torch.arange(20) - 9.5) * SIZE
    return torch.stack(torch.meshgrid(x, x, torch.tensor([depth]), indexing="ij"), -1).reshape(-1, 3)


def disagreement(seen, lid, base):
    """What a view that sees the label everywhere contradicts of a lid (2) and a base (1) at these depths."""
    labels = torch.full((64, 64), seen, dtype=torch.uint8)
    view = View("0", torch.eye(4), K, width=64, height=64, rgb=labels[..., None], alpha=None, labels=labels)
    points = torch.cat([layer(depth) for depth in (lid, base)])
    counts = torch.zeros(800, 3)
    counts[:400, 2], counts[400:, 1] = 3, 3
    (ballot,) = read_ballots([view], points, SIZE, 2)
    counts[ballot.points, ballot.label] += 1
    share, number = PartVotes(counts, (ballot,)).disagreement(ballot)
    return share.tolist()[1:], number.tolist()[1:]


def test_a_view_says_nothing_of_what_lies_hardly_behind_what_it_sees():
    assert disagreement(2, lid=2.0, base=2.0 + SIZE) == ([0, 0], [0, 400])


def test_a_view_may_see_what_the_hull_puts_hardly_behind_another_part():
    assert disagreement(1, lid=2.0, base=2.0 + SIZE) == ([0, 0], [400, 0])


def test_a_view_contradicts_what_lies_far_before_all_that_it_says():
    assert disagreement(1, lid=2.0, base=2.0 + 6 * SIZE) == ([0, 1], [0, 400])
