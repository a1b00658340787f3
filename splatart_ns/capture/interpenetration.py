"""Whether the parts of an object made by code reach into each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import trimesh

from splatart_ns.capture.articulated_object import ArticulatedObject

_POINTS_PER_PART = 1500
_ALLOWED = 0.006
"""Depth that passes for contact, as a share of the object's length: about a pixel."""


class Interpenetration:
    """Of one object's parts, whose solids are convex.

    Depth is that of points on one part's surface below the nearest face of a solid of another part.
    """

    def __init__(self, object: ArticulatedObject) -> None:
        self._object = object
        self._allowed = _ALLOWED * _length(object)
        rng = np.random.default_rng(0)
        self._points = {link.name: _surface_points(link.solids, rng) for link in object.links}
        self._solids = {link.name: [_planes(s) for s in link.solids] for link in object.links}

    def is_gross(self, values: Mapping[str, float]) -> bool:
        """Whether some part reaches further into another one than contact explains."""
        return self.depth(values) > self._allowed

    def depth(self, values: Mapping[str, float]) -> float:
        """The greatest depth over all pairs of parts at these joint values, 0 where none touch; length."""
        poses = self._object.link_poses(values)
        deepest = 0.0
        for a, points in self._points.items():
            for b, solids in self._solids.items():
                if a != b:
                    T = np.linalg.inv(poses[b]) @ poses[a]
                    deepest = max(deepest, _depth(points @ T[:3, :3].T + T[:3, 3], solids))
        return deepest


def _length(object: ArticulatedObject) -> float:
    """Of the longest side of the box about the object at its joints' middle values."""
    poses = object.link_poses({j.name: 0.5 * (j.limits[0] + j.limits[1]) for j in object.joints})
    points = [
        np.asarray(s.vertices) @ poses[link.name][:3, :3].T + poses[link.name][:3, 3]
        for link in object.links
        for s in link.solids
    ]
    return float(np.ptp(np.concatenate(points), axis=0).max())


def _surface_points(solids: Sequence[trimesh.Trimesh], rng: np.random.Generator) -> np.ndarray:
    """Vertices and points spread by area, [N, 3]."""
    corners = np.concatenate([np.asarray(s.vertices)[np.asarray(s.faces)] for s in solids])
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    chosen = corners[rng.choice(len(corners), _POINTS_PER_PART, p=area / area.sum())]
    weights = rng.dirichlet((1.0, 1.0, 1.0), _POINTS_PER_PART)
    return np.concatenate([np.einsum("nk,nkd->nd", weights, chosen), *(np.asarray(s.vertices) for s in solids)])


def _planes(solid: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bounds [2, 3], and the half-spaces of a convex solid: outward normals [K, 3] and offsets [K]."""
    corners = np.asarray(solid.vertices)[np.asarray(solid.faces)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=-1)
    kept = length > 1e-12
    normals = normals[kept] / length[kept, None]
    offsets = np.einsum("kd,kd->k", normals, corners[kept, 0])
    planes = np.unique(np.round(np.column_stack([normals, offsets]), 9), axis=0)
    return np.asarray(solid.bounds), planes[:, :3], planes[:, 3]


def _depth(points: np.ndarray, solids: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> float:
    deepest = 0.0
    for (low, high), normals, offsets in solids:
        inside = points[((points > low) & (points < high)).all(axis=-1)]
        if len(inside) > 0:
            deepest = max(deepest, float(-(inside @ normals.T - offsets).max(axis=-1).min()))
    return deepest
