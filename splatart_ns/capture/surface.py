"""A textured triangle surface: what a link looks like, ready to be ray cast or sampled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

WHITE = np.full((1, 1, 3), 255, dtype=np.uint8)
"""The texture of a face that has none."""
CREASE = 35.0
"""Degrees between faces from which on they meet in an edge instead of being one smooth surface."""


@dataclass(frozen=True)
class Surface:
    """F triangles with texture, colour and normal at each corner.

    A triangle that lies on another one with the opposite winding is that one's back: modelling tools write such
    pairs with a material of their own on either side. They are one triangle here, of the G that rays can hit.
    """

    corners: np.ndarray
    """[F, 3, 3] float64."""
    normals: np.ndarray
    """[F, 3, 3] float64, unit length."""
    uv: np.ndarray
    """[F, 3, 2] float64; v points up, as in OBJ."""
    colours: np.ndarray
    """[F, 3, 3] float64 in 0..1, multiplied with the texture."""
    texture: np.ndarray
    """[F] int, an index into `textures`."""
    textures: tuple[np.ndarray, ...]
    """Each [H, W, 3] uint8."""
    sides: np.ndarray
    """[G, 2] int: the face that shows where triangle G is seen from its front and from its back."""

    @staticmethod
    def of(
        corners: np.ndarray,
        uv: np.ndarray | None = None,
        colours: np.ndarray | None = None,
        texture: np.ndarray = WHITE,
    ) -> Surface:
        """A surface of triangles [F, 3, 3] with one texture; faces without area are left out."""
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
        kept = np.flatnonzero(areas > 0.0)
        corners = corners[kept].astype(np.float64)
        n = len(corners)
        return Surface(
            corners=corners,
            normals=smooth_normals(corners),
            uv=np.zeros((n, 3, 2)) if uv is None else uv[kept].astype(np.float64),
            colours=np.ones((n, 3, 3)) if colours is None else colours[kept].astype(np.float64),
            texture=np.zeros(n, dtype=np.int64),
            textures=(texture,),
            sides=np.stack([np.arange(n)] * 2, axis=1),
        )

    @property
    def triangles(self) -> np.ndarray:
        """Corners [G, 3, 3] of the triangles that rays can hit."""
        return self.corners[self.sides[:, 0]]

    def moved(self, T: np.ndarray) -> Surface:
        """The surface under a rigid motion or an affine map [4, 4]."""
        A, t = T[:3, :3], T[:3, 3]
        normals = self.normals @ np.linalg.inv(A)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-300)
        corners = self.corners @ A.T + t
        if np.linalg.det(A) >= 0.0:
            return replace(self, corners=corners, normals=normals)
        # A mirror turns the winding over; exchanging two corners turns it back.
        order = [0, 2, 1]
        return replace(
            self,
            corners=corners[:, order],
            normals=normals[:, order],
            uv=self.uv[:, order],
            colours=self.colours[:, order],
        )

    def sample(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Points [count, 3] spread evenly over the area."""
        triangles = self.triangles
        a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        areas = np.linalg.norm(np.cross(a, b), axis=-1)
        face = rng.choice(len(triangles), size=count, p=areas / areas.sum())
        s, t = rng.random((2, count, 1))
        fold = s + t > 1.0
        s, t = np.where(fold, 1.0 - s, s), np.where(fold, 1.0 - t, t)
        return triangles[face, 0] + s * a[face] + t * b[face]


def join(surfaces: Sequence[Surface]) -> Surface:
    """One surface of several. A texture that several of them hold is kept once."""
    textures: list[np.ndarray] = []
    places: dict[tuple, int] = {}
    texture, sides, first = [], [], 0
    for surface in surfaces:
        index = []
        for image in surface.textures:
            key = (image.shape, image.tobytes())
            if key not in places:
                places[key] = len(textures)
                textures.append(image)
            index.append(places[key])
        texture.append(np.asarray(index, dtype=np.int64)[surface.texture])
        sides.append(surface.sides + first)
        first += len(surface.corners)
    return Surface(
        corners=np.concatenate([s.corners for s in surfaces]),
        normals=np.concatenate([s.normals for s in surfaces]),
        uv=np.concatenate([s.uv for s in surfaces]),
        colours=np.concatenate([s.colours for s in surfaces]),
        texture=np.concatenate(texture),
        textures=tuple(textures),
        sides=np.concatenate(sides),
    )


def merge_coincident(surface: Surface) -> Surface:
    """The surface with faces on the same three points made the two sides of one triangle.

    Of several faces with the same winding the textured one shows, then the first.
    """
    ids = _point_ids(surface.corners)
    order = np.argsort(ids, axis=1)
    winding = (order[:, 1] - order[:, 0]) % 3 == 2
    _, group = np.unique(np.take_along_axis(ids, order, axis=1), axis=0, return_inverse=True)
    group = group.reshape(-1)
    plain = np.array([t.shape[:2] == (1, 1) for t in surface.textures])[surface.texture]

    shown = np.full((group.max() + 1, 2), -1)
    # Later writes win, so the best face of each group and winding is written last.
    worst_first = np.lexsort((-np.arange(len(group)), ~plain))
    shown[group[worst_first], winding[worst_first].astype(int)] = worst_first
    shown = np.where(shown < 0, shown[:, ::-1], shown)
    return replace(surface, sides=shown)


def smooth_normals(corners: np.ndarray) -> np.ndarray:
    """Corner normals [F, 3, 3]: the mean, by area, over the faces at that point that bend less than `CREASE`."""
    if len(corners) == 0:
        return corners
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face = np.repeat(np.arange(len(corners)), 3)
    unit = doubled / np.linalg.norm(doubled, axis=-1, keepdims=True)

    # All pairs (a, b) of corners at one point: corners sorted by point, each paired with all of its run.
    point = _point_ids(corners).reshape(-1)
    by_point = np.argsort(point, kind="stable")
    _, start, count = np.unique(point[by_point], return_index=True, return_counts=True)
    start, count = np.repeat(start, count), np.repeat(count, count)
    a = np.repeat(by_point, count)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    b = by_point[np.repeat(start, count) + within]

    near = np.einsum("pk,pk->p", unit[face[a]], unit[face[b]]) > np.cos(np.radians(CREASE))
    a, b = a[near], b[near]
    total = np.stack([np.bincount(a, doubled[face[b], k], minlength=len(point)) for k in range(3)], axis=-1)
    total /= np.linalg.norm(total, axis=-1, keepdims=True)
    return total.reshape(-1, 3, 3)


def _point_ids(corners: np.ndarray) -> np.ndarray:
    """The same number [F, 3] for corners that lie within a millionth of the surface's size."""
    points = corners.reshape(-1, 3)
    low = points.min(axis=0)
    step = max(float((points.max(axis=0) - low).max()), 1e-300) * 1e-6
    _, ids = np.unique(np.round((points - low) / step).astype(np.int64), axis=0, return_inverse=True)
    return ids.reshape(-1, 3)
