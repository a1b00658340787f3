"""Closed solids made by code. Each is a trimesh.Trimesh, wound outwards, watertight."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import trimesh


def rounded_box(
    size: Sequence[float], radius: float, at: Sequence[float] = (0.0, 0.0, 0.0), steps: int = 3
) -> trimesh.Trimesh:
    """A box of side lengths [3] about `at`, its edges rounded by a radius (less than half the shortest side)."""
    half = 0.5 * np.asarray(size, dtype=np.float64)
    inner = half - radius
    # Tangents of equal angles: where two faces meet at 45 degrees, their points are the same.
    rim = radius * np.tan(np.linspace(0.0, 0.25 * math.pi, steps + 1))
    lines = [np.concatenate([-(inner[k] + rim)[::-1], inner[k] + rim]) for k in range(3)]

    vertices, faces, first = [], [], 0
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            grid_u, grid_v = np.meshgrid(lines[u], lines[v], indexing="ij")
            points = np.empty((*grid_u.shape, 3))
            points[..., axis], points[..., u], points[..., v] = sign * half[axis], grid_u, grid_v
            core = np.clip(points, -inner, inner)
            out = points - core
            points = core + radius * out / np.linalg.norm(out, axis=-1, keepdims=True)
            quads = _grid_quads(*grid_u.shape) + first
            vertices.append(points.reshape(-1, 3))
            faces.append(quads if sign > 0 else quads[:, ::-1])
            first += grid_u.size
    return _solid(np.concatenate(vertices) + at, np.concatenate(faces))


def blocks(lines: Sequence[Sequence[float]], solid: Callable[[int, int, int], bool]) -> trimesh.Trimesh:
    """The solid made of cells of a rectangular grid.

    Args:
        lines: where the grid's planes stand along x, y and z.
        solid: says of a cell (i, j, k) whether it is filled.
    """
    shape = tuple(len(line) - 1 for line in lines)
    filled = np.zeros(tuple(n + 2 for n in shape), dtype=bool)
    for cell in np.ndindex(shape):
        filled[tuple(np.add(cell, 1))] = solid(*cell)
    vertices, faces = [], []
    for cell in np.ndindex(shape):
        here = np.add(cell, 1)
        if not filled[tuple(here)]:
            continue
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            for side in (0, 1):
                beside = here.copy()
                beside[axis] += 2 * side - 1
                if filled[tuple(beside)]:
                    continue
                quad = np.empty((4, 3))
                quad[:, axis] = lines[axis][cell[axis] + side]
                quad[:, u] = [lines[u][cell[u] + d] for d in (0, 1, 1, 0)]
                quad[:, v] = [lines[v][cell[v] + d] for d in (0, 0, 1, 1)]
                faces.append(len(vertices) * 4 + np.array([0, 1, 2, 3] if side else [3, 2, 1, 0]))
                vertices.append(quad)
    return _solid(np.concatenate(vertices), np.array(faces))


def drum(
    radius: float, low: float, high: float, axis: str = "z", at: Sequence[float] = (0.0, 0.0, 0.0), chamfer: float = 0.0
) -> trimesh.Trimesh:
    """A cylinder from `low` to `high` along an axis through `at`, with chamfered rims."""
    profile = [(0.0, low), (radius - chamfer, low), (radius, low + chamfer)]
    profile += [(radius, high - chamfer), (radius - chamfer, high), (0.0, high)]
    mesh = trimesh.creation.revolve(np.array(profile), sections=40)
    # A cyclic exchange of the axes is a rotation: it keeps the winding.
    vertices = np.roll(np.asarray(mesh.vertices), "xyz".index(axis) + 1, axis=1)
    return trimesh.Trimesh(vertices + at, mesh.faces)


def _grid_quads(n: int, m: int) -> np.ndarray:
    index = np.arange(n * m).reshape(n, m)
    return np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1).reshape(-1, 4)


def _solid(vertices: np.ndarray, quads: np.ndarray) -> trimesh.Trimesh:
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(digits_vertex=9)
    return mesh
