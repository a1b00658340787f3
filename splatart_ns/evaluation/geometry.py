"""How far the reconstructed shapes are from the true ones (docs/metrics.md, geometry)."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.occlusion import surroundings
from splatart_ns.bundle.surface import part_surface
from splatart_ns.bundle.vantage import cameras_around
from splatart_ns.errors import InputError
from splatart_ns.evaluation.ground_truth import GroundTruth
from splatart_ns.geometry.se3 import transform_points

SAMPLES = 10_000


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """Mean squared distance to the nearest point, both directions summed, x 1000; points [N, 3] and [M, 3]."""
    forth, _ = cKDTree(b).query(a)
    back, _ = cKDTree(a).query(b)
    return 1000 * float(np.mean(forth**2) + np.mean(back**2))


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of `count` points [N, 3], each the farthest from all before it, beginning nearest the centroid.

    All indices where there are no more than `count` points. Deterministic.
    """
    if len(points) <= count:
        return np.arange(len(points))
    x, y, z = np.ascontiguousarray(points.T, np.float32)
    chosen = np.empty(count, np.int64)
    nearest = np.full(len(points), np.inf, np.float32)
    index = int(((points - points.mean(0)) ** 2).sum(1).argmin())
    for k in range(count):
        chosen[k] = index
        distance = np.square(x - x[index])
        distance += np.square(y - y[index])
        distance += np.square(z - z[index])
        np.minimum(nearest, distance, out=nearest)
        index = int(nearest.argmax())
    return chosen


def chamfer_centres(ground_truth: GroundTruth, bundle: Bundle) -> dict[str, Any]:
    """The figures of `_chamfers` for the Gaussians' centres, of which farthest-point samples are taken."""
    centres = {part.id: part.splat.means.double().numpy() for part in bundle.parts if len(part.splat)}
    sampled = {part: x[farthest_points(x, SAMPLES)] for part, x in centres.items()}
    return _chamfers(ground_truth, bundle, sampled, *_sampled_whole(centres))


def chamfer_mesh(ground_truth: GroundTruth, bundle: Bundle) -> dict[str, Any]:
    """The figures of `_chamfers` for the parts' surfaces, sampled by area; a part without one counts as missing."""
    meshes = {}
    for part in bundle.parts:
        # A part without visible Gaussians has no surface.
        with contextlib.suppress(InputError):
            meshes[part.id] = part_surface(part.splat, cameras_around(bundle, part), surroundings(bundle, part))
    sampled = {part: trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[0] for part, mesh in meshes.items()}
    if not meshes:
        return _chamfers(ground_truth, bundle, {}, *_sampled_whole({}))
    whole = trimesh.util.concatenate(list(meshes.values()))
    points, face = trimesh.sample.sample_surface(whole, SAMPLES, seed=0)
    part_of_face = np.repeat(list(meshes), [len(mesh.faces) for mesh in meshes.values()])
    return _chamfers(ground_truth, bundle, sampled, points, part_of_face[face])


def _chamfers(
    ground_truth: GroundTruth,
    bundle: Bundle,
    sampled: dict[int, np.ndarray],
    whole: np.ndarray,
    whole_part: np.ndarray,
) -> dict[str, Any]:
    """CD-s (root part), CD-m (mean over the moving parts) and CD-w (all) between true and estimated points.

    Args:
        sampled: The estimate's points of each part that has any [N, 3].
        whole, whole_part: Points of all parts together [M, 3], and the part of each [M]. For the true points, farthest-
            point samples of all parts' together.

    Returns:
        The figures at state 0, "parts" with each part's value, and "last" with the same at the last state, both sides
        moved by their own motions relative to the true root (the estimate's own root where it lacks that part).
    """
    true_points = {part: ground_truth.points[part].numpy() for part in ground_truth.parts}
    true_motions = {part: T[-1] for part, T in _relative(ground_truth.motions, ground_truth.root).items()}
    estimated = {part.id: part.motion for part in bundle.parts}
    root = ground_truth.root if ground_truth.root in estimated else bundle.part(bundle.root).id
    motions = {part: T[-1] for part, T in _relative(estimated, root).items()}
    true_whole, true_whole_part = _sampled_whole(true_points)

    def values(last: bool) -> dict[str, Any]:
        def at(x: np.ndarray, T: torch.Tensor) -> np.ndarray:
            return transform_points(T, torch.from_numpy(x)).numpy() if last else x

        parts = {
            name: chamfer(at(sampled[part], motions[part]), at(true_points[part], true_motions[part]))
            if part in sampled
            else None
            for part, name in ground_truth.parts.items()
        }
        moving = [parts[name] for part, name in ground_truth.parts.items() if part != ground_truth.root]
        return {
            "CD-s": parts[ground_truth.parts[ground_truth.root]],
            # Without a part that it lost an estimate would seem the better.
            "CD-m": sum(moving) / len(moving) if moving and None not in moving else None,
            "CD-w": chamfer(
                np.concatenate([at(whole[whole_part == part], motions[part]) for part in sampled]),
                np.concatenate([at(true_whole[true_whole_part == part], true_motions[part]) for part in true_points]),
            )
            if sampled
            else None,
            "parts": parts,
        }

    return {**values(last=False), "last": values(last=True)}


def _relative(motions: dict[int, torch.Tensor], root: int) -> dict[int, torch.Tensor]:
    return {part: torch.linalg.solve(motions[root], T) for part, T in motions.items()}


def _sampled_whole(points: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Farthest-point samples of all parts together, and the part of each."""
    if not points:
        return np.empty((0, 3)), np.empty(0, np.int64)
    everything = np.concatenate(list(points.values()))
    parts = np.repeat(list(points), [len(x) for x in points.values()])
    chosen = farthest_points(everything, SAMPLES)
    return everything[chosen], parts[chosen]
