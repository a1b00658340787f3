"""The motion of one part refined by Gauss-Newton on rendered images, and how certain it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from splatart_ns.geometry.se3 import from_rotation_translation, skew, so3_exp, transform_points
from splatart_ns.geometry.similarity import rigid_of
from splatart_ns.stages.part_pair import HUBER, PartPair, huber

STEP = 5e-4
"""Forward differences: radians, part radii, and the logarithm of a scale. They err by half a step times how the
residuals bend, and these are not small: where every image is rendered (see `rasterize_neighbours`), steps of 4e-3 put
the axis of a pair of scissors 0.04 or, taken backwards, 0.06 degrees elsewhere."""
CLOSE = 4e-4
"""Smaller steps of the search, in the same units, end it."""


@dataclass(frozen=True)
class Refinement:
    """Where Gauss-Newton ended."""

    T: Tensor
    """The motion [4, 4] float64."""
    cost: float
    """Mean Huber cost per own pixel."""
    converged: bool
    iterations: int
    equations: NormalEquations
    """At T, for `motion_covariance`."""


def increment(T: Tensor, xi: Tensor, centroid: Tensor, radius: float) -> Tensor:
    """Motions [..., 4, 4] after small ones xi [..., 6 or 7]: translation in radii, rotation about the moved centroid,
    and perhaps the logarithm of a scale about it."""
    pivot = transform_points(T, centroid[None])[..., 0, :]
    R = so3_exp(xi[..., 3:6])
    if xi.shape[-1] == 7:
        R = R * xi[..., 6:, None].exp()
    small = from_rotation_translation(R, pivot + radius * xi[..., :3] - (R @ pivot[..., None])[..., 0])
    return small @ T


def refine(
    pair: PartPair,
    T: Tensor,
    max_iterations: int = 6,
    hold_rotation: bool = False,
    with_scale: bool = False,
) -> Refinement:
    """Levenberg-Marquardt from T [4, 4] on all pixels of the pair, robust by Huber weights.

    `hold_rotation` moves only the translation, `with_scale` lets T become a similarity.
    """
    T = T.double()
    n = 3 if hold_rotation else 7 if with_scale else 6
    damping, converged = 1e-3, False
    equations = normal_equations(pair, T, n)
    iteration = 0
    while iteration < max_iterations and not converged:
        iteration += 1
        H = equations.H.sum(0)
        H = H + damping * H.diagonal().clamp_min(1e-12).diag()
        step = -torch.linalg.solve(H, equations.g.sum(0))
        trial = increment(T, pad(step, (0, max(0, 6 - n))), pair.centroid, pair.radius)
        cost = float(pair.cost(trial[None])[0])
        if cost < equations.cost:
            converged = bool(step.abs().max() < CLOSE) or cost > (1 - 1e-4) * equations.cost
            T, damping = trial, damping * 0.3
            equations = equations.after(step, cost) if converged else normal_equations(pair, T, n)
        else:
            damping = max(damping, 1e-3) * 10
            converged = damping > 1e2 or bool(step.abs().max() < CLOSE)
    return Refinement(T, equations.cost, converged, iteration, equations)


@dataclass(frozen=True)
class NormalEquations:
    """Of the Huber cost, in units of radii and radians."""

    H: Tensor
    """Of each view [V, n, n]."""
    g: Tensor
    """Of each view [V, n]."""
    cost: float
    """Mean Huber cost per own pixel."""

    def after(self, step: Tensor, cost: float) -> NormalEquations:
        """What they are, to first order, after a small step [n] to where the cost was measured."""
        return NormalEquations(self.H, self.g + self.H @ step, cost)


def trial_steps(n: int, like: Tensor) -> Tensor:
    """Small motions [1 + n, max(n, 6)] to linearize about: none, and one step along each of the first n parameters."""
    steps = STEP * torch.eye(n, dtype=like.dtype, device=like.device)
    return pad(torch.cat([torch.zeros_like(steps[:1]), steps]), (0, max(0, 6 - n)))


def linearized(difference: Tensor, weight: Tensor, step: float = STEP) -> tuple[Tensor, Tensor, float]:
    """Gauss-Newton's H [n, n] and g [n] of the Huber cost of one view, float64, and that cost.

    Args:
        difference: What differs [1 + n, N, C]: at the point, and after a step along each parameter.
        weight: Of the pixels [N].
        step: Length of the steps, in the parameters' units.
    """
    r = difference[0].reshape(-1)
    after = difference[1:].reshape(len(difference) - 1, -1)
    J = (after - r) / step
    w = weight[..., None].expand(difference.shape[1:]).reshape(-1)
    wJ = J * (w * (HUBER / r.abs().clamp_min(1e-12)).clamp_max(1.0))
    return (wJ @ J.T).double(), (wJ @ r).double(), float((w * huber(r)).sum())


@torch.no_grad()
def normal_equations(pair: PartPair, T: Tensor, n: int) -> NormalEquations:
    """Of the first n of translation, rotation and logarithm of a scale, at T [4, 4]; see `increment` and `refine`."""
    steps = trial_steps(n, T)
    motions = increment(T.expand(len(steps), 4, 4), steps, pair.centroid, pair.radius)
    H, gradients, costs = zip(*pair.of_views(motions, linearized, True), strict=True)
    return NormalEquations(torch.stack(H), torch.stack(gradients), sum(costs) / max(pair.area, 1.0))


def motion_covariance(pair: PartPair, T: Tensor, equations: NormalEquations | None = None) -> Tensor:
    """How uncertain a refined motion T [4, 4] is [6, 6] float64; `equations`: those of its `Refinement`, if it has one.

    [7, 7] for a similarity, whose equations have a scale: its logarithm comes last. Where the equations are of a mere
    translation, the rotation counts as known.

    The tangent is (translation, rotation) of a left increment in the world frame: T = se3_exp(xi) T_true, so that the
    translation is that of the world's origin. A sandwich estimate with views as clusters (Liang and Zeger 1986):
    neighbouring pixels err together (edges, shadows, a mixed Gaussian), so each view counts as one observation, however
    many pixels it has. Views of one state share the other state's Gaussians and err together too: what the two
    directions disagree by is added, and what rendered silhouettes do not show (`_outline_covariance`). A prior with a
    standard deviation of half a turn, and of pi radii, keeps finite what no image shows, like the turn of a plain round
    part about its axis.
    """
    T = T.double()
    equations = equations or normal_equations(pair, T, 6)
    # Mean squared residual of one of the 4 channels; a perfect fit has none.
    variance = max(equations.cost / 2, 1e-9)
    V, n = equations.g.shape
    g = equations.g - equations.g.mean(0)
    directions = torch.stack([d.sum(0) for d in g.split([len(pair.views[1]), len(pair.views[0])])])
    H_inv = torch.linalg.inv(equations.H.sum(0) + variance / math.pi**2 * torch.eye(n).to(T))
    local = H_inv @ (V / max(V - n, 1) * g.T @ g + directions.T @ directions) @ H_inv + variance * H_inv
    local += _outline_covariance(pair, T, n)
    # From (radii, radians) about the moved centroid to the world's origin.
    pivot = transform_points(T, pair.centroid[None])[0]
    A = torch.eye(max(n, 6), n, dtype=T.dtype, device=T.device)
    A[:3, :3] *= pair.radius
    if n >= 6:
        A[:3, 3:6] = skew(pivot)
    if n == 7:
        A[:3, 6] = -pivot
    return A @ local @ A.T


def _outline_covariance(pair: PartPair, T: Tensor, n: int) -> Tensor:
    """What a refined motion T [4, 4] is uncertain by besides [n, n], where silhouettes are rendered from splats: in
    radii and radians about the moved centroid.

    All these err as their splat does, alike in all views, which their residuals do not show. Where its Gaussians ought
    to be, the views say whose outlines were given: of their own state, they are few, and each errs for itself. How far
    they scatter about what their equations allow is one factor (overdispersion, McCullagh and Nelder 1989, chapter 4),
    for too few views leave a sandwich without some directions. The prior is that of `motion_covariance`.
    """
    total = torch.zeros(n, n).to(T)
    to_target = torch.block_diag(*[rigid_of(T)[:3, :3]] * 2, torch.eye(1).to(T))[:n, :n]
    places = (pair.centroid, to_target), (transform_points(T, pair.centroid[None])[0], torch.eye(n).to(T))
    for splat, views, (centroid, turn) in zip(pair.splats, pair.views, places, strict=True):
        given = tuple(view for view in views if not view.outlined_by_splat)
        if not given or len(given) == len(views):
            continue
        own = replace(pair, splats=(splat, splat), views=((), given), centroid=centroid)
        equations = normal_equations(own, torch.eye(4).to(T), n)
        H = equations.H.sum(0)
        eye = torch.eye(n).to(T)
        scatter = (equations.g @ torch.linalg.inv(H + 1e-9 * eye) * equations.g).sum() / n
        scatter = scatter * len(given) / max(len(given) - 1, 1)
        total += turn @ torch.linalg.inv(H / scatter.clamp_min(1e-9) + eye / math.pi**2) @ turn.T
    return total


def shifted(pair: PartPair, T: Tensor, R: Tensor | None = None) -> Refinement:
    """The best motion with the rotation R [3, 3], by default none, from where T [4, 4] puts the part's centroid."""
    R = torch.eye(3).to(T) if R is None else R.to(T)
    moved = transform_points(T, pair.centroid[None])[0]
    start = from_rotation_translation(R, moved - R @ pair.centroid)
    return refine(pair, start, hold_rotation=True)


def rotation_held_ratio(pair: PartPair, T: Tensor, R: Tensor) -> float:
    """How much worse a part fits when it may only slide: cost with the rotation held at R [3, 3] over cost free.

    `T` [4, 4] is the free solution; the held one starts with the part's centroid where T puts it. Measured ratios are
    near 1 for parts that slide and above 5 for parts that turn; 1.2 separates them.
    """
    free = refine(pair, T)
    return shifted(pair, free.T, R).cost / max(free.cost, 1e-12)
