"""Convex pieces that stand for a mesh where bodies collide."""

from __future__ import annotations

import logging

import manifold3d
import numpy as np
import trimesh

_log = logging.getLogger(__name__)

_TRIANGLES = 1500
"""Of the mesh that is taken apart: the time grows fast with their number."""
_LOST_VOLUME = 0.1
"""Share of the volume that this may change."""
_CONCAVITY = 0.08
"""Tolerated difference between a piece and its hull, in CoACD's measure, of the mesh scaled to sides of 2."""
_PIECES = 12
"""At most."""
_VERTICES = 32
"""Of a piece, at most."""
_FLAT = 1e-9
"""A hull of no more volume than this share of the cube of its longest side lies in a plane but for rounding."""


def convex_pieces(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Watertight convex meshes that together are close to the watertight `mesh`, in its frame.

    Its one convex hull without `coacd`.

    By collision-aware concavity and tree search (Wei et al. 2022, "Approximate Convex Decomposition for 3D Meshes with
    Collision-Aware Concavity and Tree Search"). Deterministic.
    """
    hull = mesh.convex_hull
    if hull.volume < 1.05 * mesh.volume:
        return [_with_few_vertices(hull)]
    try:
        import coacd
    except ImportError:
        _log.warning(
            "collision shapes are whole convex hulls; `pip install 'splatart-ns[sim]'` brings coacd to take them apart"
        )
        return [_with_few_vertices(hull)]
    coacd.set_log_level("error")
    simple = _with_few_triangles(mesh)
    found = coacd.run_coacd(
        coacd.Mesh(simple.vertices, simple.faces),
        threshold=_CONCAVITY,
        max_convex_hull=_PIECES,
        # Solid and without holes already, the mesh needs none of the voxels that it would be rebuilt from.
        preprocess_mode="off" if simple.is_volume else "on",
        # A shallow search takes a small part of the default's time and finds pieces nearly as tight.
        resolution=200,
        mcts_iterations=10,
        mcts_nodes=6,
        mcts_max_depth=1,
        decimate=True,
        max_ch_vertex=_VERTICES,
        seed=0,
    )
    hulls = [_hull_of(points) for points, _ in found]
    return [piece for piece in hulls if piece is not None] or [_with_few_vertices(hull)]


def _hull_of(points: np.ndarray) -> trimesh.Trimesh | None:
    """The convex hull of points [N, 3]; None where they lie in a plane."""
    try:
        hull = trimesh.convex.convex_hull(points)
    except Exception:  # Qhull's error has no public type of its own in scipy's older versions.
        return None
    with np.errstate(divide="ignore", invalid="ignore"):  # trimesh divides by volumes of 0
        return hull if hull.is_volume and hull.volume > _FLAT * hull.extents.max() ** 3 else None


def _with_few_triangles(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A coarser mesh of the same solid, of _TRIANGLES or as few as keep its volume: thin sheets lose pieces first."""
    solid = manifold3d.Manifold(manifold3d.Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)))
    if solid.is_empty():  # Not a manifold: CoACD mends it.
        return mesh
    tolerance, simple = 5e-4 * float(mesh.extents.max()), solid
    while simple.num_tri() > _TRIANGLES:
        coarser = solid.simplify(tolerance)
        if abs(coarser.volume() / solid.volume() - 1) > _LOST_VOLUME:
            break
        tolerance, simple = 1.4 * tolerance, coarser
    data = simple.to_mesh()
    return trimesh.Trimesh(data.vert_properties[:, :3].astype(np.float64), data.tri_verts, process=False)


def _with_few_vertices(hull: trimesh.Trimesh) -> trimesh.Trimesh:
    """The hull of vertices of a convex mesh far apart from each other, `_VERTICES` at most."""
    points = np.asarray(hull.vertices)
    if len(points) <= _VERTICES:
        return hull
    # Farthest point sampling, from the outermost vertex.
    distance = np.linalg.norm(points - points.mean(0), axis=1)
    chosen = [int(distance.argmax())]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < _VERTICES:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return trimesh.convex.convex_hull(points[chosen])
