"""What all images say of the poses: where exactly they are, how certain, and which parts could as well only slide."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import inverse, se3_log, so3_log, transform_points
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.covisibility import compared_by_common, covisible
from splatart_ns.stages.flush import compared_by_seen, in_sight, is_flush, surface_depths, without_neighbours
from splatart_ns.stages.free_space import FreeSpace, without_haze
from splatart_ns.stages.joint import PRISMATIC_BELOW
from splatart_ns.stages.motion_preference import AS_WELL
from splatart_ns.stages.part_pair import IN_EVEN_LIGHT, PartPair, part_pair
from splatart_ns.stages.refinement import (
    NormalEquations,
    Refinement,
    motion_covariance,
    refine,
    rotation_held_ratio,
    shifted,
)
from splatart_ns.stages.render_choice import FINE_PIXELS, VIEWS
from splatart_ns.stages.symmetry import DIP, settle_turn
from splatart_ns.stages.visibility import clearest

ALL_VIEWS = 60
"""Views of each state that the last refinement looks at, where there are so many."""
MAX_ITERATIONS = 16
"""Most parts take 1 to 5; a shut door that begins 3 % of the object off took 14."""
SLIPPED = math.radians(5)
"""Refining that turns a part by more from where a sweep put it has left what told that."""
LOST = math.radians(2 * DIP)
"""Nor was anything told where the two ways of looking are further apart than a dip is wide."""
SLID = 5.0
"""Standard deviations by which a part that seems to rest must have slid: parts that rest measured up to 2.3, round ones
that turned up to 3.5, most buttons that were pressed by half a pixel to two 5 to 20."""
LEAST_SLIDE = 0.1
"""Nor is it less than this share of a pixel: how light falls on a part otherwise moves it by 0.01."""
MISFIT = 0.006
"""A part does not rest where that costs more than each state's own Gaussians do by so much a pixel, as if 4 % of its
pixels were empty, and `AS_WELL` times as much: of 99 that rest none costs so many times as much and 0.0025 more, a part
in images of 64 pixels 0.0056, six of 21 that had moved 0.0067 to 0.1 (docs/joints.md)."""
MAYBE_SLIDING = math.radians(10)
"""A part that turned less than this against another may be sliding: thin parts' turns are known no better."""


def refine_poses(
    splats: Sequence[Splat],
    views: Sequence[Sequence[View]],
    T: Tensor,
    frozen: Tensor,
    clear: Sequence[Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """The last rung of the search for poses: Gauss-Newton on all views, and the certainty that they give.

    Few views leave the turn of a round part to chance, and the brightness of a photometric loss misleads it, because
    light stays in the world while parts turn; silhouettes, hues and, in even light, brightness of all views hold it. A
    round part's turn about its own axis is settled by trying all of them (`settle_turn`), also where the pose is to
    stay as it is.

    Where a part rests, one that slides past it does not turn: what it seems to turn by is error, which its shift makes
    up for. So parts whose images fit a mere shift as well are held to that.

    Parts are compared by what both states show of them (see `covisibility`); what lies flush with others, also by where
    these show that it is not (see `flush`), and other parts, once about right, without haze (see `free_space`).

    Args:
        splats: One labelled splat per state.
        views: Training views of each state.
        T: Poses [S, P, 4, 4], near the optimum.
        frozen: Which of them stay as they are [S, P] bool.
        clear: `clearest` of each state's Gaussians in its own views [N], if it has been measured.

    Returns:
        The refined poses, and their covariances [S, P, 6, 6]: T = se3_exp(xi) T_true, xi = (translation, rotation). NaN
        for a part that no labelled view shows; 0 at state 0. And which of those that were to stay as they are do not
        fit there [S, P] bool.
    """
    T = T.clone()
    S, P = T.shape[:2]
    covariances = torch.zeros(S, P, 6, 6, dtype=torch.float64, device=T.device)
    misfits = torch.zeros(S, P, dtype=torch.bool)
    something_rests = bool(frozen.all(0).any())
    comparison = _Comparison(splats, views, T, clear)
    for p in range(P):
        refined, slides = 0, {}
        for s in range(1, S):
            pair = comparison.pair(p + 1, s, T[s, p])
            if pair is None:
                covariances[s, p] = torch.nan
                continue
            pair, found, untold = _found(comparison, pair, p + 1, s, T[s, p], bool(frozen[s, p]))
            if frozen[s, p] and _misfits(pair, T[s, p]):
                misfits[s, p] = _misfits(comparison.without_any_haze(pair, s, T[s, p]), T[s, p])
            T[s, p], covariances[s, p] = found.T, motion_covariance(pair, found.T, found.equations) + untold
            if something_rests and not frozen[s, p]:
                refined += 1
                slide = None if untold.any() else _slide(pair, found)
                if slide is not None:
                    slides[s] = slide.T, motion_covariance(pair, slide.T, slide.equations)
        if len(slides) == refined:
            for s, (slid, covariance) in slides.items():
                T[s, p], covariances[s, p] = slid, covariance
    return T, covariances, misfits


def _found(
    comparison: _Comparison, pair: PartPair, part: int, s: int, T: Tensor, stays: bool
) -> tuple[PartPair, Refinement, Tensor]:
    """Where a part is at state s, from near its pose T [4, 4], with the pair that says so, and how uncertain it is
    besides, of what no image tells [6, 6]. If it `stays`, only a little slide and a turn of its own are looked for."""
    if stays:
        rests = refine(pair, T, 0)
        found = _slid_a_little(pair, rests) or rests
    else:
        found = refine(pair, T, MAX_ITERATIONS)
        clearer = comparison.without_haze(pair, part, s, found.T)
        if clearer is not pair:
            pair, found = clearer, refine(clearer, found.T, MAX_ITERATIONS)
    turned, untold = comparison.settle_turn(part, s, found.T)
    if not torch.equal(turned, found.T):
        ends = refine(pair, turned, MAX_ITERATIONS)
        if not untold.any():
            ends, untold = _held_by_brightness(pair, found.T, turned, ends)
        found = ends
    return pair, found, untold


def _slide(pair: PartPair, found: Refinement) -> Refinement | None:
    """A mere shift from where a part was found, if its images fit that as well."""
    if not _may_have_slid(pair, found.T):
        return None
    slide = shifted(pair, found.T)
    return slide if slide.cost < PRISMATIC_BELOW * found.cost else None


def _slid_a_little(pair: PartPair, stays: Refinement) -> Refinement | None:
    """The slide of a part that seems to stay as it is, if it is one that no error explains.

    Buttons move by a pixel or two, which hardly shows in what their images cost, but in all of them alike.
    """
    T, equations = stays.T, stays.equations
    shift = NormalEquations(equations.H[:, :3, :3], equations.g[:, :3], equations.cost)
    H = shift.H.sum(0)
    step = -torch.linalg.solve(H + 1e-12 * torch.eye(3).to(H), shift.g.sum(0)) * pair.radius
    if _deviations(step, motion_covariance(pair, T, shift)) < SLID:
        return None
    slide = shifted(pair, T, T[:3, :3])
    moved = transform_points(slide.T, pair.centroid[None])[0] - transform_points(T, pair.centroid[None])[0]
    surely = _deviations(moved, motion_covariance(pair, slide.T, slide.equations)) >= SLID
    return slide if surely and moved.norm() >= LEAST_SLIDE * _pixel(pair) else None


def _misfits(pair: PartPair, T: Tensor) -> bool:
    """Whether a part's images fit it far worse at T [4, 4] than each state's own Gaussians."""
    own, cost = pair.own_cost(), float(pair.cost(T[None])[0])
    return cost > AS_WELL * own and cost - own > MISFIT


def _pixel(pair: PartPair) -> float:
    """How long what a pixel shows of the part in the source state is: the median over the views."""
    x = pair.centroid[None]
    sizes = [
        transform_points(v.viewmat.to(x), x)[0, 2] / v.K[0, 0] / v.factor for of_state in pair.views for v in of_state
    ]
    return float(torch.stack(sizes).median())


def _deviations(shift: Tensor, covariance: Tensor) -> float:
    """How many standard deviations long a shift [3] is, by its covariance [6, 6]."""
    return float((shift @ torch.linalg.solve(covariance[:3, :3], shift)).sqrt())


class _Comparison:
    """How parts of state 0 and of another are compared in all views; what they share is measured once."""

    def __init__(
        self,
        splats: Sequence[Splat],
        views: Sequence[Sequence[View]],
        T: Tensor,
        clear: Sequence[Tensor] | None,
    ):
        self._splats, self._views = splats, views
        clear = clear or [clearest(*state) for state in zip(splats, views, strict=True)]
        self._common = [covisible(*((x[0], x[s]) for x in (splats, views, clear)), T[s]) for s in range(1, len(splats))]
        self._depths = cache(lambda s: surface_depths(splats[s], views[s]))
        self._free = cache(lambda s: FreeSpace.of(views[s]))
        self._is_flush = cache(lambda part, s: is_flush(views[s], part))

    def _lies_flush(self, part: int, s: int) -> bool:
        return self._is_flush(part, 0) or self._is_flush(part, s)

    def pair(self, part: int, s: int, T: Tensor) -> PartPair | None:
        """A part at states 0 and s, about the motion T [4, 4] between them; None where no labelled view shows it."""
        states, flush = (0, s), self._lies_flush(part, s)
        compared = [self._views[t] for t in states]
        if flush:
            compared = [
                [without_neighbours(v, d, part) for v, d in zip(some, self._depths(t), strict=True)]
                for t, some in zip(states, compared, strict=True)
            ]
        splats = self._splats[0], self._splats[s]
        pair = part_pair(splats, tuple(compared), part, ALL_VIEWS, FINE_PIXELS, near=True)
        if pair is None:
            return None
        of_part = [both[x.part_ids == part] for both, x in zip(self._common[s - 1], splats, strict=True)]
        pair = compared_by_common(replace(pair, **IN_EVEN_LIGHT), of_part)
        if flush:
            seen = [
                in_sight(x, self._views[t], self._depths(t), part) for t, x in zip(states, pair.splats, strict=True)
            ]
            pair = compared_by_seen(pair, T, seen)
        return pair

    def without_haze(self, pair: PartPair, part: int, s: int, T: Tensor) -> PartPair:
        """A `pair` that has been refined to T [4, 4]; the same one where there is no haze, or the part lies flush."""
        return pair if self._lies_flush(part, s) else self.without_any_haze(pair, s, T)

    def without_any_haze(self, pair: PartPair, s: int, T: Tensor) -> PartPair:
        """A `pair` without haze, also where the part lies flush."""
        return without_haze(pair, T, (self._free(0), self._free(s)))

    def settle_turn(self, part: int, s: int, T: Tensor) -> tuple[Tensor, Tensor]:
        """See `symmetry.settle_turn`."""
        return settle_turn((self._splats[0], self._splats[s]), (self._views[0], self._views[s]), part, T)


def _held_by_brightness(pair: PartPair, T: Tensor, told: Tensor, ends: Refinement) -> tuple[Refinement, Tensor]:
    """Where a round part's pose T [4, 4] ends that brightness told to be turned to `told`, and how uncertain that is
    [6, 6]; `ends`: where refining put it from there.

    In even light its turn may not show, and refining slips off it. Then the pose is refined on brightness as it is.
    That has light in it: by how far the two are apart it may be off. If it is too far, nothing is told, and T stays.
    """
    if so3_log(ends.T[:3, :3] @ told[:3, :3].mT).norm() < SLIPPED:
        return ends, torch.zeros(6, 6).to(told)
    bright = refine(replace(pair, even_light=False), told, MAX_ITERATIONS)
    slip = se3_log(ends.T @ inverse(bright.T))
    angle = slip[3:].norm()
    if angle > LOST:
        return refine(pair, T, 0), math.pi**2 / 3 * (slip / angle).outer(slip / angle)
    return bright, slip.outer(slip)


def _may_have_slid(pair: PartPair, T: Tensor) -> bool:
    """Whether a motion [4, 4] turns a part little, and less than it shifts it."""
    angle = float(so3_log(T[:3, :3]).norm())
    shift = float((transform_points(T, pair.centroid[None])[0] - pair.centroid).norm())
    return angle < MAYBE_SLIDING and shift > angle * pair.radius


def rotation_held_ratios(splats: Sequence[Splat], views: Sequence[Sequence[View]], T: Tensor) -> Tensor:
    """How much worse part b's images fit when b may only slide against part a [P, P], row a, column b.

    Measured at the state where b turned most against a; NaN where it turned more than `MAYBE_SLIDING` (it does not
    slide), where b did not turn against a, and where no labelled view shows b.
    """
    P = T.shape[1]
    out = torch.full((P, P), torch.nan)
    for b in range(P):
        for a in range(P):
            relative = inverse(T[:, a]) @ T[:, b]
            angles = so3_log(relative[:, :3, :3]).norm(dim=-1)
            s = int(angles.argmax())
            if a == b or s == 0 or angles[s] > MAYBE_SLIDING:
                continue
            pair = part_pair((splats[0], splats[s]), (views[0], views[s]), b + 1, VIEWS, FINE_PIXELS)
            if pair is not None:
                out[a, b] = rotation_held_ratio(pair, T[s, b], T[s, a, :3, :3])
    return out.to(T.device)
