"""Merged Gaussians that the images would hardly miss: what is hidden, what repeats others, what is too faint to tell.

The colour of a pixel is affine in the opacity o of each Gaussian, so without one the pixel changes by o dI/do exactly:
by the Gaussian's weight there times how it differs from what is behind it. A copy of what is behind it changes nothing,
however much of the pixel it makes up. The errors of several do not add up where they stand for each other: they go in
`ROUNDS`, and those that stay learn in between.

Depth changes alike. What hangs before a plain wall in the wall's own colour costs images little, and may be all that
they see of a hollow: such `veils` go as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import transform_points
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.image_error import difference
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
VEIL_BEFORE, VEIL_LIKE, VEIL_OPACITY = 0.15, 0.35, 0.9
"""A veil hangs so far, in radii of the object, before what shows without it, which differs by less than this in colour
and accumulation (0..1); and it is not opaque, as walls between two rooms of one colour are."""


@dataclass(frozen=True)
class Absences:
    """What would change without each Gaussian alone, squared and summed over the pixels of some views."""

    images: Tensor
    """Premultiplied colour and accumulation [N]."""
    depth: Tensor
    """Depth times accumulation, from the splat's middle on, length [N]."""
    weight: Tensor
    """What the Gaussian makes up of a pixel [N]: by this the others are means."""
    error: float
    """Of the images as they are."""

    @classmethod
    def none(cls, splat: Splat) -> Absences:
        """Of no views."""
        return cls(*splat.opacities.detach().new_zeros(3, len(splat)), error=0.0)

    def plus(self, other: Absences, shown: Tensor) -> Absences:
        """With what other views say of the Gaussians that they have, `shown` [N] bool."""
        of_all = [mine.clone() for mine in (self.images, self.depth, self.weight)]
        for mine, theirs in zip(of_all, (other.images, other.depth, other.weight), strict=True):
            mine[shown] += theirs
        return Absences(*of_all, error=self.error + other.error)


def absences(splat: Splat, views: Sequence[View], seed: int) -> Absences:
    """What all views would miss without each Gaussian.

    With random signs s of the pixels (sum_p s_p J_p)^2 is sum_p J_p^2 in the mean, so two backward passes a view
    measure all Gaussians; their noise averages out over the views.
    """
    seeds = torch.randint(2**31, (len(views),), generator=torch.Generator().manual_seed(seed)).tolist()
    found = side_by_side(lambda k: _absences(splat, views[k], seeds[k]), range(len(views)))
    everything = torch.ones_like(splat.opacities, dtype=torch.bool)
    total = Absences.none(splat)
    for one in found:
        total = total.plus(one, everything)
    return total


def _absences(splat: Splat, view: View, seed: int) -> Absences:
    splat = splat.detach()
    opacities, logits = splat.opacities, splat.opacity_logits.clone().requires_grad_()
    z = transform_points(view.viewmat, splat.means)[:, 2]
    # A channel of which nothing is rendered has the weights as its gradient.
    marks = torch.zeros_like(z).requires_grad_()
    rendering = render(
        replace(splat, opacity_logits=logits),
        *(view.viewmat[None], view.K[None], view.width, view.height),
        features=torch.stack([z - z.mean(), marks], -1),
        with_depth=False,
    )
    off = difference(rendering, view)
    signs = torch.randint(2, off.shape, generator=torch.Generator().manual_seed(seed)).to(off) * 2 - 1
    by_images = torch.autograd.grad((off * signs).sum(), logits, retain_graph=True)[0]
    counted = signs[..., :1] if view.mask is None else signs[..., :1] * view.mask[..., None].to(signs)
    by_depth, weight = torch.autograd.grad((rendering.features[0] * counted).sum(), (logits, marks))
    # o dI/do of do/dlogit = o (1 - o)
    images, depth = (gradient / (1 - opacities).clamp_min(1e-4) for gradient in (by_images, by_depth))
    return Absences(images.square(), depth.square(), weight.square(), float(off.detach().square().sum()))


def veils(missed: Absences, splat: Splat) -> Tensor:
    """Which Gaussians [N] hang well before what shows without them, which looks like them: in a hollow's mouth, where
    the images do not mind them."""
    if len(splat) == 0:
        return torch.zeros_like(splat.opacities, dtype=torch.bool)
    radius = (splat.means - splat.means.mean(0)).norm(dim=-1).max()
    before, unlike = ((of / missed.weight.clamp_min(1e-12)).sqrt() for of in (missed.depth, missed.images))
    return (before > VEIL_BEFORE * radius) & (unlike < VEIL_LIKE) & (splat.opacities < VEIL_OPACITY)


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
