"""Camera poses of one state refined against its splat, where silhouettes, or images, say that they are not exact."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from splatart_ns.capture.hull import footprint, missing
from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import inverse, se3_exp, se3_log, so3_log, transform_points, translation
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.hull import Hull
from splatart_ns.stages.part_pair import PartView, huber_cost, part_view
from splatart_ns.stages.refinement import STEP, increment, linearized, trial_steps

TURN, MOVE = math.radians(0.5), 0.005
"""What wrong cameras are usually off by: radians, and shares of their distance."""
CORRELATED_SHIFT, CORRELATED_REST = 100.0, 1000.0
"""The image counts as so many times fewer pixels, which err together: of where in it the object lies, and of how the
camera is tilted, rolled and how near it is. All pixels tell the first; what they tell of the rest is small, and a splat
that wrong cameras have blurred misleads it."""
OBJECT_WEIGHT = 0.1
"""That of pixels which may show the object, against those of its surroundings: cameras that were 1.1 pixels off, and
followed the two sides of a flat window, which show in no view together, came to be 1.7 off; with this weight 0.5,
without the object 0.3. A toaster's came to 0.45 pixels instead of 0.39."""


@dataclass(frozen=True)
class Pass:
    """One round of all cameras."""

    at: float
    """When, as a share of the steps on geometry and colour."""
    pixels: int
    """How many pixels of the object a view is compared in."""


PASSES = tuple(Pass(0.1 * k, round(1000 * 10 ** (k / 9))) for k in range(1, 10))
"""Many short ones: the splat follows the cameras, and they can only come as near as it is sharp."""
TRIED = PASSES[4]
"""Where no silhouettes tell whether cameras are exact, they are refined up to here, and then are or are not."""
EXACT_PIXELS = 0.7
"""Cameras that this has moved by less are: exact ones of two objects in a room measured 0.35 to 0.54, such as were off
by 1.1 pixels 0.8."""


@torch.no_grad()
def refine_cameras(splat: Splat, views: Sequence[View], given: Tensor, pixels: int, hull: Hull | None = None) -> Tensor:
    """World-to-camera matrices [N, 4, 4] float64 nearer to what the views show of the splat.

    Each camera is moved by Gauss-Newton on silhouette and colours. What all cameras have in common (where the world
    lies, how it is turned and how large it is) stays as the matrices `given` [N, 4, 4] have it.

    Args:
        splat: The state's Gaussians.
        views: One of each camera, where it is now. Those without a silhouette are compared with all that the splat has,
            what surrounds the object, too.
        pixels: About how many pixels of that a view is compared in.
        hull: Where, in views without a silhouette, the object may be; it counts little then (`OBJECT_WEIGHT`).
    """
    weight = splat.opacities.double()
    centroid = weight @ splat.means.double() / weight.sum()
    radius = float((weight @ (splat.means.double() - centroid).square().sum(1) / weight.sum()).sqrt())
    viewmats = torch.stack([view.viewmat for view in views]).to(centroid)
    moved = torch.zeros(len(views), dtype=torch.bool)
    for i, view in enumerate(views):
        inside = torch.ones(view.rgb.shape[:2], dtype=torch.bool) if view.alpha is None else view.alpha > 127
        factor = max(1, int((float(inside.sum()) / pixels) ** 0.5))
        seen = part_view(replace(view, labels=inside.to(torch.uint8)), 1, factor, splat.means.device)
        if seen is not None:
            if view.alpha is None and hull is not None:
                seen = _around(seen, view, hull)
            viewmats[i] = _refined(splat, seen, given[i].to(viewmats), centroid, radius)
            moved[i] = True
    viewmats[moved] = _without_drift(viewmats[moved], given.to(viewmats)[moved], centroid)
    return viewmats


def _around(seen: PartView, view: View, hull: Hull) -> PartView:
    """A look at a whole view in which what may be the object weighs little, unless that is all."""
    voxels, size = hull
    everything = torch.ones(view.rgb.shape[:2], dtype=torch.bool)
    around = missing(view, everything, voxels, footprint(view, size))
    around = F.avg_pool2d(around.float()[None], seen.factor)[0].to(seen.weight)
    weight = seen.weight * (OBJECT_WEIGHT + (1 - OBJECT_WEIGHT) * around)
    return replace(seen, weight=weight * (seen.weight.sum() / weight.sum()))


def _refined(splat: Splat, seen: PartView, given: Tensor, centroid: Tensor, radius: float) -> Tensor:
    """One camera [4, 4] after a Gauss-Newton step on the image, and on how far it is from the `given` one.

    A camera that turns and steps aside sees nearly the same: without the second, it goes far along that valley. The
    step is shortened until it helps; if it does not, the camera stays.
    """
    viewmat, eye = seen.viewmat.double(), torch.eye(4).to(given)
    scale = torch.full((6,), TURN).to(viewmat)
    scale[:3] = MOVE * transform_points(given, centroid[None])[0].norm()
    precision = _precision().to(viewmat)

    def far(motions: Tensor) -> Tensor:
        return se3_log(viewmat @ motions @ inverse(given)) / scale

    steps = trial_steps(6, viewmat)
    motions = increment(eye.expand(len(steps), 4, 4), steps, centroid, radius)
    H, g, cost = linearized(*seen.difference(splat, motions, first_order=True))
    noise = 2 * cost / float(seen.weight.sum())
    r, *after = far(motions)
    J = (torch.stack(after) - r) / STEP
    step = -torch.linalg.solve(H + noise * J @ precision @ J.T, g + noise * J @ precision @ r)
    most = cost + 0.5 * noise * float(r @ precision @ r)
    for _ in range(3):
        motion = increment(eye, step, centroid, radius)
        r = far(motion[None])[0]
        image = huber_cost(*seen.difference(splat, motion[None]))
        if float(image) + 0.5 * noise * float(r @ precision @ r) < most:
            return viewmat @ motion
        step = step / 3
    return viewmat


def _precision() -> Tensor:
    """Of the given cameras [6, 6], against that of one pixel of the image, in units of `MOVE` and `TURN`.

    What shifts the object in the image is the camera's step aside and its turn together.
    """
    across = torch.zeros(2, 6)
    across[0, 0], across[0, 4] = MOVE, TURN
    across[1, 1], across[1, 3] = MOVE, -TURN
    shift = across.T @ across / (MOVE**2 + TURN**2)
    return CORRELATED_SHIFT * shift + CORRELATED_REST * (torch.eye(6) - shift)


def _without_drift(viewmats: Tensor, given: Tensor, centroid: Tensor) -> Tensor:
    """The cameras [N, 4, 4] without what all of them moved alike about the centroid [3] since the `given` ones.

    Turned and shifted alike, they are turned and shifted back; nearer or farther alike, they go back along their rays.
    """
    to_centroid = translation(centroid.to(given))
    motions = inverse(given @ to_centroid) @ viewmats @ to_centroid
    common = se3_exp(se3_log(motions).mean(0))
    viewmats = viewmats @ to_centroid @ inverse(common) @ inverse(to_centroid)
    before, after = (transform_points(V, centroid[None])[:, 0] for V in (given, viewmats))
    in_front = torch.minimum(before, after)[:, 2] > 0
    if not in_front.any():
        return viewmats
    nearer = (after[in_front, 2] / before[in_front, 2]).log().mean().exp()
    out = viewmats.clone()
    out[:, :3, 3] += after / nearer - after
    return out


def image_shift(viewmats: Tensor, given: Tensor, views: Sequence[View]) -> float:
    """By how many pixels, root mean square, world-to-camera matrices [N, 4, 4] see the world's origin elsewhere than
    the `given` ones [N, 4, 4] do."""
    focal = torch.stack([view.K.diagonal()[:2] for view in views]).to(viewmats)
    now, before = (V[:, :2, 3] / V[:, 2:3, 3] * focal for V in (viewmats, given.to(viewmats)))
    return float((now - before).square().sum(-1).mean().sqrt())


@dataclass(frozen=True)
class CameraChange:
    """How far cameras were moved: root mean squares."""

    degrees: float
    """Between optical axes and about them."""
    percent: float
    """Of the distance to the world's origin."""


def camera_change(viewmats: Tensor, given: Tensor) -> CameraChange:
    """Between world-to-camera matrices [N, 4, 4]."""
    turned = so3_log((viewmats @ inverse(given.to(viewmats)))[:, :3, :3]).norm(dim=-1)
    centres, before = (inverse(V.to(viewmats))[:, :3, 3] for V in (viewmats, given))
    moved = (centres - before).norm(dim=-1) / before.norm(dim=-1)
    rms = [float(x.square().mean().sqrt()) for x in (turned.rad2deg(), 100 * moved)]
    return CameraChange(*rms)
