"""All joints of a tree at once, by what the images say of every part.

Joints that are fitted pair by pair put down the error of a part twice, to the joint above it and to the one below. The
turn of a round link, say, is hardly seen; but the states share the axis of the next joint, which turns with the link
and tells it. Here the parts move by forward kinematics alone, and Levenberg-Marquardt brings them as near to their
observed motions as these are certain.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import adjoint, inverse, se3_log, translation
from splatart_ns.stages.articulate import Joint, KinematicTree
from splatart_ns.stages.joint_fit import free_joint, mean_distance
from splatart_ns.stages.joint_parameters import (
    Joints,
    body_twists,
    covariance_blocks,
    inverse_left_jacobian,
    model_motions,
    moved,
    values_of,
)
from splatart_ns.stages.joint_solver import normal_equations, spread_of_solution

_MAX_ITERATIONS = 50


def refine_tree(
    tree: KinematicTree,
    points: Mapping[int, Tensor],
    motions: Mapping[int, Tensor],
    errors: Mapping[int, Tensor],
    weighed_by: Mapping[int, Tensor] | None = None,
) -> KinematicTree:
    """The tree with the parameters, values, residuals and covariances of its joints refined together.

    Args:
        tree: Joints near the optimum.
        points: Of each part [N, 3], at state 0.
        motions: Observed motions [S, 4, 4] by part, canonical frame.
        errors: Their covariances [S, 6, 6], T_true = exp(d) T, d = (translation, rotation) about the world's origin.
            Those of a root that did not stand still count for every part.
        weighed_by: The covariances by which the motions are weighed against each other, where not by `errors`.
    """
    motions = {p: T.double() for p, T in motions.items()}
    chains = _Chains.of(tree, points, motions, errors, weighed_by or errors)
    joints = chains.start
    if not joints:
        return tree
    r, J = chains.linearised(joints)
    cost, damping = float(r @ r), 1e-6
    for _ in range(_MAX_ITERATIONS):
        H, g, scale = normal_equations(J, r)
        step = torch.linalg.solve(H + damping * torch.eye(len(H)).to(H), -g) / scale
        trial = chains.moved(joints, step)
        r_trial = chains.residuals(trial)
        gain = cost - float(r_trial @ r_trial)
        if gain >= 0:
            joints, damping = trial, max(damping / 10, 1e-12)
            r, J = chains.linearised(joints)
            cost = float(r @ r)
            if gain <= 1e-8 * cost + 1e-16:
                break
        else:
            damping *= 10
            if damping > 1e6:  # only rounding is left
                break
    # What the residuals cost, and how the solution spreads, by the errors that the motions have.
    spread, due = torch.zeros_like(J.T @ J), 0.0
    sizes = [len(C) for C in chains.spread.values()]
    for C, r_part, J_part in zip(chains.spread.values(), r.split(sizes), J.split(sizes), strict=True):
        spread += J_part.T @ C @ J_part
        due += float(r_part @ torch.linalg.solve(C, r_part))
    freedom = J.shape[0] - J.shape[1]
    inflation = max(1.0, due / freedom) if freedom > 0 else 1.0
    covariance = inflation * spread_of_solution(J, spread)
    return replace(tree, joints=chains.finished(joints, points, motions, covariance))


@dataclass(frozen=True)
class _Chains:
    """A tree under refinement. Its joints are given about their children's centroids, by child."""

    tree: KinematicTree
    start: dict[int, Joints]
    centroid: dict[int, Tensor]
    """Frames [4, 4] about the children's centroids."""
    bases: dict[int, Tensor]
    """Motions [n, 4, 4] at the states 1 and up of what no joint moves: the root, and what hangs on free joints."""
    observed: dict[int, Tensor]
    """Motions [n, 4, 4] of the parts that joints move."""
    whiten: dict[int, Tensor]
    """What would make their errors standard normal [6 n, 6 n], were they as they are weighed,"""
    spread: dict[int, Tensor]
    """and their covariances once it did."""

    @staticmethod
    def of(
        tree: KinematicTree,
        points: Mapping[int, Tensor],
        motions: Mapping[int, Tensor],
        errors: Mapping[int, Tensor],
        weighed_by: Mapping[int, Tensor],
    ) -> _Chains:
        free = [j.child for j in tree.joints if j.fit.type == "free"]
        jointed = [j for j in tree.joints if j.child not in free]
        start, centroid = {}, {}
        for j in jointed:
            if j.fit.dofs > 0:
                c = points[j.child].to(j.fit.axis).mean(0)
                values = j.fit.values[1:].reshape(1, len(j.fit.values) - 1, j.fit.dofs)
                start[j.child] = j.fit.axis[None], (j.fit.origin - c)[None], c.new_tensor([j.fit.pitch]), values
                centroid[j.child] = translation(c)
        root_moved = bool((motions[tree.root] != torch.eye(4).to(motions[tree.root])).any())
        whiten, spread = {}, {}
        for j in jointed:
            weights, together = (
                _with_common_share(
                    (C[j.child] + C[tree.root] if root_moved else C[j.child])[1:].double(), motions[j.child][1:]
                )
                for C in (weighed_by, errors)
            )
            W = whiten[j.child] = torch.linalg.inv(torch.linalg.cholesky(weights))
            spread[j.child] = W @ together @ W.T
        return _Chains(
            tree=tree,
            start=start,
            centroid=centroid,
            bases={p: motions[p][1:] for p in (tree.root, *free)},
            observed={j.child: motions[j.child][1:] for j in jointed},
            whiten=whiten,
            spread=spread,
        )

    def motions(self, joints: Mapping[int, Joints]) -> dict[int, Tensor]:
        """Of all parts of the tree [n, 4, 4] at the states 1 and up."""
        T = dict(self.bases)
        for j in self.tree.joints:
            if j.child in joints:
                about = self.centroid[j.child]
                T[j.child] = T[j.parent] @ about @ model_motions(j.fit.type, joints[j.child])[0] @ inverse(about)
            elif j.child not in T:
                T[j.child] = T[j.parent]
        return T

    def residuals(self, joints: Mapping[int, Joints]) -> Tensor:
        """Errors of the parts' motions in standard deviations [R]."""
        T = self.motions(joints)
        return torch.cat([self.whiten[p] @ _error(T[p], seen).flatten() for p, seen in self.observed.items()])

    def linearised(self, joints: Mapping[int, Joints]) -> tuple[Tensor, Tensor]:
        """The residuals [R] and their derivatives by the parameters, joint after joint [R, K]."""
        T = self.motions(joints)
        path, columns = {}, {}
        for j in self.tree.joints:
            path[j.child] = {j.child} if j.child in self.bases else path.get(j.parent, set()) | {j.child}
            if j.child in joints:
                twists = body_twists(j.fit.type, joints[j.child])[0]
                columns[j.child] = adjoint(T[j.child] @ self.centroid[j.child]) @ twists
        rows = []
        for p, seen in self.observed.items():
            moves = [C if child in path[p] else torch.zeros_like(C) for child, C in columns.items()]
            carried = inverse_left_jacobian(_error(T[p], seen)) @ torch.cat(moves, -1)
            rows.append(self.whiten[p] @ carried.flatten(0, 1))
        return self.residuals(joints), torch.cat(rows)

    def moved(self, joints: Mapping[int, Joints], step: Tensor) -> dict[int, Joints]:
        """The joints after a step [K] of their parameters."""
        kinds = {j.child: j.fit.type for j in self.tree.joints}
        steps = step.split([body_twists(kinds[c], shape).shape[-1] for c, shape in joints.items()])
        return {c: moved(kinds[c], shape, d[None]) for (c, shape), d in zip(joints.items(), steps, strict=True)}

    def finished(
        self, joints: Mapping[int, Joints], points: Mapping[int, Tensor], motions: Mapping[int, Tensor], C: Tensor
    ) -> list[Joint]:
        """The tree's joints with these parameters, of covariance C [K, K]."""
        finished, first = [], 0
        for j in self.tree.joints:
            T_rel = inverse(motions[j.parent]) @ motions[j.child]
            if j.child in joints:
                axis, point, pitch, values = joints[j.child]
                last = first + body_twists(j.fit.type, joints[j.child]).shape[-1]
                blocks = covariance_blocks(j.fit.type, axis, values, C[None, first:last, first:last])
                first = last
                zero = torch.zeros_like(values[:, :1])
                fit = replace(
                    j.fit,
                    axis=axis[0],
                    origin=point[0] + self.centroid[j.child][:3, 3],
                    pitch=float(pitch),
                    values=values_of(j.fit.type, torch.cat([zero, values], 1))[0],
                    covariance={name: block[0].tolist() for name, block in blocks.items()},
                )
                x = points[j.child].to(T_rel)
                j = replace(j, fit=replace(fit, residual=mean_distance(x, T_rel[1:], fit.motion(fit.values[1:]))))
            elif j.child in self.bases:
                j = replace(j, fit=free_joint(T_rel, points[j.child]))
            finished.append(j)
        return finished


def _with_common_share(C: Tensor, T: Tensor) -> Tensor:
    """The covariance [6 n, 6 n] of the errors of a part's motions T [n, 4, 4] together, from their own C [n, 6, 6].

    Each motion compares another state with state 0, and errs as much by how this one shows the part: half of what is
    uncertain is the same in all of them, seen from the part. With two states nothing is added.
    """
    Ad = adjoint(T)
    precision = Ad.mT @ torch.linalg.inv(C) @ Ad  # in the part's frame at state 0
    common = torch.linalg.inv(precision.mean(0)) / 2
    Ad = Ad.flatten(0, 1)
    return torch.block_diag(*(C / 2)) + Ad @ common @ Ad.mT


def _error(T: Tensor, observed: Tensor) -> Tensor:
    """Left increments [n, 6] from the observed motions to T [n, 4, 4]."""
    return se3_log(T @ inverse(observed))
