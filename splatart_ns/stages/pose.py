"""Stage 2: the poses of all parts in all states, and the losses that refine them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from splatart_ns.capture.capture import UNLABELLED
from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import adjoint, from_rotation_translation, inverse, so3_exp, transform_points, translation
from splatart_ns.rasterize.render import Rendering
from splatart_ns.rasterize.ssim import ssim
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.semantic import depth_loss

PURE = 0.9
"""A Gaussian more likely than this of one part is not mixed."""
KEPT = 0.9
"""At least this share of a part's Gaussians is kept, however mixed."""
SINGULAR = 1e-9
"""Variances below this share of a pose's largest one are none."""


class PartPoses(nn.Module):
    """T[state][part] as increments on the manifold about fixed base poses.

    An increment turns a part about its moved centroid and then shifts it, so that its two halves hardly interact; both
    are of order one degree and one percent of the part alike, so one learning rate fits all parts. State 0 is the
    identity and has no parameters.
    """

    def __init__(self, base: Tensor, centroids: Tensor, radii: Tensor, frozen: Tensor | None = None):
        """
        Args:
            base: Poses to start from [S, P, 4, 4]; base[0] must be the identity.
            centroids: Of the parts in state 0 [P, 3].
            radii: Root mean square distances of the parts' Gaussians from the centroids [P].
            frozen: Poses that stay as they are [S, P] bool, for parts that do not move or are not seen.
        """
        super().__init__()
        S, P = base.shape[:2]
        if not torch.equal(base[0], torch.eye(4).to(base[0]).expand(P, 4, 4)):
            raise ValueError("the poses of state 0 must be the identity")
        device = base.device
        free = torch.ones(S - 1, P, dtype=torch.bool, device=device) if frozen is None else ~frozen[1:]
        self.register_buffer("base", base.double())
        self.register_buffer("centroids", centroids.double())
        self.register_buffer("radii", radii.double())
        self.register_buffer("free", free)
        self.register_buffer("turning", torch.ones_like(free), persistent=False)
        self.rotation = nn.Parameter(torch.zeros(S - 1, P, 3, dtype=torch.float64, device=device))
        """Rotation vectors [S - 1, P, 3], radians."""
        self.translation = nn.Parameter(torch.zeros(S - 1, P, 3, dtype=torch.float64, device=device))
        """Shifts [S - 1, P, 3] in units of the part's radius."""

    def T(self) -> Tensor:
        """Poses [S, P, 4, 4] float64: where a point of part p in state 0 is in state s."""
        free = self.free[..., None]
        R = so3_exp(self.rotation * (free & self.turning[..., None]))
        pivot = transform_points(self.base[1:], self.centroids[:, None])[..., 0, :]
        shift = self.translation * free * self.radii[:, None]
        small = from_rotation_translation(R, pivot + shift - (R @ pivot[..., None])[..., 0])
        return torch.cat([self.base[:1], small @ self.base[1:]])

    @torch.no_grad()
    def commit(self, T: Tensor) -> None:
        """Make the poses T [S, P, 4, 4] the base and the increments zero."""
        self.base.copy_(T)
        self.rotation.zero_()
        self.translation.zero_()

    def release(self, free: Tensor, turning: Tensor) -> None:
        """Let just the poses `free` [S, P] bool change, those not `turning` [S, P] bool by shifts alone."""
        self.free.copy_(free[1:])
        self.turning.copy_(turning[1:])

    @torch.no_grad()
    def hold_within(self, covariance: Tensor, deviations: float) -> None:
        """Shorten increments of free poses that are more than so many standard deviations long.

        By the base poses' covariances [S, P, 6, 6], T = se3_exp(xi) T_true, xi = (translation, rotation); along what
        these leave no room for, increments count for nothing.
        """
        free = self.free
        centroids, radii = (x.expand(len(free), *x.shape)[free] for x in (self.centroids, self.radii))
        pivot = transform_points(self.base[1:][free], centroids[:, None])[:, 0]
        about_pivot = adjoint(translation(-pivot))
        to_increment = torch.cat([about_pivot[:, :3] / radii[:, None, None], about_pivot[:, 3:]], 1)
        C = to_increment @ covariance[1:][free] @ to_increment.mT
        increment = torch.cat([self.translation[free], self.rotation[free]], -1)
        precision = torch.linalg.pinv(C, rtol=SINGULAR, hermitian=True)
        length = (increment[:, None] @ precision @ increment[..., None])[:, 0].clamp_min(0).sqrt()
        shorter = increment * (deviations / length.clamp_min(deviations))
        self.translation[free], self.rotation[free] = shorter[:, :3], shorter[:, 3:]


def part_extents(splat: Splat, num_parts: int) -> tuple[Tensor, Tensor]:
    """Centroids [P, 3] and root mean square radii [P] float64 of the parts, weighted by opacity and part probability.

    A part without Gaussians gets the whole splat's.
    """
    means = splat.means.detach().double()
    weights = (splat.opacities[:, None] * splat.part_probabilities)[:, 1:].detach().double()
    weights = weights * (splat.part_ids[:, None] == torch.arange(1, num_parts + 1, device=means.device))
    empty = weights.sum(0) == 0
    weights = torch.where(empty, splat.opacities[:, None].detach().double(), weights)
    weights = weights / weights.sum(0)
    centroids = weights.T @ means
    squared = (means[:, None] - centroids).square().sum(-1)
    return centroids, (weights * squared).sum(0).sqrt()


def unmixed(splat: Splat) -> Tensor:
    """Which Gaussians belong to one part clearly enough to move with it [N] bool.

    A Gaussian across the seam of two parts that moves with one of them biases its pose. Left out are those whose
    largest part probability is `PURE` or less, but never more than 1 - `KEPT` of a part.
    """
    largest, part = splat.part_probabilities.detach().max(-1)
    chosen = largest > PURE
    for p in part.unique():
        mine = part == p
        threshold = largest[mine].quantile(1 - KEPT)
        chosen |= mine & (largest >= threshold)
    return chosen


def carry(splats: Sequence[Splat] | Mapping[int, Splat], T: Tensor, source: int, target: int) -> Splat:
    """The splat of state `source` with every part moved to where it is at state `target`.

    `T` [S, P, 4, 4] are the poses; the background stays. The Gaussians come in the order of their parts.
    """
    splat = splats[source]
    motion = T[target] @ inverse(T[source])
    ids = splat.part_ids
    parts = [splat.select(ids == 0)]
    parts += [splat.select(ids == p + 1).transformed(motion[p]) for p in range(len(motion))]
    return Splat.cat(parts)


@dataclass(frozen=True)
class PoseLossWeights:
    """Weights of the paper's four losses. The defaults are measured; the authors' code has .8, .2, 1e-7 and .1. And of
    `depth_loss`, for views that have a depth."""

    l1: float = 0.8
    ssim: float = 0.2
    accumulation: float = 0.5
    segmentation: float = 0.5
    depth: float = 0.5


def pose_loss(
    rendering: Rendering, view: View, weights: PoseLossWeights, background: Tensor | None = None
) -> dict[str, Tensor]:
    """The weighted losses of one rendered view; their sum is to be minimised.

    Args:
        rendering: One camera; its features are the Gaussians' part probabilities, background first [1, H, W, P + 1].
        view: What the camera saw. Without labels there is no segmentation loss, and unlabelled pixels have none;
            without an alpha there is no accumulation loss, and the rendering is compared with the whole image.
        background: Colour behind the object [3] in 0..1, black by default.
    """
    rgb, accumulation = rendering.rgb[0], rendering.accumulation[0]
    background = torch.zeros(3) if background is None else background
    target = view.rgb_on(background.to(view.rgb.device)).to(rgb)
    rgb = rgb + (1 - accumulation) * background.to(rgb)
    valid = torch.ones(rgb.shape[:2]).to(rgb) if view.mask is None else view.mask.to(rgb)
    if view.mask is not None:
        # SSIM looks at neighbourhoods, so pixels that do not count must agree.
        target = torch.where(valid[..., None] > 0, target, rgb.detach())

    losses = {
        "l1": weights.l1 * _mean((rgb - target).abs().mean(-1), valid),
        "ssim": weights.ssim * (1 - ssim(rgb, target)),
    }
    if view.alpha is not None:
        alpha = view.alpha.to(rgb) / 255
        losses["accumulation"] = weights.accumulation * _mean((accumulation[..., 0] - alpha).abs(), valid)
    if rendering.depth is not None and view.depth is not None:
        wrong = depth_loss(rendering.depth[0, ..., 0], accumulation[..., 0], view.depth.to(rgb))
        losses["depth"] = weights.depth * wrong
    if view.labels is not None:
        labels = view.labels.to(rgb.device).long()
        channels = rendering.features[0, ..., 1:]
        parts = torch.arange(1, channels.shape[-1] + 1, device=rgb.device)
        wrong = (channels - (labels[..., None] == parts).to(rgb)).abs().sum(-1)
        losses["segmentation"] = weights.segmentation * _mean(wrong, valid * (labels != UNLABELLED))
    return losses


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    """Mean over all pixels [H, W] of those that count; 0 when none does."""
    return (values * weight).sum() / weight.sum().clamp_min(1.0)
