"""How one part looks from all around it: views of depth, which a mesh is made from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from splatart_ns.geometry.camera import project_points
from splatart_ns.geometry.directions import golden_spiral
from splatart_ns.geometry.se3 import matrix_from_quat, transform_points
from splatart_ns.rasterize import rasterization
from splatart_ns.rasterize.render import PIXEL_VARIANCE
from splatart_ns.splats.splat import Splat

FAINT = 0.1
"""Gaussians below this opacity are haze in front of surfaces, where there are others."""
_VIEWS = 48
"""From all around."""
_CAMERAS, _APART = 48, math.cos(math.radians(6))
"""And at most so many from where cameras looked, each by the angle of this cosine from all others: of those all around
few look into a hollow, and where the Gaussians in it are is known from there best."""
_DISTANCE = 5.0
"""From the cameras to the part's centre, in its radii: far enough to see into cavities, near enough for float32."""
_SLICES = 16
"""Layers of depth that are told apart along a ray."""
_BLIND = math.cos(math.radians(35))
"""Into what views from directions that differ by more than this from all cameras' see no camera looked. (With 25 to 45
degrees meshes of eight pieces of furniture come equally near the truth in the mean: the smaller, the fuller is a box
on the ground, and the further off a cupboard on a skirting.)"""
_BESIDE = 8
"""Pixels around what need be seen that are looked at, too."""
_HIDDEN = 2.0
"""What lies so much further than what stands before it is hidden by that, voxels."""
_FRONT_PIXELS = 128
"""Most pixels along a side of the images of what stands before a part."""
_LEVEL = 1.4
"""Outer surfaces lie so many times as far before the middles of Gaussians as where half of their opacity is passed
(the surface of Gaussian Opacity Fields, Yu et al. 2024): silhouettes keep all of them inside, and so the middles 1.5 to
2.4 standard deviations below the surface (docs/export.md)."""


@dataclass(frozen=True)
class DepthView:
    """What one camera sees of the unit sphere."""

    viewmat: Tensor
    K: Tensor
    image: Tensor
    """Channels [6, H, W]: the accumulation, and times the accumulation: depth less _DISTANCE, how much nearer the
    surface is where it is an outer one, and colour."""
    fronts: Tensor | None
    """Depth less _DISTANCE of what stands around the part, at each state [S, h, w], infinite where nothing does."""
    blind: bool
    """Whether no camera looked from about this direction, as far as that is known."""
    direction: Tensor
    """From the middle to the camera [3], a unit vector, float64."""

    def sample(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What is seen at `points` [N, 3]: accumulation [N], how far behind each the surface lies [N], and how much
        nearer it is if it is an outer one [N]."""
        uv, z = project_points(points, self.viewmat, self.K)
        accumulation, depth, nearer = _at(self.image[:3], uv)
        weight = accumulation.clamp_min(1e-6)
        return accumulation, depth / weight - (z - _DISTANCE), nearer / weight

    def shows(self, points: Tensor, band: float) -> Tensor:
        """At which of `points` [N, 3] the seen surface is, or within `band` of them [N] bool."""
        accumulation, behind, nearer = self.sample(points)
        return (accumulation > 0.5) & (behind > -band) & (behind < nearer + band)

    def colours(self, points: Tensor) -> Tensor:
        """Of what is seen at `points` [N, 3], times the accumulation there [N, 3]."""
        return _at(self.image[3:], project_points(points, self.viewmat, self.K)[0]).T

    def towards(self, points: Tensor) -> Tensor:
        """Unit vectors from `points` [N, 3] to the camera [N, 3]."""
        return F.normalize(-self.viewmat[:3, :3].mT @ self.viewmat[:3, 3] - points, dim=-1)

    def hidden(self, points: Tensor, voxel: float) -> Tensor:
        """Which of `points` [N, 3] lie behind what stands before the part in all states [N] bool; all do if blind."""
        if self.blind or self.fronts is None:
            return torch.full((len(points),), self.blind)
        uv, z = project_points(points, self.viewmat, self.K)
        size = self.fronts.shape[-1]
        column, row = (uv * (size / self.image.shape[-1])).long().clamp(0, size - 1).unbind(-1)
        return (self.fronts[:, row, column] < z - _DISTANCE - _HIDDEN * voxel).all(0)

    def surface(self, least: float) -> Tensor:
        """Where the pixels of at least this accumulation see the part [N, 3]."""
        accumulation, depth = self.image[:2]
        row, column = (accumulation > least).nonzero().unbind(-1)
        z = depth[row, column] / accumulation[row, column] + _DISTANCE
        ray = (torch.stack([column, row], -1) + 0.5 - self.K[:2, 2]) / self.K[0, 0]
        return (F.pad(ray, (0, 1), value=1.0) * z[:, None] - self.viewmat[:3, 3]) @ self.viewmat[:3, :3]


def _at(image: Tensor, uv: Tensor) -> Tensor:
    """The channels of a square image [C, H, H] at pixels [N, 2]: [C, N]."""
    at = (uv * (2 / image.shape[-1]) - 1)[None, None]
    return F.grid_sample(image[None], at, align_corners=False)[0, :, 0]


def look_around(
    splat: Splat,
    centre: Tensor,
    radius: float,
    pixels: int,
    around: Sequence[Splat] = (),
    towards: Tensor | None = None,
    half: Tensor | None = None,
) -> list[DepthView]:
    """Views of the sphere about `centre` [3], made the unit sphere, `pixels` wide and high, from all around.

    `towards` [M, 3] are the directions of the cameras, if they are known: from there it is looked at, too. `half` [3]
    are half the sides of the box about the centre outside of which nothing need be seen.
    """
    unit, *others = (_unit(of, centre, radius) for of in (splat, *around))
    directions = _directions(towards)
    blind = [False] * _VIEWS if towards is None else ((directions @ towards.mT).amax(-1) < _BLIND).tolist()
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    box = corners if half is None else corners * (half / radius).float()
    return [_look(unit, others, *each, pixels, box) for each in zip(directions, blind, strict=True)]


def _directions(towards: Tensor | None) -> Tensor:
    """Unit vectors [V, 3] float64: all around, then those of `towards` [M, 3] that are farthest from all before."""
    directions = golden_spiral(1 - (2 * torch.arange(_VIEWS, dtype=torch.float64) + 1) / _VIEWS)
    if towards is None:
        return directions
    towards = towards[towards.any(-1)]  # a camera in the very middle has none
    if len(towards) == 0:
        return directions
    chosen, nearest = [], (towards @ directions.mT).amax(-1)
    while len(chosen) < _CAMERAS and nearest.min() < _APART:
        chosen.append(towards[nearest.argmin()])
        nearest = torch.maximum(nearest, towards @ chosen[-1])
    return torch.cat([directions, *(direction[None] for direction in chosen)])


def _unit(splat: Splat, centre: Tensor, radius: float) -> Splat:
    """A splat in the frame in which a sphere is the unit sphere."""
    splat = splat.detach().to("cpu", torch.float32)
    return Splat(
        means=((splat.means.double() - centre) / radius).float(),
        quats=splat.quats,
        # A Gaussian without any thickness has no slope.
        log_scales=(splat.log_scales - math.log(radius)).clamp_min(math.log(1e-5)),
        opacity_logits=splat.opacity_logits,
        sh=splat.sh,
    )


def _look(splat: Splat, around: Sequence[Splat], direction: Tensor, blind: bool, pixels: int, box: Tensor) -> DepthView:
    """One view of `pixels` by `pixels`, in which what lies beside the corners of a box [8, 3] is left empty."""
    forward = -direction
    side = torch.linalg.cross(forward, torch.eye(3, dtype=torch.float64)[int(forward.abs().argmin())])
    side = side / side.norm()
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.stack([side, torch.linalg.cross(forward, side), forward])
    viewmat[2, 3] = _DISTANCE
    viewmat = viewmat.float()
    focal = pixels / 2 * math.sqrt(_DISTANCE**2 - 1)
    K = torch.tensor([[focal, 0, pixels / 2], [0, focal, pixels / 2], [0, 0, 1]])
    uv = project_points(box, viewmat, K)[0]
    left, top = (uv.amin(0) - _BESIDE).floor().long().clamp(0, pixels - 1).tolist()
    right, bottom = (uv.amax(0) + _BESIDE).ceil().long().clamp(1, pixels).tolist()
    width, height = right - left, bottom - top
    of_piece = K - torch.tensor([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]])

    z = transform_points(viewmat, splat.means)[:, 2]
    layer = ((z - z.min()) * (_SLICES / (z.max() - z.min()).clamp_min(1e-9))).long().clamp_max(_SLICES - 1)
    depth_planes, thickness = _depth_planes(splat, viewmat, K)
    nearer = _LEVEL * thickness * (2 * (2 * splat.opacities).clamp_min(1).log()).sqrt()
    planes = F.pad(depth_planes, (1, 0), value=1.0)
    image, accumulation, _ = rasterization(
        *(splat.means, splat.quats, splat.scales, splat.opacities),
        torch.cat(
            [
                nearer[:, None],
                splat.base_colours,
                (planes[:, :, None] * F.one_hot(layer, _SLICES)[:, None]).flatten(1),
            ],
            1,
        ),
        *(viewmat[None], of_piece[None], width, height),
        eps2d=PIXEL_VARIANCE,
    )
    weight, at_centre, along_x, along_y = image[0, ..., 4:].unflatten(-1, (4, _SLICES)).unbind(-2)
    from_centre = torch.arange(pixels)[:, None] + 0.5 - pixels / 2
    across, down = from_centre[left:right], from_centre[top:bottom, None]
    depth = _median_depth(weight, at_centre + along_x * across + along_y * down)
    channels = torch.cat([accumulation[0], accumulation[0] * depth[..., None], image[0, ..., :4]], -1)
    size = min(pixels, _FRONT_PIXELS)
    smaller = torch.diag(torch.tensor([size / pixels, size / pixels, 1.0])) @ K
    fronts = [_front(other, viewmat, smaller, size) for other in around if not blind]  # which does not ask
    fronts = torch.stack(fronts) if fronts else None
    whole = F.pad(channels.permute(2, 0, 1), (left, pixels - right, top, pixels - bottom))
    return DepthView(viewmat, K, whole, fronts, blind, direction)


def _front(splat: Splat, viewmat: Tensor, K: Tensor, pixels: int) -> Tensor:
    """How far what is seen of a splat is, less _DISTANCE, in the mean [H, W]; infinite where little is."""
    splat = splat.select(splat.opacities > FAINT)
    z = transform_points(viewmat, splat.means)[:, 2:]
    gaussians = splat.means, splat.quats, splat.scales, splat.opacities, z
    depth, accumulation, _ = rasterization(*gaussians, viewmat[None], K[None], pixels, pixels, eps2d=PIXEL_VARIANCE)
    depth, accumulation = depth[0, ..., 0], accumulation[0, ..., 0]
    return torch.where(accumulation > 0.5, depth / accumulation.clamp_min(1e-6) - _DISTANCE, torch.inf)


def _depth_planes(splat: Splat, viewmat: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """The depth less _DISTANCE of each Gaussian as a plane over the image [N, 3]: at the centre, per pixel along x, y.

    And how thick it is along a ray [N], one standard deviation.

    Where a ray meets a Gaussian most densely is linear in the pixel, for the local affine camera of EWA splatting
    (Zwicker et al. 2001): the conditional mean of depth given the pixel. The centres' depths alone would make steps of
    slanted surfaces. Composited like colours, the planes give the expected depth.
    """
    uv, z = project_points(splat.means, viewmat, K)
    offset = uv - K[:2, 2]
    J = torch.zeros(len(z), 3, 3)
    J[:, 0, 0] = J[:, 1, 1] = K[0, 0] / z
    J[:, :2, 2] = -offset / z[:, None]
    J[:, 2, 2] = 1
    half = J @ viewmat[:3, :3] @ matrix_from_quat(splat.quats) * splat.scales[:, None]
    covariance = half @ half.mT
    # The rasterizer's own blur, without which the slopes of Gaussians seen on edge have no bound.
    seen = covariance[:, :2, :2] + PIXEL_VARIANCE * torch.eye(2)
    slope = torch.linalg.solve(seen, covariance[:, :2, 2])
    planes = torch.cat([(z - _DISTANCE - (slope * offset).sum(-1))[:, None], slope], -1)
    return planes, (covariance[:, 2, 2] - (slope * covariance[:, :2, 2]).sum(-1)).clamp_min(0).sqrt()


def _median_depth(weight: Tensor, moment: Tensor) -> Tensor:
    """Where half the opacity is passed [H, W], of each slice's sums of weights and of weight x depth [H, W, _SLICES].

    The mean over the slice in which that is and its two neighbours. The mean over all slices would lie between front
    and back wherever the front is not quite opaque.
    """
    weight, moment = (F.pad(x.cumsum(-1), (1, 0)) for x in (weight, moment))
    middle = (weight[..., 1:] < 0.5 * weight[..., -1:]).sum(-1, keepdim=True).clamp_max(_SLICES - 1)
    near, far = (middle - 1).clamp_min(0), (middle + 2).clamp_max(_SLICES)
    inside = weight.gather(-1, far) - weight.gather(-1, near)
    return ((moment.gather(-1, far) - moment.gather(-1, near)) / inside.clamp_min(1e-6))[..., 0]
