"""The turn of a round part about its own axis: refining from one start cannot find it, and images may not tell it.

The silhouettes of a disc, a knob or a ball are alike at every turn, and where it is shaded it looks best as if it had
stood still, like its light. Only what is drawn on it or sticks out tells the turn, by a dip of the cost at the right
angle: a narrow one, where that of light is wide. So all angles are tried. The axis must be exact for that, as turning
about one that is a degree off costs more than the dip is deep: it is taken from the motion between the part's pose and
its pose after half a turn, refined.

Near the axis are principal ones across which the moments are similar, and that of the motion to which the silhouettes
are all but blind: of a wheel under its fork, or a lens whose back no view shows, Gaussians are missing, and the moments
do not tell it. Of parts that turned, the latter is not asked: if nothing is known of the turn of a robot's cylindrical
hip, which is its best guess 7 to 24 degrees off, it takes over that of the leg on it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import inverse, se3_exp, se3_log, skew, so3_log, transform_points
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.part_pair import CHROMA_WEIGHT, PartPair, part_pair
from splatart_ns.stages.refinement import normal_equations, refine
from splatart_ns.stages.render_choice import COARSE_PIXELS, DOUBTFUL_VIEWS, VIEWS
from splatart_ns.stages.symmetric_turns import similar_axes
from splatart_ns.stages.unseen import least_turn, unturned

MAYBE_ROUND = 0.03
"""Turning them about their principal axis raises the cost per pixel by less than this."""
ROUND = 0.01
"""About their exact axis, by less than this: discs measured 0.001 to 0.003, what is not round 0.02 to 0.5."""
BLIND = 0.1
"""Silhouettes are blind to a turn that they weigh by less than this share of what they weigh the median motion by; the
turns of a lens and of two wheels they weigh by 0.005 to 0.02."""
MOSTLY = 0.5
"""Least share of rotation in such a motion, its translation in radii: axes of half-hidden wheels miss the centroid."""
HALF_BLIND, NEARLY_ALL = 0.18, 0.9
"""Where a part seems to rest, also to the motion that they weigh least, if by less than this, and if it is rotation by
this share: of wire wheels and knobs 0.09 to 0.16, and 0.95 to 1; of a board behind a fox in photographs, which is not
round, 0.20. Of a half-hidden turntable they weigh a shift least."""
ASTRAY = 3.0
"""About an axis off a round part's own by an angle or, in radii, a shift e, silhouettes weigh a turn by about e^2 of
what they weigh the median motion by. So e is at most the root of that share, which is taken for so many standard
deviations: 25 such axes were off by 0.1 to 2.5 of these, one by 4."""
UNMOVED = 0.1
"""Radii by which the centroid of a part that seems to rest may have moved. Of a drawer that slid out one state may hide
so much that nothing fits well, and turned by 15 degrees it costs a mere 1 to 55 % more (20 drawers of five objects)."""
SAME_AXIS = 20
"""Degrees between axes that are one."""
STEP = 5
"""Degrees between the turns that are tried."""
DIP = 10
"""Degrees about the best turn within which others may cost as little."""
TOLD = 1.05
"""Beyond, they cost at least this many times the best where the images tell the turn: else it may be noise."""
TOLD_AT_REST = 1.3
"""At least this many times where they tell that it did not turn: a fork that hides the same of a wheel in both states
tells that as well. Plain wheels of which much is hidden measured 1.08 to 1.15, a disc with a mark on its rim 1.4 (by
images blurred more, by which a disc beneath a fork measured 1.22, and 1.29 now)."""
HARDLY_ROUND = 2.0
"""And this many times, by turns of `DIP` and a step, where half a turn shows that a part is not round, but silhouettes
are blind to its turn. Wheels that are half hidden or lit from one side, knobs and a turntable that turned measured 1.0
to 1.6, 20 parts that rest 3.3 to 29."""
CLEARLY, CLEAR_SHARE = 1.5, 0.3
"""Or, for cameras that are off make all cost more, this many times by turns of twice as much, and this share of what
the worst of all turns costs more: what is lit from one side costs (1 - cos 30 deg) / 2 of that, or its root, 0.07 to
0.26. A fridge's body seen from above by such cameras measured 1.9 and 0.38 (1.4 in place of `HARDLY_ROUND`), three
parts that rest 5.5 to 13 and 0.38 to 0.56, nine wheels 1.2 and 0.07 at most."""
TOLD_SHARE = 0.05
"""And by this share of what the worst costs more: else it may be light, whose wide dips measured 0.02 at most."""


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

    @cache
    def look(num_views: int) -> PartPair | None:
        return part_pair(splats, views, part, num_views, COARSE_PIXELS)

    if look(VIEWS) is None:
        return T, untold
    pair = replace(look(VIEWS), chroma_weight=CHROMA_WEIGHT)
    axes = T.new_zeros(0, 3)
    rests = unturned(T)
    moved = transform_points(T, pair.centroid[None])[0] - pair.centroid
    stays = bool(rests and moved.norm() < UNMOVED * pair.radius)
    unseen, shares, weights = _unseen_turns(pair, T, stays) if rests else (T.new_zeros(0, 6), *T.new_zeros(2, 0))
    for k, guess in enumerate(torch.cat([unseen, _similar_turns(pair, T)])):
        if bool((axes @ guess[3:] > math.cos(math.radians(SAME_AXIS))).any()):
            continue
        # Of several turns to which silhouettes are blind none need be that about the part's own axis.
        own = stays and k == 0 and len(unseen) == 1 and shares[0] > NEARLY_ALL
        if own and any(_rests(look(n), T, guess) for n in (VIEWS, DOUBTFUL_VIEWS)):
            continue
        twist = _axis_of_symmetry(pair, T, guess)
        if twist is None:
            if own:
                axes = torch.cat([axes, guess[None, 3:], -guess[None, 3:]])
                untold = untold + math.pi**2 / 3 * guess.outer(guess) + _astray(pair, T, guess, weights[0])
            continue
        angle, told = _told_turn(pair, T, twist)
        if not told:  # what tells it may not show in so few views
            angle, told = _told_turn(look(DOUBTFUL_VIEWS), T, twist)
        axes = torch.cat([axes, twist[None, 3:], -twist[None, 3:]])
        if not told:
            untold = untold + math.pi**2 / 3 * twist.outer(twist)
            back = se3_exp(least_turn(T, twist[3:]) * twist) @ T
            T = back if unturned(back) else T
        elif abs(math.remainder(angle, 2 * math.pi)) > math.radians(DIP + 0.5 * STEP):
            T = se3_exp(angle * twist) @ T
    return T, untold


def _similar_turns(pair: PartPair, T: Tensor) -> Tensor:
    """Twists [K, 6] of unit rotation about the part's `similar_axes` through its centroid, in the target's world."""
    axes = similar_axes(pair.splats[0]).to(T) @ T[:3, :3].mT
    pivot = transform_points(T, pair.centroid[None])
    return torch.cat([torch.linalg.cross(pivot.expand_as(axes), axes), axes], -1)


def _astray(pair: PartPair, T: Tensor, twist: Tensor, weight: Tensor) -> Tensor:
    """Covariance [6, 6] of the axis of a `twist` [6], of its direction and of where it is.

    Silhouettes weigh the turn about it by `weight` of what they weigh the median motion by.
    """
    pivot, axis = transform_points(T, pair.centroid[None])[0], twist[3:]
    across = torch.eye(3).to(T) - axis.outer(axis)
    tilt = torch.cat([skew(pivot) @ across, across])
    shift = pair.radius * torch.cat([across, torch.zeros_like(across)])
    return weight / ASTRAY**2 * (tilt @ tilt.mT + shift @ shift.mT)


def _unseen_turns(pair: PartPair, T: Tensor, half_blind: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Twists [K, 6] of unit rotation, in the target's world, of the turns to which the silhouettes are blind, or half.

    And the share of rotation [K] in the motions that these are of, and what silhouettes weigh these by, the median
    motion by 1 [K].
    """
    silhouettes = replace(pair, chroma_weight=0.0, brightness_weight=0.0)
    weights, motions = torch.linalg.eigh(normal_equations(silhouettes, T, 6).H.sum(0))
    shares = motions.mT[:, 3:].norm(dim=-1)
    blind = (weights < BLIND * weights[3]) & (shares > MOSTLY)
    if half_blind:
        blind[0] |= (weights[0] < HALF_BLIND * weights[3]) & (shares[0] > NEARLY_ALL)
    motions, shares, weights = motions.mT[blind], shares[blind], weights[blind] / weights[3]
    shift, axes = pair.radius * motions[:, :3] / shares[:, None], motions[:, 3:] / shares[:, None]
    shift = shift - (shift * axes).sum(-1, keepdim=True) * axes
    pivot = transform_points(T, pair.centroid[None])
    return torch.cat([shift + torch.linalg.cross(pivot.expand_as(axes), axes), axes], -1), shares, weights


def _axis_of_symmetry(pair: PartPair, T: Tensor, guess: Tensor) -> Tensor | None:
    """The twist [6] of unit rotation about the part's axis of symmetry in the target's world; None if it is not round.

    `guess` [6]: one near it.
    """
    cost = pair.cost(se3_exp(torch.arange(0, 360, 30).to(T).deg2rad()[:, None] * guess) @ T)
    if cost.amax() - cost.amin() > MAYBE_ROUND:
        return None
    half = se3_log(refine(pair, se3_exp(math.pi * guess) @ T).T @ inverse(T))
    # Half a turn of a part that is hidden in part brings to light where it has no Gaussians.
    for twist in (half / half[3:].norm(), guess):
        cost = _swept(pair, T, twist)[1]
        if cost.amax() - cost.amin() < ROUND:
            return twist
    return None


def _told_turn(pair: PartPair, T: Tensor, twist: Tensor) -> tuple[float, bool]:
    """The best angle about a twist [6] after T, and whether the images tell it."""
    # Light makes no narrow dip, so brightness may count in full.
    angles, cost = _swept(replace(pair, chroma_weight=CHROMA_WEIGHT, brightness_weight=1.0), T, twist)
    best = int(cost.argmin())
    apart = (angles - angles[best] + math.pi).remainder(2 * math.pi) - math.pi
    rival = cost[apart.abs() > math.radians(DIP + 0.5 * STEP)].amin()
    rests = so3_log((se3_exp(angles[best] * twist) @ T)[:3, :3]).norm() < math.radians(DIP + 0.5 * STEP)
    times = TOLD_AT_REST if rests else TOLD
    told = rival > times * cost[best] and rival - cost[best] > TOLD_SHARE * (cost.amax() - cost[best])
    return float(angles[best]), bool(told)


def _rests(pair: PartPair, T: Tensor, twist: Tensor) -> bool:
    """Whether the images tell that a part, whose motion T [4, 4] hardly turns it, has not turned about a twist [6]."""
    _, cost = _swept(replace(pair, chroma_weight=CHROMA_WEIGHT, brightness_weight=1.0), T, twist)
    near = DIP // STEP + 1
    best = cost.roll(near)[: 2 * near + 1].amin()
    some, more = (torch.minimum(cost[steps], cost[-steps]) for steps in (near, 2 * near))
    clearly = more > CLEARLY * best and more - best > CLEAR_SHARE * (cost.amax() - best)
    return bool(some > HARDLY_ROUND * best or clearly)


def _swept(pair: PartPair, T: Tensor, twist: Tensor) -> tuple[Tensor, Tensor]:
    """Angles [K] of a whole turn about a twist [6] after T, and what they cost [K]."""
    angles = torch.arange(0, 360, STEP).to(T).deg2rad()
    return angles, pair.cost(se3_exp(angles[:, None] * twist) @ T)
