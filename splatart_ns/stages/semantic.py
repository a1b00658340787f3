"""Stage 1: what a Gaussian's part is, learned from the frames that have labels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatart_ns.capture.capture import UNLABELLED
from splatart_ns.capture.view import View
from splatart_ns.rasterize.render import Rendering, render
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.spread import TOLD
from splatart_ns.stages.visibility import unobstructed

WRONG_OBJECT = 0.6
"""A view's labels are wrong where it contradicts the others on so much of the object. Less would not do: of what is
seen edge on, right labels say something else than Gaussians behind its rim."""
WRONG_PART, LARGE_PART = 0.9, 0.1
"""Or on so much of a part that is at least this share of the object, where two others agree: two of four links that
change places are half of the object. (Of 38 objects with five labelled views a state none of 372 right ones is wrong by
these, and 510 of 631 are in which two parts change places; 366 by the object alone.)"""


def accumulation_loss(accumulation: Tensor, alpha: Tensor) -> Tensor:
    """Mean absolute difference between rendered accumulation and the image's silhouette, both [H, W] in 0..1."""
    return (accumulation - alpha).abs().mean()


def depth_loss(depth: Tensor, accumulation: Tensor, seen: Tensor) -> Tensor:
    """How far Gaussians lie before and behind the surface that is seen: the mean over the image, 0 where none is.

    Args:
        depth: Expected depth as rendered [H, W], and its accumulation [H, W].
        seen: Depth of the surface [H, W]; 0 where unknown.
    """
    return ((seen > 0) * accumulation * (depth - seen).abs()).mean()


def spike_loss(log_scales: Tensor, most: float) -> Tensor:
    """By how much Gaussians' longest axes exceed `most` times their shortest, in the mean: [N, 3] to a number.
    (PhysGaussian; Xie et al. 2024.)"""
    ratio = (log_scales.amax(-1) - log_scales.amin(-1)).exp()
    return (ratio - most).clamp_min(0).mean()


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
def ballots(splat: Splat, views: Sequence[View], num_parts: int) -> tuple[Tensor, Tensor]:
    """How much of its labels' pixels each labelled view sees through each Gaussian [V, N, P + 1]: blending weights.
    And the share of the Gaussian that it sees so [V, N]: 1 if nothing is before it, and all of it is labelled.

    The gradient of a rendering with respect to P + 1 zero feature channels is the sum of blending weights, so one
    backward pass a view counts its votes.
    """
    cast, shown = [], []
    for view in views:
        view = view.to(splat.means.device)
        labels = view.labels.long()
        labelled = labels != UNLABELLED
        target = torch.nn.functional.one_hot(torch.where(labelled, labels, 0), num_parts + 1).float()
        features = torch.zeros(len(splat), num_parts + 1, device=splat.means.device, requires_grad=True)
        with torch.enable_grad():
            rendering = render(
                splat, view.viewmat[None], view.K[None], view.width, view.height, features=features, with_depth=False
            )
            image = rendering.features[0]
            cast.append(torch.autograd.grad((image * target * labelled[..., None]).sum(), features)[0])
        alone = unobstructed(splat, rendering)
        shown.append(torch.where(alone > 0, cast[-1].sum(-1) / alone.clamp_min(1e-6), 0.0))
    if not cast:
        none = torch.zeros(0, len(splat), num_parts + 1, device=splat.means.device)
        return none, none[..., 0]
    return torch.stack(cast), torch.stack(shown)


def trusted(votes: Tensor, shown: Tensor) -> Tensor:
    """Which views' ballots [V, N, P + 1], with what they show of each Gaussian [V, N], do not contradict the others:
    bool [V].

    A glimmer of what lies behind a thin part has the part's label, and is no vote.
    The view goes that contradicts the others most, as long as one contradicts them on much of the object, or on a large
    part. Of fewer than three views nobody can tell which is wrong.
    """
    votes = votes * (shown >= TOLD)[..., None]
    says = torch.where(votes.amax(-1) > 0, votes.argmax(-1), -1)
    kept = torch.ones(len(votes), dtype=torch.bool, device=votes.device)
    while kept.sum() >= 3:
        total, beyond = votes[kept].sum(0), torch.zeros(len(votes), device=votes.device)
        for v in kept.nonzero()[:, 0].tolist():
            part = (total - votes[v]).argmax(-1)
            agreeing = (says[kept] == part).sum(0) - (says[v] == part).int()
            beyond[v] = _contradiction(votes[v], part, agreeing)
        if beyond.max() <= 1:
            break
        kept[beyond.argmax()] = False
    return kept


def _contradiction(ballot: Tensor, part: Tensor, agreeing: Tensor) -> Tensor:
    """By how many times what is bearable a ballot [N, P + 1] contradicts the others, of which so many [N] say what most
    say of each Gaussian [N]; on the parts' Gaussians, that is, not on the background's."""
    cast = ballot.sum(-1) * (part > 0)
    wrong = cast - ballot.gather(-1, part[:, None])[:, 0] * (part > 0)
    by_part = [ballot.new_zeros(ballot.shape[1]).index_add(0, part, x * (agreeing > 1)) for x in (cast, wrong)]
    share = torch.where(by_part[0] > LARGE_PART * cast.sum(), by_part[1] / by_part[0].clamp_min(1), 0.0)
    return torch.maximum(wrong.sum() / cast.sum().clamp_min(1) / WRONG_OBJECT, share.amax() / WRONG_PART)


def vote_logits(votes: Tensor) -> Tensor:
    """Part logits [N, P + 1] from ballots [V, N, P + 1]: the log share of each label. A Gaussian that no view sees gets
    equal logits (see `spread`)."""
    total = votes.sum(0) + 1e-3
    return (total / total.sum(-1, keepdim=True)).log()
