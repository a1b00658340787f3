"""One part in two states: what the images of each state say of the other state's Gaussians, moved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from splatart_ns.capture.view import View, Window, box
from splatart_ns.geometry.se3 import inverse
from splatart_ns.geometry.similarity import inverse_similarity, view_of_moved
from splatart_ns.rasterize.rasterization import rasterization, rasterize_neighbours, sh_colors
from splatart_ns.rasterize.render import PIXEL_VARIANCE
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.light import even_light
from splatart_ns.threads import side_by_side

Measure = TypeVar("Measure")
RGB_WEIGHT = 0.3
"""Weight of a colour difference against one of silhouettes: the pose is in the shape, light misleads."""
CHROMA_WEIGHT = 2.0
"""That of what is left of a colour difference without its mean over the channels, where asked for: light that stays in
the world while parts turn changes how bright they are, and hardly their hue."""
IN_EVEN_LIGHT = {"chroma_weight": CHROMA_WEIGHT, "brightness_weight": 1.0, "even_light": True}
"""How a `PartPair` looks at hues and, as if both states were lit alike, at brightness."""
HUBER = 0.15
"""Residuals beyond this count linearly."""
MARGIN = 8
"""Least margin in pixels around a part in the piece of the image that is compared."""


@dataclass(frozen=True)
class PartView:
    """The piece of an image around a part, made smaller by `factor`."""

    viewmat: Tensor
    """World to camera [4, 4] float32."""
    K: Tensor
    """Intrinsics of the piece [3, 3]."""
    rgba: Tensor
    """The part over black with its silhouette [H, W, 4], 0..1."""
    weight: Tensor
    """Which pixels count [H, W], 0..1: the part and the background. Another part may hide this one, so its pixels do
    not, nor do those without a label."""
    area: float
    """Number of the part's own pixels at full size."""
    factor: int
    outlined_by_splat: bool = False
    """Whether the silhouette is rendered from the state's own splat."""

    def render(self, splat: Splat, T: Tensor, first_order: bool = False) -> Tensor:
        """The splat under motions or similarities [K, 4, 4]: [K, H, W, 4], colours over black and accumulation.

        With `first_order`, motions are near the first, and images about its image (see `rasterize_neighbours`).
        """
        viewmats = view_of_moved(self.viewmat, T.to(self.viewmat))
        height, width = self.weight.shape
        gaussians = splat.means, splat.quats, splat.scales, splat.opacities
        colors = sh_colors(splat.means, splat.sh, viewmats, splat.sh_degree)
        if first_order:
            return rasterize_neighbours(*gaussians, colors, viewmats, self.K, width, height, PIXEL_VARIANCE)
        # Accumulation is what a channel shows that is one everywhere.
        channels = torch.cat([colors, torch.ones_like(colors[..., :1])], -1)
        Ks = self.K.expand(len(viewmats), 3, 3)
        return rasterization(*gaussians, channels, viewmats, Ks, width, height, eps2d=PIXEL_VARIANCE)[0]

    def share(self, splat: Splat, chosen: Tensor) -> Tensor:
        """What the chosen Gaussians [N] bool of a splat make up of the view [H, W], 0..1."""
        height, width = self.weight.shape
        gaussians = splat.means, splat.quats, splat.scales, splat.opacities, chosen[:, None].to(splat.means)
        camera = self.viewmat[None], self.K[None], width, height
        return rasterization(*gaussians, *camera, eps2d=PIXEL_VARIANCE)[0][0, ..., 0]

    def difference(
        self,
        splat: Splat,
        T: Tensor,
        chroma_weight: float = RGB_WEIGHT,
        brightness_weight: float = RGB_WEIGHT,
        in_even_light: bool = False,
        first_order: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """How the splat under motions [K, 4, 4] differs from the part [K, N, 4], and the weights [N], of the N pixels
        that count and where one of them shows; see `render`."""
        rendered = self.render(splat, T, first_order)
        # A turned or thin part fills little of its piece.
        shown = ((rendered[..., 3] != 0).any(0) | (self.rgba[..., 3] != 0)) & (self.weight > 0)
        shown = shown.flatten().nonzero()[:, 0]
        change = rendered.flatten(1, 2).index_select(1, shown)
        if in_even_light:
            gain, inside = (x.flatten(1)[:, shown] for x in even_light(rendered, self.rgba, self.weight))
            change[..., :3] *= gain[..., None]
        change -= self.rgba.flatten(0, 1)[shown]
        mean = torch.full((3, 3), 1 / 3).to(rendered)
        mix = torch.eye(4).to(rendered)  # by a matrix: sums over channels take several times longer
        mix[:3, :3] = chroma_weight * (mix[:3, :3] - mean) + (0 if in_even_light else brightness_weight) * mean
        difference = change @ mix
        if in_even_light:
            brighter = change @ F.pad(mean[0], (0, 1))
            difference[..., :3] += inside.mul_(brightness_weight).mul_(brighter)[..., None]
        return difference, self.weight.flatten()[shown]


def part_view(
    view: View, part: int, factor: int = 1, device: torch.device | None = None, near: bool = False
) -> PartView | None:
    """What a labelled view says of a part; None if it does not show it.

    Where the part is rendered `near` to where the view shows it, the piece need not be wide.
    """
    own = view.labels == part
    alpha = own.float() if view.alpha is None else view.alpha.float() / 255
    weight = (own | (view.labels == 0)).float()
    if view.mask is not None:
        weight = weight * view.mask
    if not (weight * own).any():
        return None
    rgba = torch.cat([view.rgb.float() / 255 * alpha[..., None], alpha[..., None]], -1)

    left, top, right, bottom = _window(own, factor, near)
    rgba, weight = rgba[top:bottom, left:right], weight[top:bottom, left:right]
    K = view.K.clone()
    K[0, 2] -= left
    K[1, 2] -= top
    K[:2] /= factor
    pieces = torch.cat([rgba * weight[..., None], weight[..., None]], -1)
    pieces = F.avg_pool2d(pieces.permute(2, 0, 1)[None], factor)[0].permute(1, 2, 0)
    weight = pieces[..., 4]
    return PartView(
        viewmat=view.viewmat.to(device),
        K=K.to(device),
        rgba=(pieces[..., :4] / weight.clamp_min(1e-6)[..., None]).to(device),
        weight=weight.to(device),
        area=float(own.sum()),
        factor=factor,
        outlined_by_splat=view.outlined_by_splat,
    )


def _window(shown: Tensor, factor: int, near: bool) -> Window:
    """The box of `shown` [H, W] with a margin, a multiple of `factor` wide and high."""
    left, top, right, bottom = box(shown)
    bounds = []
    for low, high, size in ((left, right, shown.shape[1]), (top, bottom, shown.shape[0])):
        margin = max(MARGIN * factor, 0 if near else (high - low) // 2)
        low, high = max(0, low - margin), min(size, high + margin)
        bounds.append((low, low + max(1, (high - low) // factor) * factor))
    (left, right), (top, bottom) = bounds
    return left, top, right, bottom


def best_views(views: Sequence[View], part: int, count: int) -> list[View]:
    """Up to `count` labelled views that show a part well, from directions far apart (farthest point sampling)."""
    area = torch.tensor([0 if v.labels is None else int((v.labels == part).sum()) for v in views])
    if not (area > 0).any():
        return []
    centres = torch.stack([inverse(v.viewmat)[:3, 3] for v in views])
    chosen = [int(area.argmax())]
    pool = [int(i) for i in (area > 0.25 * area.max()).nonzero()[:, 0] if int(i) not in chosen]
    while len(chosen) < count and pool:
        distance = torch.cdist(centres[pool], centres[chosen]).amin(1)
        chosen.append(pool.pop(int(distance.argmax())))
    return [views[i] for i in chosen]


def best_looks(
    views: Sequence[View],
    part: int,
    count: int,
    pixels: int,
    device: torch.device | None = None,
    near: bool = False,
) -> tuple[PartView, ...]:
    """`part_view` of the `best_views`, up to `count`, in which the part covers about `pixels` pixels or fewer."""
    chosen = best_views(views, part, count)
    areas = [float((v.labels == part).sum()) for v in chosen]
    factor = max(1, int((sum(areas) / max(1, len(areas)) / pixels) ** 0.5))
    return tuple(p for v in chosen if (p := part_view(v, part, factor, device, near)) is not None)


@dataclass(frozen=True)
class PartPair:
    """One part's Gaussians in two states, and views of both states."""

    splats: tuple[Splat, Splat]
    """The part alone in the source and in the target state."""
    views: tuple[tuple[PartView, ...], tuple[PartView, ...]]
    """Views of the source and of the target state."""
    centroid: Tensor
    """Of the part in the source state [3] float64."""
    radius: float
    """Root mean square distance of the part's Gaussians from the centroid."""
    chroma_weight: float = RGB_WEIGHT
    brightness_weight: float = RGB_WEIGHT
    even_light: bool = False
    """Whether brightness is compared as if both states were lit alike (see `light`)."""

    @property
    def area(self) -> float:
        """The part's own pixels in all views, at the size at which they are compared."""
        return sum(v.area / v.factor**2 for views in self.views for v in views)

    def shown_by(self, state: int) -> PartPair:
        """The pair with the views of one state alone, source (0) or target (1), and the other's Gaussians in them."""
        return replace(self, views=(self.views[0], ()) if state == 0 else ((), self.views[1]))

    def of_views(
        self, T: Tensor, measure: Callable[[Tensor, Tensor], Measure], first_order: bool = False
    ) -> list[Measure]:
        """What `measure` says, view by view, of the differences [K, N, 4] under motions T [K, 4, 4] and the weights [N]
        of the pixels where anything shows.

        First the source's Gaussians moved by T in the target's views, then the target's moved back in the source's. T
        may be similarities. With `first_order`, all are near the first (see `PartView.render`).
        """
        looks_at = self.chroma_weight, self.brightness_weight, self.even_light, first_order
        ways = zip(self.splats, reversed(self.views), (T, inverse_similarity(T)), strict=True)
        looks = [(splat, view, motion) for splat, views, motion in ways for view in views]

        @torch.no_grad()
        def look(seen: tuple[Splat, PartView, Tensor]) -> Measure:
            splat, view, motion = seen
            return measure(*view.difference(splat, motion, *looks_at))

        return side_by_side(look, looks)

    def own_cost(self) -> float:
        """What `cost` would be if each state's Gaussians were looked at in their own state's views."""
        own = replace(self, splats=self.splats[::-1])
        return float(own.cost(torch.eye(4).to(self.centroid)[None])[0])

    def cost(self, T: Tensor) -> Tensor:
        """Mean Huber cost per own pixel of motions T [K, 4, 4]: [K] float64."""
        return sum(self.of_views(T, huber_cost)) / max(self.area, 1.0)


def huber(r: Tensor) -> Tensor:
    a = r.abs()
    return torch.where(a < HUBER, 0.5 * r * r, HUBER * (a - 0.5 * HUBER))


def huber_cost(difference: Tensor, weight: Tensor) -> Tensor:
    """Of differences [K, N, 4] of pixels that weigh [N]: [K] float64."""
    return (huber(difference).sum(-1) * weight).sum(1).double()


def part_pair(
    splats: tuple[Splat, Splat],
    views: tuple[Sequence[View], Sequence[View]],
    part: int,
    num_views: int,
    pixels: int,
    near: bool = False,
) -> PartPair | None:
    """Compare a part in about `num_views` views of each state, in which it covers about `pixels` pixels or fewer.

    `near`: whether only motions will be tried by which it comes to within a few pixels of where the views show it.

    None when no labelled view of either state shows the part, or one of the states has no Gaussians of it.
    """
    parts = tuple(s.select(s.part_ids == part).detach() for s in splats)
    if min(len(p) for p in parts) == 0:
        return None
    device = parts[0].means.device
    looks = tuple(best_looks(some, part, num_views, pixels, device, near) for some in views)
    if not looks[0] and not looks[1]:
        return None
    means = parts[0].means.double()
    weight = (parts[0].opacities * parts[0].part_probabilities[:, part]).double()
    centroid = weight @ means / weight.sum()
    radius = float((weight @ (means - centroid).square().sum(1) / weight.sum()).sqrt())
    return PartPair(parts, looks, centroid, radius)
