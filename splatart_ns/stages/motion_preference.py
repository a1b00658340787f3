"""Which of several motions that render about as well is preferred, by what parts of objects do."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

OTHERWISE = math.radians(60)
"""A motion that turns a part by so much more or less than another, or about another axis, is quite another one."""
SLIDE_TURN = 6.0
"""Degrees by which a slide may seem to turn."""
TURNED_OVER = math.radians(90)
"""A motion that turns a part by more is doubted, and a slide that looks alike is preferred to it."""
UPRIGHT = 1.05
"""Where it fits as well as each state's own Gaussians do, and one that turns the part by less costs less than this many
times as much, that is preferred."""
HALF_TURN = math.radians(170)
"""What turns by more makes half a turn; to one that does, one that makes less is preferred while in doubt."""
PITCHED, UNPITCHED = 0.1, 0.03
"""A motion that shifts a part by more than the first along its axis, in part radii, is no mere turn; one that shifts it
by less than the second is."""
SIMILAR_TURN = 1.5
"""A mere turn is preferred to a motion that is none where it costs less than this many times as much."""
ALIKE = 1.25
"""Motions that cost less than this many times the chosen one render as well: plain square knobs turned by 90 degrees
more measured 1.08 to 1.18, hexagonal ones 1.03 to 1.12, other parts that are seen well above 2."""
DOUBTFUL = 2.0
"""So many times in place of `ALIKE` where the chosen motion may turn the part over: doors were seen to cost 1.4 times
as much as turned over, in few views or as they are lit."""
SUSPECT = 4.0
"""A motion that fits this many times worse than each state's own Gaussians is searched for once more, more widely.
Right ones measured 1.0 to 2.5, but for parts of which one state hides most."""
AS_WELL = 1.2
"""Motions that cost less than this many times what each state's own Gaussians do fit as well as any."""


def prefer_slide(T: np.ndarray, cost: np.ndarray, order: list[int], own: float = math.inf) -> list[int]:
    """`order` of motions [C, 4, 4] by cost [C], with a slide first that fits nearly as well as a best one by which the
    part turns over; `own` is what each state's own Gaussians cost.

    Where one state hides most of a part, no motion fits well: a drawer was seen to render a tenth better turned over.
    What fits far worse than a state's own says still less: half a turn cost two thirds of what no motion did, and both
    eight times `own` or more, of a base that rests under an opened screen.
    """
    turn = _angles(T)
    times = DOUBTFUL if cost[order[0]] > SUSPECT * own else ALIKE
    slides = [i for i in order if turn[i] < math.radians(SLIDE_TURN) and cost[i] < times * cost[order[0]]]
    return order if turn[order[0]] < TURNED_OVER else _first(order, slides)


def prefer_upright(T: np.ndarray, cost: np.ndarray, order: list[int]) -> list[int]:
    """`order` of motions [C, 4, 4] by cost [C], with one first that turns the part less far than over and fits as well
    as a best one by which it turns over; empty where there is none, or the best does not.

    A knob looks alike turned over, but for its back, which no image shows.
    """
    turn = _angles(T)
    upright = [i for i in order if turn[i] < TURNED_OVER and cost[i] < UPRIGHT * cost[order[0]]]
    return [] if turn[order[0]] < TURNED_OVER or not upright else _first(order, upright)


def prefer_turn(T: np.ndarray, cost: np.ndarray, order: list[int], radius: float) -> list[int]:
    """`order` of motions [C, 4, 4] by cost [C], with one first that only turns and fits nearly as well as a best one
    that also shifts the part along its axis.

    A plain door fits nearly as well upside down, but only the right way round it turns about a hinge. Most parts that
    turn hang on something that rests; that of others another motion merely turns is a rare accident.
    """

    def shift(i: int) -> float:
        turn = Rotation.from_matrix(T[i, :3, :3]).as_rotvec()
        angle = float(np.linalg.norm(turn))
        return np.inf if np.degrees(angle) < SLIDE_TURN else abs(float(turn @ T[i, :3, 3])) / angle / radius

    best = order[0]
    if not PITCHED < shift(best) < np.inf:
        return order
    turns = [i for i in order if shift(i) < UNPITCHED and cost[i] < SIMILAR_TURN * cost[best]]
    return _first(order, turns)


def prefer_less_turn(T: np.ndarray, cost: np.ndarray, order: list[int]) -> list[int]:
    """`order` of motions [C, 4, 4] by cost [C]: before half a turn comes less of one that differs by half a turn.

    By whatever angle a plate turns about a hinge, once it is turned over, about a line across the hinge, it seems to
    have made half a turn, about the line between where that one was and is. Parts that do make half a turn are rare.
    Motions by which no hinge is told, and those that cost `DOUBTFUL` times as much, are not preferred.
    """
    first, turn = order[0], _angles(T)
    if turn[first] < HALF_TURN:
        return order
    hinged = (
        (math.pi - HALF_TURN < turn) & (turn < HALF_TURN) & (_angles(T[first, :3, :3].T @ T[:, :3, :3]) > HALF_TURN)
    )
    less = [i for i in order if hinged[i] and cost[i] < DOUBTFUL * cost[first]]
    return _first(order, less)


def _first(order: list[int], preferred: list[int]) -> list[int]:
    """The order with the first of those that are preferred, if there is one, before all others."""
    return [*preferred[:1], *(i for i in order if i not in preferred[:1])]


def looks_alike(
    T: np.ndarray, cost: np.ndarray, chosen: int, other: int, own: float = 0.0, times: float = ALIKE
) -> bool:
    """Whether of motions [C, 4, 4] that cost [C] the `other` turns the part quite otherwise and costs less than so many
    `times` as much, or fits as each state's `own` Gaussians do."""
    turned = Rotation.from_matrix(T[chosen, :3, :3].T @ T[other, :3, :3]).magnitude()
    # Half of what is quite another one: a hexagonal part looks alike after 60 degrees.
    return bool(turned > OTHERWISE / 2 and cost[other] < max(times * cost[chosen], AS_WELL * own))


def _angles(T: np.ndarray) -> np.ndarray:
    """By how much motions [C, 4, 4] turn: radians [C]."""
    return Rotation.from_matrix(T[:, :3, :3]).magnitude()
