"""Stage 1: what a Gaussian's part is, learned from the frames that have labels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatart_ns.capture.capture import UNLABELLED
from splatart_ns.capture.view import View
from splatart_ns.rasterize.render import Rendering, render
from splatart_ns.splats.splat import Splat


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
def vote_logits(splat: Splat, views: Sequence[View], num_parts: int) -> Tensor:
    """Part logits [N, P + 1] from the labels: the log share of each label in a Gaussian's blending weights.

    The gradient of a rendering with respect to P + 1 zero feature channels is the sum of blending weights, so one
    backward pass a labelled view counts all votes. A Gaussian that no labelled view sees gets equal logits.
    """
    votes = torch.zeros(len(splat), num_parts + 1, device=splat.means.device)
    for view in views:
        if view.labels is None:
            continue
        view = view.to(splat.means.device)
        labels = view.labels.long()
        labelled = labels != UNLABELLED
        target = torch.nn.functional.one_hot(torch.where(labelled, labels, 0), num_parts + 1).float()
        features = torch.zeros_like(votes, requires_grad=True)
        with torch.enable_grad():
            image = render(
                splat, view.viewmat[None], view.K[None], view.width, view.height, features=features, with_depth=False
            ).features[0]
            (gradient,) = torch.autograd.grad((image * target * labelled[..., None]).sum(), features)
        votes += gradient
    share = (votes + 1e-3) / (votes + 1e-3).sum(-1, keepdim=True)
    return share.log()
