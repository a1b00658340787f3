"""Whether the surfaces of a robot's parts reach through each other."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import combinations, product

import numpy as np

from splatart_ns.capture.ray_caster import embree_scene
from splatart_ns.capture.robot import Robot
from splatart_ns.capture.surface import Surface


class Crossings:
    """Of the pairs of parts that should be apart: not those that a joint joins, and not those that cross at rest.

    Links overlap about their joints, and much that touches in a drawing crosses by rounding, so that neither tells that
    a configuration cannot be. Surfaces cross where an edge of the one goes through a triangle of the other; meshes need
    not be closed. (The depth of `interpenetration` takes solids that are convex and made to clear each other at their
    joints, as objects made by code are.)

    Args:
        frozen: values of joints that are held.
        surfaces: part name to its surface in its own frame, of the parts that have a shape.
    """

    def __init__(self, robot: Robot, frozen: Mapping[str, float], surfaces: Mapping[str, Surface]) -> None:
        self._robot = robot
        parents = {name: parent for name, (parent, _) in robot.hinges(frozen).items()}
        self._parts = {p.name: p for p in robot.parts(frozen) if p.name in surfaces}
        self._triangles = {name: surface.triangles for name, surface in surfaces.items()}
        self._bounds = {name: (t.min(axis=(0, 1)), t.max(axis=(0, 1))) for name, t in self._triangles.items()}
        self._scenes = {name: embree_scene(t - self._middle(name)) for name, t in self._triangles.items()}
        self._known: dict[tuple[str, str, bytes], bool] = {}
        self._expected = {(a, b) for a, b in combinations(self._parts, 2) if a == parents[b] or b == parents[a]}
        self._expected |= self.pairs(robot.complete(frozen), self._parts)

    def pairs(self, values: Mapping[str, float], parts: Collection[str]) -> set[tuple[str, str]]:
        """Those of `parts` that cross at these joint values."""
        poses = self._robot.link_poses(values)
        T_world = {name: poses[part.frame_link] for name, part in self._parts.items() if name in parts}
        pairs = (pair for pair in combinations(T_world, 2) if pair not in self._expected)
        return {(a, b) for a, b in pairs if self._cross(a, b, np.linalg.inv(T_world[b]) @ T_world[a])}

    def _cross(self, a: str, b: str, T_ba: np.ndarray) -> bool:
        key = a, b, np.round(T_ba, 9).tobytes()
        if key not in self._known:
            T_ab = np.linalg.inv(T_ba)
            apart = self._boxes_apart(a, b, T_ba) or self._boxes_apart(b, a, T_ab)
            self._known[key] = not apart and (self._goes_through(a, b, T_ba) or self._goes_through(b, a, T_ab))
        return self._known[key]

    def _boxes_apart(self, a: str, b: str, T_ba: np.ndarray) -> bool:
        """Whether the box about part b, along its axes, has nothing of that about part a."""
        corners = np.array(list(product(*zip(*self._bounds[a], strict=True)))) @ T_ba[:3, :3].T + T_ba[:3, 3]
        low, high = self._bounds[b]
        return bool((corners.min(axis=0) > high).any() or (corners.max(axis=0) < low).any())

    def _goes_through(self, a: str, b: str, T_ba: np.ndarray) -> bool:
        """Whether an edge of part a goes through part b."""
        low, high = self._bounds[b]
        corners = self._triangles[a] @ T_ba[:3, :3].T + T_ba[:3, 3]
        near = ((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=-1)
        start = corners[near].reshape(-1, 3)
        edge = np.roll(corners[near], -1, axis=1).reshape(-1, 3) - start
        length = np.linalg.norm(edge, axis=-1)
        kept = length > 0.0
        if not kept.any():
            return False
        rays = start[kept] - self._middle(b), edge[kept] / length[kept, None], length[kept]
        return bool((self._scenes[b].run(*(r.astype(np.float32) for r in rays)) >= 0).any())

    def _middle(self, part: str) -> np.ndarray:
        """Rays are float32: about a part's middle they lose least."""
        low, high = self._bounds[part]
        return 0.5 * (low + high)
