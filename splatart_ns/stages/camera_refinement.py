"""Camera poses of one state refined against its splat, where the silhouettes say that they are not exact."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import inverse, se3_exp, se3_log, transform_points
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.part_pair import PartView, huber, part_view
from splatart_ns.stages.refinement import STEP, increment, linearized

TURN, MOVE = math.radians(0.5), 0.005
"""What wrong cameras are usually off by: radians, and shares of their distance."""
CORRELATED = 300.0
"""The image counts as so many times fewer pixels: they err together. With 10, cameras went twice too far."""
ITERATIONS = 3
"""Of Gauss-Newton a pass: the splat changes with the cameras, so no pass needs to end."""


@dataclass(frozen=True)
class Pass:
    """One round of all cameras."""

    at: float
    """When, as a share of the steps on geometry and colour."""
    pixels: int
    """How many pixels of the object a view is compared in."""


PASSES = (Pass(0.15, 1000), Pass(0.3, 2000), Pass(0.45, 4000), Pass(0.6, 6000), Pass(0.8, 10000))


@torch.no_grad()
def refine_cameras(splat: Splat, views: Sequence[View], given: Tensor, pixels: int) -> Tensor:
    """World-to-camera matrices [N, 4, 4] float64 nearer to what the views show of the splat.

    Each camera is moved by Gauss-Newton on silhouette and colours. What all cameras have in common (where the world
    lies, how it is turned and how large it is) stays as the matrices `given` [N, 4, 4] have it.

    Args:
        splat: The state's Gaussians.
        views: One of each camera, where it is now; those without a silhouette stay.
        pixels: About how many pixels of the object a view is compared in.
    """
    weight = splat.opacities.double()
    centroid = weight @ splat.means.double() / weight.sum()
    radius = float((weight @ (splat.means.double() - centroid).square().sum(1) / weight.sum()).sqrt())
    viewmats = torch.stack([view.viewmat for view in views]).to(centroid)
    moved = torch.zeros(len(views), dtype=torch.bool)
    for i, view in enumerate(views):
        if view.alpha is None:
            continue
        inside = view.alpha > 127
        factor = max(1, int((float(inside.sum()) / pixels) ** 0.5))
        seen = part_view(replace(view, labels=inside.to(torch.uint8)), 1, factor, splat.means.device)
        if seen is not None:
            viewmats[i] = _refined(splat, seen, given[i].to(viewmats), centroid, radius)
            moved[i] = True
    viewmats[moved] = _without_drift(viewmats[moved], given.to(viewmats)[moved], centroid)
    return viewmats


def _refined(splat: Splat, seen: PartView, given: Tensor, centroid: Tensor, radius: float) -> Tensor:
    """One camera [4, 4] by Gauss-Newton with halved steps on the image, and on how far it is from the `given` one.

    A camera that turns and steps aside sees nearly the same: without the second, it goes far along that valley.
    """
    viewmat = seen.viewmat.double()
    scale = torch.full((6,), TURN).to(viewmat)
    scale[:3] = MOVE * transform_points(given, centroid[None])[0].norm()
    steps = pad(STEP * torch.eye(6).to(viewmat), (0, 0, 1, 0))
    T = torch.eye(4).to(viewmat)

    def far(motions: Tensor) -> Tensor:
        return se3_log(viewmat @ motions @ inverse(given)) / scale

    def cost_after(T: Tensor) -> float:
        image = huber(seen.difference(splat, T[None])) * seen.weight[..., None]
        return float(image.sum()) + 0.5 * prior * float(far(T[None]).square().sum())

    prior = None
    for _ in range(ITERATIONS):
        motions = increment(T.expand(7, 4, 4), steps, centroid, radius)
        H, g, cost = linearized(seen.difference(splat, motions), seen.weight, STEP)
        prior = prior or CORRELATED * 2 * cost / float(seen.weight.sum())
        r, J = far(motions)[0], (far(motions)[1:] - far(motions)[:1]) / STEP
        step = -torch.linalg.solve(H + prior * J @ J.T, g + prior * J @ r)
        before = cost + 0.5 * prior * float(r @ r)
        for _ in range(3):
            trial = increment(T, step, centroid, radius)
            if cost_after(trial) < before:
                T = trial
                break
            step = step / 3
        else:
            break
    return viewmat @ T


def _without_drift(viewmats: Tensor, given: Tensor, centroid: Tensor) -> Tensor:
    """The cameras [N, 4, 4] without what all of them moved alike about the centroid [3] since the `given` ones.

    Turned and shifted alike, they are turned and shifted back; nearer or farther alike, they go back along their rays.
    """
    to_centroid = torch.eye(4).to(given)
    to_centroid[:3, 3] = centroid
    motions = inverse(given @ to_centroid) @ viewmats @ to_centroid
    common = se3_exp(se3_log(motions).mean(0))
    viewmats = viewmats @ to_centroid @ inverse(common) @ inverse(to_centroid)
    before, after = (transform_points(V, centroid[None])[:, 0] for V in (given, viewmats))
    nearer = (after[:, 2] / before[:, 2]).log().mean().exp()
    out = viewmats.clone()
    out[:, :3, 3] += after / nearer - after
    return out


@dataclass(frozen=True)
class CameraChange:
    """How far cameras were moved: root mean squares."""

    degrees: float
    """Between optical axes and about them."""
    percent: float
    """Of the distance to the world's origin."""


def camera_change(viewmats: Tensor, given: Tensor) -> CameraChange:
    """Between world-to-camera matrices [N, 4, 4]."""
    turned = se3_log(viewmats @ inverse(given.to(viewmats)))[:, 3:].norm(dim=-1)
    centres, before = (inverse(V.to(viewmats))[:, :3, 3] for V in (viewmats, given))
    moved = (centres - before).norm(dim=-1) / before.norm(dim=-1)
    rms = [float(x.square().mean().sqrt()) for x in (turned.rad2deg(), 100 * moved)]
    return CameraChange(*rms)
