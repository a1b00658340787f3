"""Merged Gaussians that the images would hardly miss: what is hidden, what repeats others, what is too faint to tell.

The colour of a pixel is affine in the opacity o of each Gaussian, so without one the pixel changes by o dI/do exactly:
by the Gaussian's weight there times how it differs from what is behind it. A copy of what is behind it changes nothing,
however much of the pixel it makes up. The errors of several do not add up where they stand for each other: they go in
`ROUNDS`, and those that stay learn in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.misfit import difference
from splatart_ns.threads import side_by_side

ROUNDS = 5
"""All in one cost 0.2 dB more at the same number of Gaussians; eight, no less than four."""
BUDGET = 0.04
"""What all rounds together may add to the squared error of the images, as a share of it. Those that stay make up for
most of it."""
LARGEST_SHARE = 1 / 6
"""So much of a part goes in one round at most: no part vanishes, and the others can take over."""
MAX_VIEWS = 40
"""In one round; the next one looks at others."""


def absences(splat: Splat, views: Sequence[View], seed: int) -> tuple[Tensor, float]:
    """What the images of all views would miss without each Gaussian [N], and the error that they have.

    Both are squared differences of premultiplied colour and accumulation, summed over pixels and views. With random
    signs s of the pixels (sum_p s_p J_p)^2 is sum_p J_p^2 in the mean, so one backward pass a view measures all
    Gaussians; its noise averages out over the views.
    """
    seeds = torch.randint(2**31, (len(views),), generator=torch.Generator().manual_seed(seed)).tolist()
    found = side_by_side(lambda k: _absence(splat, views[k], seeds[k]), range(len(views)))
    return sum((one for one, _ in found), torch.zeros_like(splat.opacities)), float(sum(error for _, error in found))


def _absence(splat: Splat, view: View, seed: int) -> tuple[Tensor, Tensor]:
    splat = splat.detach()
    opacities, logits = splat.opacities, splat.opacity_logits.clone().requires_grad_()
    off = difference(replace(splat, opacity_logits=logits), view)
    signs = torch.randint(2, off.shape, generator=torch.Generator().manual_seed(seed)).to(off) * 2 - 1
    gradient = torch.autograd.grad((off * signs).sum(), logits)[0]
    change = gradient / (1 - opacities).clamp_min(1e-4)  # o dI/do of do/dlogit = o (1 - o)
    return change.square(), off.detach().square().sum()


def expendable(absence: Tensor, part_ids: Tensor, budget: float) -> Tensor:
    """Which Gaussians [N] go: those of least `absence` [N], in sum at most `budget`, and few of each part."""
    order = absence.argsort()
    ids = part_ids[order]
    goes = torch.zeros_like(ids, dtype=torch.bool)
    for part in ids.unique():
        mine = (ids == part).nonzero()[:, 0]
        goes[mine[: int(LARGEST_SHARE * len(mine))]] = True
    goes &= torch.where(goes, absence[order], 0.0).cumsum(0) <= budget
    return torch.zeros_like(goes).scatter(0, order, goes)
