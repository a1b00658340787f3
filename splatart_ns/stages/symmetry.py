"""The turn of a round part about its own axis: refining from one start cannot find it, and images may not tell it.

The silhouettes of a disc, a knob or a ball are alike at every turn, and where it is shaded it looks best as if it had
stood still, like its light. Only what is drawn on it or sticks out tells the turn, by a dip of the cost at the right
angle: a narrow one, where that of light is wide. So all angles are tried. The axis must be exact for that, as turning
about one that is a degree off costs more than the dip is deep: it is taken from the motion between the part's pose and
its pose after half a turn, refined.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import inverse, se3_exp, se3_log, skew, so3_log
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.part_pair import CHROMA_WEIGHT, PartPair, part_pair
from splatart_ns.stages.refinement import increment, refine
from splatart_ns.stages.render_choice import COARSE_PIXELS, VIEWS
from splatart_ns.stages.symmetric_turns import similar_axes

MAYBE_ROUND = 0.03
"""Turning them about their principal axis raises the cost per pixel by less than this."""
ROUND = 0.01
"""About their exact axis, by less than this: discs measured 0.001 to 0.003, what is not round 0.02 to 0.5."""
STEP = 5
"""Degrees between the turns that are tried."""
DIP = 10
"""Degrees about the best turn within which others may cost as little."""
TOLD = 1.05
"""Beyond, they cost at least this many times the best where the images tell the turn: else it may be noise."""
TOLD_SHARE = 0.05
"""And by this share of what the worst costs more: else it may be light, whose wide dips measured 0.02 at most."""
UNTURNED = 5
"""Degrees by which a part that turned about its axis of symmetry alone may seem to have turned about others."""


def settle_turn(
    splats: tuple[Splat, Splat], views: tuple[Sequence[View], Sequence[View]], part: int, T: Tensor
) -> tuple[Tensor, Tensor]:
    """The best turn of a round part about its own axis, or how uncertain that is.

    Args:
        splats: Labelled splats of the source and of the target state.
        views: Views of each.
        part: A part that both show.
        T: Its motion [4, 4], near the optimum but for that turn.

    Returns:
        The motion [4, 4] after the best turn, not refined: T itself where the part is not round or T fits best already,
        and where nothing tells, a mere shift if one of the turns makes it that. And the covariance [6, 6] of the turns
        that nothing tells, 0 where there are none: that of a uniform angle, pi^2 / 3, in the tangent of
        `motion_covariance`.
    """
    T = T.double()
    untold = torch.zeros(6, 6).to(T)
    axes = similar_axes(splats[0].select(splats[0].part_ids == part))
    pair = part_pair(splats, views, part, VIEWS, COARSE_PIXELS) if len(axes) else None
    if pair is None:
        return T, untold
    pair = replace(pair, chroma_weight=CHROMA_WEIGHT)
    for axis in axes.to(T):
        twist = _axis_of_symmetry(pair, T, axis)
        if twist is None:
            continue
        # Light makes no narrow dip, so brightness may count in full.
        angles, cost = _swept(replace(pair, brightness_weight=1.0), T, twist)
        best = int(cost.argmin())
        apart = (angles - angles[best] + math.pi).remainder(2 * math.pi) - math.pi
        rival = cost[apart.abs() > math.radians(DIP + 0.5 * STEP)].amin()
        told = rival > TOLD * cost[best] and rival - cost[best] > TOLD_SHARE * (cost.amax() - cost[best])
        if not told:
            untold = untold + math.pi**2 / 3 * twist.outer(twist)
            back = se3_exp(_least_turn(T, twist) * twist) @ T
            T = back if so3_log(back[:3, :3]).norm() < math.radians(UNTURNED) else T
        elif min(best, len(cost) - best) * STEP > DIP:
            T = se3_exp(angles[best] * twist) @ T
    return T, untold


def _least_turn(T: Tensor, twist: Tensor) -> Tensor:
    """The angle about a twist [6] of unit rotation after which a motion T [4, 4] turns least.

    About the axis w it makes the trace of exp(angle [w]x) R largest: w^T R w + cos (tr R - w^T R w) + sin tr([w]x R).
    """
    R, w = T[:3, :3], twist[3:]
    return torch.atan2((skew(w) @ R).trace(), R.trace() - w @ R @ w)


def _axis_of_symmetry(pair: PartPair, T: Tensor, axis: Tensor) -> Tensor | None:
    """The twist [6] of unit rotation about the part's axis of symmetry in the target's world; None if it is not round.

    `axis` [3]: near it, in the source's world.
    """
    turn = torch.cat([torch.zeros(3).to(T), T[:3, :3] @ axis])
    angles = torch.arange(0, 360, 30).to(T).deg2rad()
    cost = pair.cost(increment(T.expand(len(angles), 4, 4), angles[:, None] * turn, pair.centroid, pair.radius))
    if cost.amax() - cost.amin() > MAYBE_ROUND:
        return None
    half = refine(pair, increment(T, math.pi * turn, pair.centroid, pair.radius)).T
    twist = se3_log(half @ inverse(T))
    twist = twist / twist[3:].norm()
    cost = _swept(pair, T, twist)[1]
    return twist if cost.amax() - cost.amin() < ROUND else None


def _swept(pair: PartPair, T: Tensor, twist: Tensor) -> tuple[Tensor, Tensor]:
    """Angles [K] of a whole turn about a twist [6] after T, and what they cost [K]."""
    angles = torch.arange(0, 360, STEP).to(T).deg2rad()
    return angles, pair.cost(se3_exp(angles[:, None] * twist) @ T)
