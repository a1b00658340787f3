"""Which bodies overlap, from their convex pieces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import trimesh
from scipy.optimize import linprog


def overlaps(
    bodies: Mapping[str, Sequence[trimesh.Trimesh]], skip: set[frozenset[str]] = frozenset()
) -> dict[tuple[str, str], float]:
    """Pairs of bodies whose convex pieces overlap, and how deep: the radius of the largest ball inside both.

    Pieces are in one frame. Pairs in `skip` are left out, and so are those that only touch.
    """
    found = {}
    for a, b in combinations(bodies, 2):
        if frozenset((a, b)) in skip:
            continue
        depth = max((common_ball(p, q) for p in bodies[a] for q in bodies[b]), default=0.0)
        if depth > 0:
            found[a, b] = depth
    return found


def common_ball(a: trimesh.Trimesh, b: trimesh.Trimesh) -> float:
    """Radius of the largest ball inside two convex meshes, 0 where they have no common inside.

    A linear program (Boyd and Vandenberghe, Convex Optimization, 2004, section 8.5.1, the Chebyshev centre).
    """
    low, high = np.maximum(a.bounds[0], b.bounds[0]), np.minimum(a.bounds[1], b.bounds[1])
    if (low >= high).any():
        return 0.0
    centre = (low + high) / 2
    size = float((high - low).max())
    normals = np.concatenate([a.face_normals, b.face_normals])
    points = np.concatenate([a.triangles[:, 0], b.triangles[:, 0]]) - centre
    heights = np.einsum("ij,ij->i", normals, points) / size
    program = linprog(
        [0.0, 0.0, 0.0, -1.0],
        A_ub=np.column_stack([normals, np.ones(len(normals))]),
        b_ub=heights,
        bounds=[(None, None)] * 3 + [(None, 1.0)],
        method="highs",
    )
    radius = program.x[3] * size if program.success else 0.0
    return radius if radius > 1e-6 * size else 0.0
