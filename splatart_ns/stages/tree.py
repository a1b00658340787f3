"""Stage 4: which parts hang on which.

All pairs of parts are fitted; the pairs whose fit is accepted make the graph; the tree is the spanning tree of least
cost. A pair costs what speaks against a joint there, in shares of the object's radius: the residual, the gap between
the two parts (a joint keeps them in touch), and the distance of a turning axis from the place where they touch. With
two states kinematics alone cannot find the tree: about as many false pairs as true ones move like joints, two drawers
for instance. Contact tells them apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import adjoint, inverse, transform_points
from splatart_ns.stages.articulate import Joint, KinematicTree, forward_kinematics
from splatart_ns.stages.contact import Contact, find_contacts
from splatart_ns.stages.joint import EPSILON, NOISE, JointFit, fit_joint, fit_joints, surface_noise
from splatart_ns.stages.joint_descent import descend_joint

JointMethod = Literal["screw", "descent"]


def object_radius(points: dict[int, Tensor]) -> float:
    """Half the diagonal of the box that holds all points but the outermost 0.5 % along each axis."""
    x = torch.cat([p.double() for p in points.values()])
    k = int(0.005 * len(x))
    x = x.sort(dim=0).values
    return float(torch.linalg.vector_norm(x[len(x) - 1 - k] - x[k])) / 2


def infer_tree(
    points: dict[int, Tensor],
    motions: dict[int, Tensor],
    *,
    covariances: dict[int, Tensor] | None = None,
    root: int | None = None,
    render_ratios: dict[tuple[int, int], float] | None = None,
    noise: float = NOISE,
    epsilon: float = EPSILON,
    method: JointMethod = "screw",
) -> KinematicTree:
    """Joints and tree from the parts' points [N, 3] at state 0 and their motions [S, 4, 4], both by part id.

    `covariances` [S, 6, 6]: of the motions, T_true = exp(d) T with d = (translation, rotation) about the world's
    origin. `render_ratios` by (parent, child) in either order; `noise` and `epsilon` as in `fit_joint`. `method`
    "screw" fits in closed form and refines; "descent" is the paper's gradient descent, which knows no covariances and
    no ratios, for comparison.
    """
    radius = object_radius(points)
    if method == "descent":
        joints = descend_pairs(points, motions, radius, epsilon)
    else:
        joints = fit_pairs(
            points, motions, radius, covariances=covariances, render_ratios=render_ratios, noise=noise, epsilon=epsilon
        )
    if root is None:
        root = choose_root(points, motions, radius, noise)
    return build_tree(sorted(points), joints, find_contacts(points, motions), root, radius)


def fit_pairs(
    points: dict[int, Tensor],
    motions: dict[int, Tensor],
    object_radius: float,
    *,
    covariances: dict[int, Tensor] | None = None,
    render_ratios: dict[tuple[int, int], float] | None = None,
    noise: float = NOISE,
    epsilon: float = EPSILON,
) -> dict[tuple[int, int], JointFit]:
    """Joints of all pairs by (parent, child), both ways round; arguments as in `infer_tree`."""
    pairs = [(a, b) for a in sorted(points) for b in sorted(points) if a < b]
    if not pairs:
        return {}
    ratios = render_ratios or {}
    motions = {p: T.double() for p, T in motions.items()}
    # The parent's error reaches the child by its lever arm; the child's own is added by `fit_joints`.
    errors = {p: _surface_error(points[p].double(), motions[p], noise, object_radius) for p in points}
    T_rel = torch.stack([inverse(motions[a]) @ motions[b] for a, b in pairs])
    to_parent = adjoint(torch.stack([inverse(motions[a]) for a, _ in pairs]))
    known = torch.stack([errors[a] for a, _ in pairs])
    if covariances is not None:
        known = known + torch.stack([covariances[a] + covariances[b] for a, b in pairs]).to(known)
    fits = fit_joints(
        T_rel,
        [points[b] for _, b in pairs],
        object_radius,
        to_parent @ known @ to_parent.mT,
        noise,
        epsilon,
        [ratios.get((a, b), ratios.get((b, a))) for a, b in pairs],
    )
    return _both_ways(pairs, fits, T_rel, points)


def descend_pairs(
    points: dict[int, Tensor], motions: dict[int, Tensor], object_radius: float, epsilon: float = EPSILON
) -> dict[tuple[int, int], JointFit]:
    """As `fit_pairs`, in the paper's way: of a revolute and a prismatic joint by gradient descent, the better one."""
    pairs = [(a, b) for a in sorted(points) for b in sorted(points) if a < b]
    T_rel = [inverse(motions[a].double()) @ motions[b].double() for a, b in pairs]
    fits = []
    for (_, b), T in zip(pairs, T_rel, strict=True):
        both = [descend_joint(kind, T, points[b]) for kind in ("revolute", "prismatic")]
        best = min(both, key=lambda fit: fit.residual)
        fits.append(replace(best, accepted=best.residual <= epsilon * object_radius))
    return _both_ways(pairs, fits, T_rel, points)


def _both_ways(
    pairs: list[tuple[int, int]], fits: Sequence[JointFit], T_rel: Sequence[Tensor], points: dict[int, Tensor]
) -> dict[tuple[int, int], JointFit]:
    """Joints by (parent, child) from those of pairs (a, b) with motions T_rel of b relative to a."""
    joints = {}
    for (a, b), fit, T in zip(pairs, fits, T_rel, strict=True):
        joints[a, b] = fit
        joints[b, a] = fit.reversed(points[a], inverse(T))
    return joints


def _surface_error(points: Tensor, T: Tensor, noise: float, object_radius: float) -> Tensor:
    """The covariances [S, 6, 6] that the noise gives a part's motions, about the world's origin."""
    about = torch.eye(4).to(T)
    about[:3, 3] = points.mean(0)
    to_world = adjoint(T @ about)
    return to_world @ surface_noise(points, noise, object_radius) @ to_world.mT


def choose_root(
    points: dict[int, Tensor], motions: dict[int, Tensor], object_radius: float, noise: float = NOISE
) -> int:
    """The largest part that stood still in the world; if all moved, the one that moved least."""
    moved, sizes = {}, {}
    for p, x in points.items():
        x = x.double()
        steps = transform_points(motions[p].double(), x) - x
        moved[p] = float(torch.linalg.vector_norm(steps, dim=-1).mean(-1).max())
        sizes[p] = float(torch.linalg.vector_norm(x - x.mean(0), dim=-1).max())
    still = [p for p in points if moved[p] < 3 * noise * object_radius]
    return max(still, key=sizes.get) if still else min(points, key=moved.get)


def build_tree(
    part_ids: list[int],
    joints: Mapping[tuple[int, int], JointFit],
    contacts: Mapping[tuple[int, int], Contact],
    root: int,
    object_radius: float,
) -> KinematicTree:
    """The spanning tree of least total cost from `root` over the accepted joints.

    `joints` by (parent, child), both ways round; `contacts` by (a, b), a < b.
    """
    graph = {}
    for (parent, child), fit in joints.items():
        if fit.accepted:
            graph[parent, child] = _weighed(parent, child, fit, contacts[_pair(parent, child)], object_radius)
    reached, chosen = {root}, []
    while open_edges := [j for j in graph.values() if j.parent in reached and j.child not in reached]:
        joint = min(open_edges, key=lambda j: j.cost)
        chosen.append(joint)
        reached.add(joint.child)

    tree = KinematicTree(list(part_ids), root, chosen)
    taken = {_pair(j.parent, j.child) for j in chosen}
    order = {root: 0} | {j.child: k + 1 for k, j in enumerate(chosen)}
    # Of the two ways round, the one that hangs the part found later on the one found earlier.
    rest = [
        j
        for j in graph.values()
        if _pair(j.parent, j.child) not in taken and j.parent in order and order[j.parent] < order.get(j.child, -1)
    ]
    rest.sort(key=lambda j: j.cost)
    loops = [j for j in rest if _closes_loop(tree, j, contacts[_pair(j.parent, j.child)], object_radius)]
    rejected = [j for j in rest if j not in loops]
    unattached = {p: _why_unattached(p, reached, joints, object_radius) for p in part_ids if p not in reached}
    return replace(tree, loops=loops, rejected=rejected, unattached=unattached)


def _pair(a: int, b: int) -> tuple[int, int]:
    return min(a, b), max(a, b)


def _weighed(parent: int, child: int, fit: JointFit, contact: Contact, object_radius: float) -> Joint:
    off_axis = contact.distance_to_axis(fit.axis, fit.origin) if fit.type in ("revolute", "screw") else 0.0
    return Joint(parent, child, fit, contact.gap, (fit.residual + contact.gap + off_axis) / object_radius)


def _closes_loop(tree: KinematicTree, joint: Joint, contact: Contact, object_radius: float) -> bool:
    """Whether a joint outside the tree is one of the object's, and not an accident or a consequence of the tree.

    It must be as well supported as the tree's own joints between the two parts (in touch, axis at the contact), and
    it must not hold in all configurations: two drawers side by side slide along each other whatever their values are,
    which constrains nothing.
    """
    cycle = _path(tree, joint.child) ^ _path(tree, joint.parent)
    on_cycle = [j for j in tree.joints if j.child in cycle]
    if joint.fit.type == "fixed" or joint.fit.ambiguous or joint.fit.undetermined:
        return False
    if joint.gap > 1.5 * max(j.gap for j in on_cycle) or joint.cost > 1.5 * max(j.cost for j in on_cycle):
        return False
    if joint.fit.type == "prismatic" and len(joint.fit.values) == 2:
        return False
    # Configurations in which every joint goes its own way.
    factors = torch.rand(4, len(tree.movable), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q = (2 * factors - 1) * tree.observed().abs().amax(0).cpu()
    T = dict(zip(tree.part_ids, forward_kinematics(tree, q).unbind(1), strict=True))
    T_rel = torch.cat([torch.eye(4).to(q)[None], inverse(T[joint.parent]) @ T[joint.child]])
    free = fit_joint(T_rel, contact.points.cpu(), object_radius=object_radius, types=(joint.fit.type,))
    return free.residual > EPSILON * object_radius


def _path(tree: KinematicTree, part: int) -> set[int]:
    """The parts from one up to the root, without the root."""
    parents = {j.child: j.parent for j in tree.joints}
    path = set()
    while part in parents:
        path.add(part)
        part = parents[part]
    return path


def _why_unattached(
    part: int, reached: set[int], joints: Mapping[tuple[int, int], JointFit], object_radius: float
) -> str:
    tried = [
        (fit.residual / object_radius, p, fit.type) for (p, c), fit in joints.items() if c == part and p in reached
    ]
    if not tried:
        return f"Part {part} has no fitted joint to any part of the tree."
    residual, parent, kind = min(tried)
    return (
        f"No joint explains how part {part} moves: the best, {kind} on part {parent}, leaves {residual:.1%} of the "
        "object's radius, more than the limit and than noise would."
    )
