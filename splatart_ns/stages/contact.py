"""Where two parts touch, and whether they stay in touch while they move."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from splatart_ns.geometry.se3 import inverse, transform_points
from splatart_ns.stages.unseen import known_states, relative_motion

_MAX_POINTS = 2000
_TOUCHING = 0.01  # share of a part's points that counts as its contact


@dataclass(frozen=True)
class Contact:
    """How close two parts stay, to each other and to the axis of a joint."""

    gap: float
    """1st percentile of the distances from one part's points to the other part, the largest over the states."""
    points: Tensor
    """The points [K, 3] of either part that stay closest to the other in all states, canonical frame."""

    parts: tuple[Tensor, Tensor]
    """Points [N, 3] of both parts, where these are at state 0."""

    def distance_to_axis(self, axis: Tensor, origin: Tensor, through_holes: bool = True) -> float:
        """How far the line through `origin` [3] along the unit vector `axis` [3] passes by the two parts, added up.

        By a part that lies all around it, with a hole there for the other part, it does not: no image shows what is
        behind a knob. The distance of their contact would not do: what two knobs have nearest to each other lies on a
        wrong axis between them as near as the rim of a knob, behind which the panel is hidden, to the right one. Unless
        axes may not pass `through_holes`, as that of a pane turned about its middle does through its frame.
        """
        across = [torch.linalg.cross(points - origin, axis.expand_as(points)) for points in self.parts]
        nearest, farthest = zip(*(_extent(torch.linalg.vector_norm(x, dim=-1)) for x in across), strict=True)
        # A hole less than half as wide as the other part is not for it, and may be the distance of the samples.
        holes = [
            through_holes and 2 * nearest[k] > farthest[1 - k] and _all_around(x, axis) for k, x in enumerate(across)
        ]
        return sum(0.0 if hole else distance for hole, distance in zip(holes, nearest, strict=True))

    def distance_to_point(self, point: Tensor) -> float:
        """How far a point [3] lies from the two parts, added up."""
        return sum(_nearest(torch.linalg.vector_norm(points - point, dim=-1)) for points in self.parts)


def _nearest(distances: Tensor) -> float:
    """1st percentile of distances [N]: no stray point decides."""
    return _extent(distances)[0]


def _extent(distances: Tensor) -> tuple[float, float]:
    """1st and 99th percentile of distances [N]."""
    rank = max(1, round(_TOUCHING * len(distances)))
    return float(distances.kthvalue(rank).values), float(distances.kthvalue(len(distances) + 1 - rank).values)


def _all_around(across: Tensor, axis: Tensor) -> bool:
    """Whether on no side of a line along `axis` [3] are fewer points than a contact has (Tukey's depth of the line).

    `across` [N, 3]: the points' distances from it, in the plane across it.
    """
    u = torch.linalg.cross(axis, torch.eye(3).to(axis)[axis.abs().argmin()])
    angles = torch.arange(0, 360, 10).to(axis).deg2rad()[:, None]
    sides = angles.cos() * u + angles.sin() * torch.linalg.cross(axis, u)
    return bool((across @ sides.T > 0).double().mean(0).min() >= _TOUCHING)


def find_contacts(
    points: dict[int, Tensor],
    motions: dict[int, Tensor],
    pairs: Iterable[tuple[int, int]] | None = None,
    known: Mapping[int, Tensor] | None = None,
) -> dict[tuple[int, int], Contact]:
    """Contacts of pairs (a, b), by default all with a < b, of parts with points [N, 3] at state 0, motions [S, 4, 4].

    Of a part with more than 2000 points, evenly picked ones are used. `known`: in which states the motions are known
    [S] bool, by default all; the others do not count.
    """
    motions = {p: T.double() for p, T in motions.items()}
    known = known or known_states(motions, None)
    sampled = {p: x[:: math.ceil(len(x) / _MAX_POINTS)].double() for p, x in points.items()}
    trees = {p: cKDTree(x.numpy(force=True)) for p, x in sampled.items()}
    pairs = [(a, b) for a in sorted(points) for b in sorted(points) if a < b] if pairs is None else pairs
    contacts = {}
    for pair in pairs:
        a, b = pair if known[pair[0]][0] else pair[::-1]
        T_rel, place, _ = relative_motion(motions[a], motions[b], known[a], known[b])
        placed, tree = sampled[b], trees[b]
        if not known[b][0]:
            placed = transform_points(place, placed)
            tree = cKDTree(placed.numpy(force=True))
        contacts[pair] = _contact(sampled[a], placed, trees[a], tree, T_rel)
    return contacts


def _contact(points_a: Tensor, points_b: Tensor, tree_a: cKDTree, tree_b: cKDTree, T_a_b: Tensor) -> Contact:
    from_b = tree_a.query(transform_points(T_a_b, points_b).numpy(force=True))[0]  # [S, N]
    from_a = tree_b.query(transform_points(inverse(T_a_b), points_a).numpy(force=True))[0]
    share = 100 * _TOUCHING
    # From the side whose contact is the larger share: a small part's foot is lost among the points of a large one.
    gap = np.minimum(np.percentile(from_a, share, axis=1), np.percentile(from_b, share, axis=1)).max()
    staying = []
    for points, distances in ((points_a, from_a), (points_b, from_b)):
        count = max(1, round(_TOUCHING * len(points)))
        staying.append(points[torch.from_numpy(distances.max(0).argsort()[:count]).to(points.device)])
    return Contact(float(gap), torch.cat(staying), (points_a, points_b))
