"""States that were captured separately: the similarity that brings a state's world to that of state 0, by a part."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import from_rotation_translation, inverse, so3_exp, so3_log
from splatart_ns.geometry.similarity import inverse_similarity, rigid_of, scale_of, similarity, view_of_moved
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.flush import is_flush
from splatart_ns.stages.free_space import FreeSpace, without_haze
from splatart_ns.stages.initial_motion import WIDE_VIEWS, initial_motion
from splatart_ns.stages.motion_preference import AS_WELL, OTHERWISE, SUSPECT
from splatart_ns.stages.part_pair import IN_EVEN_LIGHT, part_pair
from splatart_ns.stages.pose_evidence import ALL_VIEWS, MAX_ITERATIONS
from splatart_ns.stages.refinement import motion_covariance, refine
from splatart_ns.stages.registration import COLOUR, MIN_POINTS, PartPoints, part_points, register
from splatart_ns.stages.render_choice import COARSE_PIXELS, DOUBTFUL_VIEWS, FINE_PIXELS, TINY_PIXELS, VIEWS, choose
from splatart_ns.stages.visibility import shown_of_parts

ALIKE = 1.05
"""A quite other turn that fits less than this many times worse may be the right one. Three by which a box's body looked
alike fitted 1.11 to 1.14 times worse than the right one, after it was refined."""
FEW = 10
"""Steps that tell which fits best."""
SIZED, SIZINGS = 0.02, 3
"""The logarithm of how much larger a part may be in one of two states when it is registered, and so many tries at most
to come there: by its radii in two states a pot was 20 % off, and 1.7 % after one."""
AROUND, SOLID, ENOUGH = 4.0, 0.3, 100
"""Surroundings are so many Gaussians at least, of such an opacity, within so many radii of the part."""
MATCHED = 0.7
"""So many of them are found again; others are shown in one state alone."""
TELLING = 0.8
"""Of turns that fit alike, one is right after which surroundings are less than this many times as far apart as after
the others: in a room a fridge's measured 0.46 times and a safe's 0.67, beside rough turns by a right angle. Of parts,
that one rests: by a laptop's base instead of its lid 0.09 times, by a fridge's and a drawer's bodies about half."""
SWEEP = 15
"""Degrees between turns that are tried first: a bucket's room is nearest over 40."""


@dataclass(frozen=True)
class WorldFit:
    """How a state's world lies in that of state 0."""

    T: Tensor
    """The similarity [4, 4] float64 that brings the state's world to that of state 0."""
    covariance: Tensor
    """[7, 7] float64 of a small similarity after it, about the origin of state 0's world: translation, rotation,
    logarithm of the scale (0 where it was given); see `motion_covariance`."""
    ratio: float
    """How much worse the part's images fit than with each state's own Gaussians."""
    doubtful: bool = False
    """Whether they fit hardly worse after a quite other turn."""


def fit_world(
    splats: tuple[Splat, Splat],
    views: tuple[Sequence[View], Sequence[View]],
    seen: tuple[Tensor, Tensor],
    part: int,
    with_scale: bool,
    seed: int = 0,
    around: tuple[Splat, Splat] | None = None,
) -> WorldFit | None:
    """The similarity, or the rigid motion, of another state's world to that of state 0 under which `part` rests.

    Many-start registration chosen by rendering, after the part is given the size that it has in state 0, and then
    Gauss-Newton on images for all seven unknowns: on few pixels, on more where it looks alike after other motions, to
    choose among these, on many and, unless the part lies flush with others, once more without haze (see `free_space`),
    which made a pair of scissors .1 % too small. None where the images show too little of the part.

    Args:
        splats: The labelled splats of state 0 and of the other state, each in its own world.
        views: Their training views.
        seen: The `visibility` of each state's Gaussians.
        around: What surrounds the object in each state. Of turns after which the part looks alike, they tell the right
            one, if the object stayed where it was.
    """
    points = [part_points(s, v, part) for s, v in zip(splats, seen, strict=True)]
    if min(len(p.xyz) for p in points) < MIN_POINTS:
        return None
    factor = _factor(splats, views, points, part, seed) if with_scale else 1.0
    zoom, zoomed, zoomed_views = _zoomed(splats, views, factor)
    start = initial_motion(zoomed, zoomed_views, seen, part, seed)
    coarse = part_pair(zoomed, zoomed_views, part, VIEWS, COARSE_PIXELS)
    if not start.found or coarse is None:
        return None
    T, doubtful = refine(coarse, start.T, MAX_ITERATIONS, with_scale=with_scale).T, False
    if start.alike:
        closer = [refine(coarse, other, MAX_ITERATIONS, with_scale=with_scale).T for other in start.alike]
        fine = part_pair(zoomed, zoomed_views, part, DOUBTFUL_VIEWS, FINE_PIXELS)
        fine = replace(fine, **IN_EVEN_LIGHT)
        ends = sorted((refine(fine, near, FEW, with_scale=with_scale) for near in (T, *closer)), key=lambda e: e.cost)
        T = ends[0].T
        rivals = [end.T for end in ends if end.cost < ALIKE * ends[0].cost]
        doubtful = any(_quite_other(rival, T) for rival in rivals)
        if doubtful and around is not None:
            if (swept := _swept(around, rivals, zoom, points[0])) is not None:
                end = refine(fine, swept, FEW, with_scale=with_scale)
                rivals += [end.T] if end.cost < ALIKE * ends[0].cost else []
            apart = [surroundings_apart(around, inverse_similarity(r) @ zoom.to(r), points[0]) for r in rivals]
            best = min(range(len(rivals)), key=apart.__getitem__)
            others = [a for a, r in zip(apart, rivals, strict=True) if _quite_other(r, rivals[best])]
            if max(apart) < math.inf and apart[best] < TELLING * min(others, default=0.0):
                T, doubtful = rivals[best], False
    fit = refine_world(splats, views, part, inverse_similarity(T) @ zoom.to(T), with_scale)
    return replace(fit, doubtful=doubtful)


def _factor(
    splats: tuple[Splat, Splat],
    views: tuple[Sequence[View], Sequence[View]],
    points: Sequence[PartPoints],
    part: int,
    seed: int,
) -> float:
    """How many times larger the other state's world is made so that a part has about the size that it has in state 0.

    That is told by its radius in both states, and, as they may show different sides of it, by images of few pixels, in
    which motions that registration proposes are refined with their scale.
    """
    source, target = points
    factor = source.radius / target.radius
    for _ in range(SIZINGS):
        pair = part_pair(*_zoomed(splats, views, factor)[1:], part, WIDE_VIEWS, TINY_PIXELS)
        if pair is None:
            return factor
        proposed = register(source, replace(target, xyz=factor * target.xyz), seed)
        near = choose(pair, torch.from_numpy(proposed).to(pair.centroid), math.inf, keep=1)
        best = min((refine(pair, T, MAX_ITERATIONS, with_scale=True) for T in near), key=lambda end: end.cost)
        scale = float(scale_of(best.T))
        factor /= scale
        if abs(math.log(scale)) < SIZED or best.cost < AS_WELL * pair.own_cost():
            break
    return factor


def _zoomed(
    splats: tuple[Splat, Splat], views: tuple[Sequence[View], Sequence[View]], factor: float
) -> tuple[Tensor, tuple[Splat, Splat], tuple[Sequence[View], Sequence[View]]]:
    """How the other state's world becomes so many times larger [4, 4], and both states with that."""
    zoom = similarity(factor, torch.eye(3), torch.zeros(3))
    return zoom, (splats[0], splats[1].scaled(factor)), (views[0], moved_views(views[1], zoom))


def _quite_other(a: Tensor, b: Tensor) -> bool:
    """Whether two similarities [4, 4] turn quite otherwise."""
    return bool(so3_log((rigid_of(a) @ inverse(rigid_of(b)))[:3, :3]).norm() > OTHERWISE)


def _swept(around: tuple[Splat, Splat], rivals: Sequence[Tensor], zoom: Tensor, part: PartPoints) -> Tensor | None:
    """The first of similarities [4, 4] by which a part looks alike, turned to where surroundings are nearest about the
    axes by which the others are turned against it: of a round part all turns look alike, and few are among them.

    None where too little is near.
    """
    first, *others = rivals
    pivot = torch.from_numpy(part.centroid).to(first)
    turns = [so3_log(rigid_of(inverse_similarity(first) @ r)[:3, :3]) for r in others if _quite_other(r, first)]

    def turned(axis: Tensor, degrees: int) -> Tensor:
        R = so3_exp(math.radians(degrees) * axis)
        return first @ from_rotation_translation(R, pivot - R @ pivot)

    def apart(turn: tuple[Tensor, int]) -> float:
        return surroundings_apart(around, inverse_similarity(turned(*turn)) @ zoom.to(first), part)

    axis, rough = min(((t / t.norm(), degrees) for t in turns for degrees in range(0, 360, SWEEP)), key=apart)
    nearest = min(((axis, degrees) for degrees in range(rough - SWEEP + 1, rough + SWEEP)), key=apart)
    return turned(*nearest) if apart(nearest) < math.inf else None


def surroundings_apart(around: tuple[Splat, Splat], T: Tensor, part: PartPoints) -> float:
    """How far what surrounds a part in another state, after a similarity T [4, 4], is from what does in its own: the
    trimmed mean distance of places and colours, in the part's radii. Infinite where too little is near."""
    near = []
    for splat in (around[0], moved_splat(around[1], T)):
        solid = splat.select(splat.opacities > SOLID)
        xyz, rgb = (x.double().numpy(force=True) for x in (solid.means, solid.base_colours))
        inside = np.linalg.norm(xyz - part.centroid, axis=1) < AROUND * part.radius
        near.append(np.concatenate([xyz, COLOUR * part.radius * rgb], axis=1)[inside])
    if min(map(len, near)) < ENOUGH:
        return math.inf
    distance = np.sort(cKDTree(near[0]).query(near[1])[0])
    return float(distance[: round(MATCHED * len(distance))].mean() / part.radius)


def refine_world(
    splats: tuple[Splat, Splat],
    views: tuple[Sequence[View], Sequence[View]],
    part: int,
    world: Tensor,
    with_scale: bool,
) -> WorldFit:
    """`fit_world` from a similarity near the best, which brings the other state's world to that of state 0."""
    eye = torch.eye(4).to(world)
    flush = any(is_flush(some, part) for some in views)
    for without in (False,) if flush else (False, True):
        there = moved_views(views[1], world)
        brought = splats[0], moved_splat(splats[1], world)
        pair = part_pair(brought, (views[0], there), part, ALL_VIEWS, FINE_PIXELS, near=True)
        pair = replace(pair, **IN_EVEN_LIGHT)
        if without:
            pair = without_haze(pair, eye, (FreeSpace.of(views[0]), FreeSpace.of(there)))
        found = refine(pair, eye, 2 * MAX_ITERATIONS, with_scale=with_scale)
        world = inverse_similarity(found.T) @ world
    covariance = torch.zeros(7, 7).to(world)
    n = found.equations.H.shape[-1]
    covariance[:n, :n] = motion_covariance(pair, found.T, found.equations)
    return WorldFit(world, covariance, found.cost / max(pair.own_cost(), 1e-12))


def anchors(splats: Sequence[Splat], seen: Sequence[Tensor], num_parts: int) -> list[int]:
    """The parts 1..P by how much of them the state that shows least of them shows, most first."""
    least = shown_of_parts(splats, seen, num_parts).amin(0)
    return [int(p) + 1 for p in least.argsort(descending=True, stable=True)]


def fit_worlds(
    splats: Sequence[Splat],
    views: Sequence[Sequence[View]],
    seen: Sequence[Tensor],
    parts: Iterable[int],
    with_scale: bool,
    seed: int = 0,
    around: Sequence[Splat] | None = None,
) -> tuple[int, list[WorldFit]] | None:
    """The first of `parts` that fits well in all states, or else that which fits best, and every state's `fit_world` by
    it but state 0's; None where no part is seen in all states."""
    best: tuple[int, list[WorldFit]] | None = None
    for part in parts:
        fits = []
        for s in range(1, len(splats)):
            pair = [(everything[0], everything[s]) for everything in (splats, views, seen)]
            fits.append(fit_world(*pair, part, with_scale, seed, None if around is None else (around[0], around[s])))
        if None in fits:
            continue
        if best is None or max(f.ratio for f in fits) < max(f.ratio for f in best[1]):
            best = part, fits
        if max(f.ratio for f in best[1]) < SUSPECT:
            break
    return best


def resting_part(
    around: Sequence[Splat], motions: Tensor, known: Tensor, points: PartPoints, parts: Sequence[int]
) -> int | None:
    """The part that rests in what surrounds the object, where that is not the anchor, which brought worlds together.

    None where surroundings do not tell.

    Args:
        around: What surrounds the object in each state, all in the world of state 0.
        motions: Of each part 1..P since state 0 [S, P, 4, 4], as if the anchor rested.
        known: Which of these were found [S, P].
        points: Of the anchor, in state 0.
        parts: The anchor, then the others, the better ones first: several may rest.
    """

    def apart(T: Tensor) -> float:
        """Where a part that moves by T [S, 4, 4] is held instead."""
        return sum(surroundings_apart((around[0], around[s]), inverse(T[s]), points) for s in range(1, len(around)))

    anchor, *others = parts
    there = apart(torch.eye(4).to(motions.double()).expand(len(around), 4, 4))
    held = {p: apart(motions[:, p - 1].double()) for p in others if known[:, p - 1].all()}
    least = min(held.values(), default=math.inf)
    return next((p for p, a in held.items() if TELLING * a <= least < TELLING * there), None)


def moved_views(views: Sequence[View], T: Tensor) -> list[View]:
    """The views after the similarity T [4, 4] of their world."""
    back, scale = inverse_similarity(T.double()), float(scale_of(T))
    moved = []
    for v in views:
        viewmat = view_of_moved(v.viewmat.double(), back.to(v.viewmat.device)).float()
        moved.append(replace(v, viewmat=viewmat, depth=None if v.depth is None else scale * v.depth))
    return moved


def moved_splat(splat: Splat, T: Tensor) -> Splat:
    """The splat after a similarity T [4, 4]."""
    return splat.scaled(float(scale_of(T))).transformed(rigid_of(T))


def world_record(state: str, part: str, T: Tensor, fit: WorldFit) -> dict[str, Any]:
    """What report.json says of a state's world, T [4, 4] its similarity to that of state 0, in the capture's unit."""
    turn, scale = fit.covariance.diagonal()[3:6].sum().sqrt(), fit.covariance[6, 6].sqrt()
    return {
        "state": state,
        "part": part,
        "T_world_state": T.tolist(),
        "scale": float(scale_of(T)),
        "scale_deviation": float(scale_of(T) * scale),
        "turn_deviation_degrees": math.degrees(float(turn)),
        "residual_ratio": fit.ratio,
        "doubtful": fit.doubtful,
    }


def world_sentence(record: dict[str, Any], first: str) -> str:
    """The same for a person."""
    R = torch.tensor(record["T_world_state"], dtype=torch.float64)[:3, :3] / record["scale"]
    turn = math.degrees(float(so3_log(R).norm()))
    sentence = (
        f"{record['state']}: its world is brought to that of {first} by the part {record['part']}: scale "
        f"{record['scale']:.5f} +- {record['scale_deviation']:.5f}, turned by {turn:.2f} "
        f"+- {record['turn_deviation_degrees']:.2f} deg"
    )
    if record["residual_ratio"] > SUSPECT:
        kept = record["scale_deviation"] == 0
        mend = "let its scale be found (--worlds similar), or name" if kept else "check the result, or name"
        return f"{sentence}; its images fit badly, {mend} another part by --root."
    if record["doubtful"]:
        return f"{sentence}; after a quite other turn its images fit hardly worse, name another part by --root."
    return f"{sentence}."
