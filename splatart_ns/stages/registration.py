"""Where a part of one state may lie in another state: trimmed ICP on points and colours, from many starts."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from splatart_ns.geometry.spherical_harmonics import SH_C0
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.visibility import shown
from splatart_ns.threads import num_threads

MIN_POINTS = 8
"""A part with fewer Gaussians than this in a state cannot be registered."""
SAMPLES = 500
"""Source points that follow each start."""
RANDOM_STARTS = 40
ITERATIONS = 25
FOLLOWED = 16
"""Starts that are followed to the end, the best distinct ones after a third of the iterations."""
KEPT = 10
"""Candidates of one of `TRIMS`, at most."""
TRIMS = (0.15, 0.5)
"""Shares of the worst correspondences that the steps leave out, for what only one of the states shows: a little, or,
of a drawer that was shut, a lot."""
SLIDES = 6
"""Slides of a grid that are followed."""
SLIDE_STEP, SLIDE_STEPS = 0.3, 5
"""The grid's step in part radii, and how many of them it reaches to each side."""
NEARLY = 0.5
"""A step may take a point that is half as far again as the nearest: a third less time, and the same candidates."""
COLOUR = 0.3
"""Colour difference (0 to 1) of one counts as this many part radii."""


@dataclass(frozen=True)
class PartPoints:
    """One part's Gaussians as ICP sees them."""

    xyz: np.ndarray
    """Centres [N, 3] float64."""
    rgb: np.ndarray
    """Colours of the constant band [N, 3], about 0 to 1."""
    weight: np.ndarray
    """Visibility times the probability of the part [N]: low for hidden and for mixed Gaussians."""

    @property
    def centroid(self) -> np.ndarray:
        return self.weight @ self.xyz / self.weight.sum()

    @property
    def radius(self) -> float:
        """Root mean square distance from the centroid."""
        return float(np.sqrt(self.weight @ ((self.xyz - self.centroid) ** 2).sum(1) / self.weight.sum()))


def part_points(splat: Splat, seen: Tensor, part: int) -> PartPoints:
    """The visible Gaussians whose most likely part is `part`; `seen` [N] is the splat's `visibility`."""
    chosen = splat.part_ids == part
    chosen &= shown(torch.where(chosen, seen, 0.0))
    part_splat = splat.select(chosen).detach().to("cpu")
    rgb = 0.5 + SH_C0 * part_splat.sh[:, 0].double().numpy()
    weight = seen[chosen].cpu() * part_splat.part_probabilities[:, part]
    return PartPoints(part_splat.means.double().numpy(), rgb, weight.double().numpy())


def register(source: PartPoints, target: PartPoints, seed: int = 0) -> np.ndarray:
    """Candidates for the motion of a part [C, 4, 4], which differ by 6 degrees or 6 % of the radius or more.

    Best fit first: the trimmed mean distance, both ways, of points and colours. Flat parts fit alike when turned over,
    so this ranks candidates but must not choose among them (see initial_motion).

    Starts: no motion, centroid on centroid with no turn, with the four proper alignments of the principal axes, and
    with random turns. All starts are followed together, once for each of `TRIMS`, and the `FOLLOWED` best to the end;
    of each, at most `KEPT` are kept. The two starts without a turn, and the best of a grid of slides, are also followed
    by sliding alone: sliding is so common that it is not to be crowded out. Needs `MIN_POINTS` points on both sides.
    """
    rng = np.random.default_rng(seed)
    colour = COLOUR * target.radius
    source_tree = cKDTree(_features(source, colour))
    target_tree = cKDTree(_features(target, colour))
    sample, back_sample = _sample(source, rng), _sample(target, rng)

    starts = _starts(source, target, rng)
    straight = np.concatenate([starts[:2], _slides(sample, back_sample, colour, source_tree, target_tree)])
    motions, fits = [], []
    for trim in TRIMS:
        T, slides = starts, straight
        for iteration in range(ITERATIONS):
            if iteration == ITERATIONS // 3:
                fit = _trimmed_distance(T, sample, colour, target_tree, trim)
                T = T[distinct(T, fit, source.centroid, source.radius)[:FOLLOWED]]
            T = _icp_step(T, sample, colour, target, target_tree, trim)
            slides = _icp_step(slides, sample, colour, target, target_tree, trim, turn=False)
        T = np.concatenate([T, slides])
        forth = _trimmed_distance(T, sample, colour, target_tree, trim)
        back = _trimmed_distance(np.linalg.inv(T), back_sample, colour, source_tree, trim)
        fit = (forth + back) / 2
        chosen = distinct(T, fit, source.centroid, source.radius)[:KEPT]
        chosen += [i for i in range(len(T) - len(slides), len(T)) if i not in chosen]
        motions.append(T[chosen])
        fits.append(fit[chosen])
    T, fit = np.concatenate(motions), np.concatenate(fits)
    return T[distinct(T, fit, source.centroid, source.radius)]


def point_to_plane(source: PartPoints, target: PartPoints, T: np.ndarray) -> np.ndarray:
    """Motions [C, 4, 4] that refine T [C, 4, 4] by OpenCV's point-to-plane ICP on the shapes alone.

    Points may slide along surfaces, so it gets much closer on smooth parts than nearest points do (Chen and Medioni
    1991), but nothing holds it where only the colours do: offer its results beside T, not instead.
    """
    icp = cv2.ppf_match_3d_ICP(ITERATIONS, 0.005, 2.5, 4)
    scene = np.concatenate([target.xyz, _normals(target)], axis=1).astype(np.float32)
    normals = _normals(source)
    refined = []
    for start in T:
        R = start[:3, :3]
        model = np.concatenate([source.xyz @ R.T + start[:3, 3], normals @ R.T], axis=1)
        _, _, pose = icp.registerModelToScene(model.astype(np.float32), scene)
        rigid = np.isfinite(pose).all() and np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-3)
        refined.append(pose @ start if rigid else start)
    return np.stack(refined)


def _normals(points: PartPoints) -> np.ndarray:
    """Unit normals [N, 3] of the planes through each point's neighbours, of either sign."""
    k = min(10, len(points.xyz))
    neighbours = points.xyz[cKDTree(points.xyz).query(points.xyz, k=k)[1]]
    centred = neighbours - neighbours.mean(axis=1, keepdims=True)
    return np.linalg.eigh(centred.swapaxes(1, 2) @ centred)[1][..., 0]


def distinct(T: np.ndarray, cost: np.ndarray, centroid: np.ndarray, radius: float, shift: float = 0.06) -> list[int]:
    """Indices of motions [C, 4, 4] by rising cost, without those nearly equal to a cheaper one.

    Nearly equal: less than 6 degrees apart, and less than `shift` times `radius` at `centroid`.
    """
    chosen: list[int] = []
    for i in np.argsort(cost, kind="stable"):
        D = T[chosen]
        cosine = (np.einsum("kij,ij->k", D[:, :3, :3], T[i, :3, :3]) - 1) / 2
        moved = np.linalg.norm((D[:, :3] - T[i, :3]) @ np.append(centroid, 1.0), axis=-1)
        if not np.any((cosine > np.cos(np.radians(6))) & (moved < shift * radius)):
            chosen.append(int(i))
    return chosen


def _features(points: PartPoints, colour: float) -> np.ndarray:
    return np.concatenate([points.xyz, colour * points.rgb], axis=1)


def _sample(points: PartPoints, rng: np.random.Generator) -> PartPoints:
    if len(points.xyz) <= SAMPLES:
        return points
    chosen = rng.choice(len(points.xyz), SAMPLES, replace=False, p=points.weight / points.weight.sum())
    return PartPoints(points.xyz[chosen], points.rgb[chosen], points.weight[chosen])


def _starts(source: PartPoints, target: PartPoints, rng: np.random.Generator) -> np.ndarray:
    """[K, 4, 4]."""

    def axes(points: PartPoints) -> np.ndarray:
        centred = points.xyz - points.centroid
        V = np.linalg.eigh((points.weight[:, None] * centred).T @ centred)[1]
        return V * np.linalg.det(V)

    signs = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    principal = (axes(target) * signs[:, None]) @ axes(source).T
    R = np.concatenate([np.eye(3)[None], principal, Rotation.random(RANDOM_STARTS, random_state=rng).as_matrix()])
    T = np.tile(np.eye(4), (len(R), 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = target.centroid - R @ source.centroid
    return np.concatenate([np.eye(4)[None], T])


def _slides(
    source: PartPoints, target: PartPoints, colour: float, source_tree: cKDTree, target_tree: cKDTree
) -> np.ndarray:
    """The best distinct ones [K, 4, 4] of a grid of slides about that which brings centroid on centroid.

    What one state hides of a part draws its centroid aside, and nearest points draw a drawer's front to its back. Here
    it suffices that either state's points lie on the other's: a drawer that is shut shows its front alone.
    """
    ticks = SLIDE_STEP * np.arange(-SLIDE_STEPS, SLIDE_STEPS + 1) * target.radius
    offsets = np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3)
    T = np.tile(np.eye(4), (len(offsets), 1, 1))
    T[:, :3, 3] = target.centroid - source.centroid + offsets
    few = [PartPoints(p.xyz[::k], p.rgb[::k], p.weight[::k]) for p in (source, target) for k in [len(p.xyz) // 50 + 1]]
    forth = _trimmed_distance(T, few[0], colour, target_tree, TRIMS[0])
    back = _trimmed_distance(np.linalg.inv(T), few[1], colour, source_tree, TRIMS[0])
    fit = np.minimum(forth, back)
    best = fit.argsort(kind="stable")[:100]
    T, fit = T[best], fit[best]
    return T[distinct(T, fit, source.centroid, source.radius, shift=1.2 * SLIDE_STEP)[:SLIDES]]


def _moved_features(T: np.ndarray, sample: PartPoints, colour: float) -> np.ndarray:
    xyz = sample.xyz @ T[:, :3, :3].swapaxes(1, 2) + T[:, None, :3, 3]
    return np.concatenate([xyz, np.broadcast_to(colour * sample.rgb, xyz.shape)], axis=2)


def _icp_step(
    T: np.ndarray,
    sample: PartPoints,
    colour: float,
    target: PartPoints,
    target_tree: cKDTree,
    trim: float,
    turn: bool = True,
) -> np.ndarray:
    """One step of every motion: nearest points, trimming, the rigid fit (Kabsch 1976); without `turn` its slide."""
    moved = _moved_features(T, sample, colour)
    distance, nearest = target_tree.query(moved, eps=NEARLY, workers=num_threads())
    inlier = distance <= np.quantile(distance, 1 - trim, axis=1, keepdims=True)
    w = inlier / inlier.sum(axis=1, keepdims=True)
    goal = target.xyz[nearest]
    source_mean, goal_mean = w @ sample.xyz, (w[..., None] * goal).sum(axis=1)
    R = T[:, :3, :3]
    if turn:
        H = (w[..., None] * (sample.xyz - source_mean[:, None])).swapaxes(1, 2) @ (goal - goal_mean[:, None])
        U, _, Vh = np.linalg.svd(H)
        flip = np.ones(U.shape[:2])
        flip[:, 2] = np.linalg.det(U @ Vh)
        R = (Vh.swapaxes(1, 2) * flip[:, None]) @ U.swapaxes(1, 2)
    out = np.tile(np.eye(4), (len(T), 1, 1))
    out[:, :3, :3] = R
    out[:, :3, 3] = goal_mean - (R @ source_mean[..., None])[..., 0]
    return out


def _trimmed_distance(T: np.ndarray, sample: PartPoints, colour: float, tree: cKDTree, trim: float) -> np.ndarray:
    distance = tree.query(_moved_features(T, sample, colour), workers=num_threads())[0]
    distance = np.sort(distance, axis=1)
    return distance[:, : max(1, round((1 - trim) * distance.shape[1]))].mean(axis=1)
