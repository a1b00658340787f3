"""Stage 1: what a Gaussian's part is, learned from the frames that have labels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatart_ns.capture.capture import UNLABELLED
from splatart_ns.capture.view import View
from splatart_ns.rasterize.render import Rendering, render
from splatart_ns.splats.splat import Splat

WRONG_PART = 0.6
"""A view's labels are wrong where it contradicts the others on so much of a part, and on so many pixels of it."""
_ENOUGH_PIXELS = 30


def accumulation_loss(accumulation: Tensor, alpha: Tensor) -> Tensor:
    """Mean absolute difference between rendered accumulation and the image's silhouette, both [H, W] in 0..1."""
    return (accumulation - alpha).abs().mean()


def part_image(rendering: Rendering) -> Tensor:
    """The probability of background and every part at each pixel [C, H, W, P + 1].

    The rendering's features are the Gaussians' part probabilities; what no Gaussian covers is background.
    """
    background = rendering.features[..., :1] + 1 - rendering.accumulation
    return torch.cat([background, rendering.features[..., 1:]], dim=-1)


def segmentation_loss(probabilities: Tensor, labels: Tensor) -> Tensor:
    """Cross-entropy of [H, W, P + 1] against part ids [H, W], over the labelled pixels; 0 when there are none."""
    labelled = labels != UNLABELLED
    target = torch.where(labelled, labels.long(), 0)
    nll = -probabilities.gather(-1, target[..., None])[..., 0].clamp_min(1e-4).log()
    return (nll * labelled).sum() / labelled.sum().clamp_min(1)


@torch.no_grad()
def ballots(splat: Splat, views: Sequence[View], num_parts: int) -> Tensor:
    """How much of its labels' pixels each labelled view sees through each Gaussian [V, N, P + 1]: blending weights.

    The gradient of a rendering with respect to P + 1 zero feature channels is the sum of blending weights, so one
    backward pass a view counts its votes.
    """
    cast = []
    for view in views:
        view = view.to(splat.means.device)
        labels = view.labels.long()
        labelled = labels != UNLABELLED
        target = torch.nn.functional.one_hot(torch.where(labelled, labels, 0), num_parts + 1).float()
        features = torch.zeros(len(splat), num_parts + 1, device=splat.means.device, requires_grad=True)
        with torch.enable_grad():
            image = render(
                splat, view.viewmat[None], view.K[None], view.width, view.height, features=features, with_depth=False
            ).features[0]
            cast.append(torch.autograd.grad((image * target * labelled[..., None]).sum(), features)[0])
    return torch.stack(cast) if cast else torch.zeros(0, len(splat), num_parts + 1, device=splat.means.device)


def trusted(votes: Tensor) -> Tensor:
    """Which views' ballots [V, N, P + 1] do not contradict the others: bool [V].

    The view goes that contradicts the others most, as long as it calls most of some part another; of fewer than three
    views nobody can tell which is wrong.
    """
    kept = torch.ones(len(votes), dtype=torch.bool, device=votes.device)
    while kept.sum() >= 3:
        total = votes[kept].sum(0)
        worst, most = None, 0.0
        for v in kept.nonzero()[:, 0].tolist():
            number, wrong = _contradicted(votes[v], total - votes[v])
            contradicts = (wrong > WRONG_PART * number) & (number > _ENOUGH_PIXELS)
            share = float(wrong.sum() / number.sum().clamp_min(1))
            if contradicts.any() and share > most:
                worst, most = v, share
        if worst is None:
            break
        kept[worst] = False
    return kept


def _contradicted(ballot: Tensor, others: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels that a ballot [N, P + 1] casts on the Gaussians of each part by the others' votes, and those of them that
    have another label: both [P]."""
    amount, part = others.max(-1)
    cast = torch.where(amount > 0, ballot.sum(-1), 0.0)
    wrong = torch.where(amount > 0, cast - ballot.gather(-1, part[:, None])[:, 0], 0.0)
    parts = ballot.shape[1]
    return tuple(torch.zeros(parts, device=ballot.device).index_add(0, part, x)[1:] for x in (cast, wrong))


def vote_logits(votes: Tensor) -> Tensor:
    """Part logits [N, P + 1] from ballots [V, N, P + 1]: the log share of each label. A Gaussian that no view sees gets
    equal logits."""
    total = votes.sum(0) + 1e-3
    return (total / total.sum(-1, keepdim=True)).log()
