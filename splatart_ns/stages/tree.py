"""Stage 4: which parts hang on which.

All pairs of parts are fitted; the pairs whose fit is accepted make the graph; the tree is the spanning arborescence
of least cost. A pair costs what speaks against a joint there, in shares of the object's radius: the residual, the gap
between the two parts (a joint keeps them in touch), how far a turning axis passes by the two parts, a little if the
parent is not the root, and 1 for every degree of freedom beyond the first: two hinges in a row look
like one joint of more freedom. With two states kinematics alone cannot find the tree: about as many false pairs as
true ones move like joints, two drawers for instance. Contact tells them apart.

A part that no joint explains, not even one that turns and slides (`cylindrical`), hangs on nothing, and the tree says
why. If other parts hang on it, a free joint carries the group, so that the joints within it are not lost.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor

from splatart_ns.errors import InputError
from splatart_ns.geometry.se3 import inverse, transform_points
from splatart_ns.stages.arborescence import cheapest_parents, reached_from
from splatart_ns.stages.articulate import Joint, KinematicTree, forward_kinematics
from splatart_ns.stages.contact import Contact, find_contacts
from splatart_ns.stages.cylindrical import turning_slides
from splatart_ns.stages.joint import EPSILON, NOISE, fit_joint, leaves_unexplained
from splatart_ns.stages.joint_constraint import JointConstraint, required_parents
from splatart_ns.stages.joint_fit import JointFit, free_joint
from splatart_ns.stages.joint_pairs import descend_pairs, fit_pairs, stood_still, surface_error, told_pair
from splatart_ns.stages.tree_reasons import exchange_hint, fits_far_worse, why_contradicted, why_unattached
from splatart_ns.stages.tree_refinement import refine_tree
from splatart_ns.stages.unseen import (
    as_seen,
    known_states,
    leads_blindly,
    may_have_turned,
    place_unseen,
    unknown_covariance,
    unturned,
)
from splatart_ns.stages.unseen_turn import turned_least, turned_unseen

JointMethod = Literal["screw", "descent"]
_SEEN_NOISE = 0.3
"""Share of the noise that is left where the covariances of the motions are known: with all of it, a thin part that
turned by 21 degrees about its own length counted as fixed."""
_REGION_NOISE = 0.1
"""Share of the noise in the regions stated of joints: of 114 true lines 113 lie in their 95 % regions, as with 0.3,
and with 0.06 and 0.03 only 106 and 96 (docs/joints.md)."""
_STACKED = 0.02
"""Cost of a joint that does not hang on the root: two drawers that touch each other and the body alike slide in the
body both."""
_STACKED_ALIKE = 0.1
"""That of a slide on a part that slides on the root itself, both along the way the child slides on the root, and of a
hinge whose axis its parent and the child itself turn about on the root, as doors above each other do. It says nothing
that the other two do not, and a drawer shows where it nears its neighbour but not where it touches the body. And that
of a part that is nearly fixed to such a one, but not quite: both moved by about as much. And that of a slide between
two parts that turn about parallel lines on the root: from one state to another by the same angle. And that of two that
rest on the root, but may have turned, as knobs beside each other: what is behind them nobody sees. And that of a slide
on a part that rests on the root: a closed drawer is nearer to the one below it than what is seen of the body."""
_NOT_QUITE, _OF_MOTION = 0.002, 0.15
"""Least residual of such a fixed joint, as a share of the object's radius: a handle's on its door is as small as the
errors of poses are; of two of a desk's seven drawers it was 0.0028. Or as a share of what a fixed joint to the root
leaves, if that is less: of two buttons that moved by 0.011 and 0.013 radii it is a fifth."""
_PARALLEL, _ASTRAY = 0.98, 0.004
"""Least cosine of the angle between slides along one way, and hinges about one line. A slide that leads aside by less
than the second, as a share of the object's radius, goes along it, too: so short a one goes where the poses err."""
_ONE_LINE = 0.1
"""How far such hinges may lie apart, as a share of the object's radius."""
_TURNED_BACK = 0.1
"""And besides, of such a hinge, where its parent turned further on the root than the child, which then turned back on
it: of a stapler's three parts about one pin, that in the middle turned by less than the last."""
_CLOSE_CALL = 0.02
"""How much more the cheapest tree may cost that hangs a part on another one, where that is said to be as likely.
Measured on 387 joints of robots, models and random objects: so it is of 10 of 20 that have a wrong parent, all but two
of which have their true one in that other tree, and of 14 of the 367 others. Where the two parents stay together only
contact tells them apart, so that as much as `_STACKED_ALIKE` is close."""
_APART = 0.4
"""Parts that come apart by more than this share of the object's radius are not joined, unless the user says so: parts
that are came apart by 0.12 at most (of 387 joints); a chair's seat, which turned and slid, fitted hinges on two wheels
0.49 and 0.58 away."""
_IN_TOUCH = 0.1
"""Largest gap of two parts of a group that only a free joint carries, as a share of the object's radius."""
_AS_SUPPORTED = 1.5
"""A joint closes a loop if its gap and its cost are at most this many times the largest of the loop's joints in the
tree."""


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
    constraints: Sequence[JointConstraint] = (),
    names: Mapping[int, str] | None = None,
) -> KinematicTree:
    """Joints and tree from the parts' points [N, 3] at state 0 and their motions [S, 4, 4], both by part id.

    `covariances` [S, 6, 6]: of the motions, T_true = exp(d) T with d = (translation, rotation) about the world's
    origin. `render_ratios` by (parent, child) in either order; `noise` and `epsilon` as in `fit_joint`. `method`
    "screw" fits in closed form and refines, pairs first and then the whole tree; "descent" is the paper's gradient
    descent, which knows no covariances and no ratios, for comparison. `constraints`: what the user knows of joints;
    where they name a type, the first method fits it. `names`: what reasons and errors call the parts.

    Raises:
        InputError: the constraints contradict each other or the root, or name a part without points, or a parent that
            is not known at state 0.
    """
    names = names or _numbered({*points, *(p for c in constraints for p in (c.parent, c.child))})
    if missing := {p for c in constraints for p in (c.parent, c.child)} - set(points):
        raise InputError(f"--joint: {names[min(missing)]} has no Gaussians to hang; leave it out")
    required = required_parents(constraints, root, names)
    radius = object_radius(points)
    known = known_states(motions, covariances)
    lost = {p for p in points if not known[p][0]}
    if blind := set(required.values()) & lost:
        raise InputError(f"--joint: nothing can hang on {names[min(blind)]}, which state 0 does not show; leave it out")
    if root is None:
        free = _possible_roots(set(points) - set(required), motions, covariances, known)
        root = choose_root({p: points[p] for p in free}, motions, radius, noise)
    if covariances is not None and stood_still(root, motions):
        # If it turned unseen, so did all that hangs on it.
        covariances = covariances | {root: 0 * covariances[root]}
    elif covariances is not None and bool(unturned(motions[root]).all()):
        covariances = covariances | {root: as_seen(covariances[root])}
    floor = noise if covariances is None else _SEEN_NOISE * noise
    certainty = {"covariances": covariances, "noise": floor, "epsilon": epsilon}
    if method == "descent":
        joints = descend_pairs(points, motions, radius, epsilon)
    else:
        joints = fit_pairs(points, motions, radius, render_ratios=render_ratios, **certainty)
    joints, contradicted = _as_told(constraints, joints, points, motions, radius, names, **certainty)
    # A part of which nothing tells where it is at state 0 hangs on others, and nothing hangs on it.
    joints = {(a, b): fit for (a, b), fit in joints.items() if a not in lost}
    blindly = {(a, b) for a, b in joints if leads_blindly(known[a], known[b]) and required.get(b) != a}
    joints = {edge: fit for edge, fit in joints.items() if edge not in blindly}
    contacts = find_contacts(points, motions, {_pair(*edge) for edge, fit in joints.items() if fit.accepted}, known)
    far = {pair for pair, contact in contacts.items() if contact.gap > _APART * radius}
    far -= {_pair(c.parent, c.child) for c in constraints if not c.forbidden}
    joints = {edge: fit for edge, fit in joints.items() if _pair(*edge) not in far}
    if method != "descent":
        hung = reached_from([edge for edge, fit in joints.items() if fit.accepted], root)
        ruled_out = {_pair(c.parent, c.child) for c in constraints if c.forbidden and c.type == "cylindrical"}
        allowed = {edge: fit for edge, fit in joints.items() if _pair(*edge) not in ruled_out}
        slides = turning_slides(points, motions, allowed, hung, radius, known, **certainty)
        joints |= slides
        contacts |= find_contacts(points, motions, {_pair(*edge) for edge in slides}, known)
    groups = _free_groups(points, motions, joints, contacts, root, radius, required, noise)
    contacts |= find_contacts(points, motions, {_pair(*edge) for edge in groups}, known)
    tree = _doubted(build_tree(sorted(points), joints | groups, contacts, root, radius, required, epsilon))
    reached = reached_from([(j.parent, j.child) for j in tree.joints if (j.parent, j.child) not in groups], root)
    carried = {root, *(j.child for j in tree.joints if (j.parent, j.child) not in groups)}
    apart = {pair: contacts[pair].gap for pair in far}
    reasons = {
        p: why_unattached(p, reached, joints, apart, radius, names) + exchange_hint(p, points, motions, names)
        for p in sorted(set(points) - carried)
    }
    tree = replace(tree, unattached=reasons, contradicted=contradicted)
    if method == "descent":  # its fits have no scores
        return replace(tree, joints=[replace(j, other=None) for j in tree.joints])
    places, motions, known = place_unseen(tree, motions, known)
    points = {p: transform_points(places[p].to(x), x) for p, x in points.items()}
    weighed = covariances
    if covariances is not None:
        tree, motions, weighed = turned_least(tree, points, motions, radius, **certainty)
    regions, share = (noise, 1) if covariances is None else (_REGION_NOISE * noise, max(1, len(motions[root]) - 1) ** 2)
    errors = _pose_errors(points, motions, covariances, known, radius, regions)
    # In the weights noise counts for less beside what the images say, the more motions there are (docs/accuracy.md).
    weights = _pose_errors(points, motions, weighed, known, radius, floor / share)
    tree = refine_tree(tree, points, motions, errors, weights)
    return tree if covariances is None else turned_unseen(tree, points, motions, covariances, errors, constraints)


def _possible_roots(
    free: set[int],
    motions: Mapping[int, Tensor],
    covariances: Mapping[int, Tensor] | None,
    known: Mapping[int, Tensor],
) -> set[int]:
    """Those of some parts that may be the root: if possible such as are seen in all states, of others it is not known
    that they rest, and such as surely did not turn, if any part stood still."""
    free = {p for p in free if known[p].all()} or {p for p in free if known[p][0]} or free
    if any(stood_still(p, motions, covariances) for p in free):
        free = {p for p in free if covariances is None or not may_have_turned(covariances[p]).any()}
    return free


def _as_told(
    constraints: Sequence[JointConstraint],
    joints: dict[tuple[int, int], JointFit],
    points: Mapping[int, Tensor],
    motions: Mapping[int, Tensor],
    radius: float,
    names: Mapping[int, str],
    **certainty: Any,
) -> tuple[dict[tuple[int, int], JointFit], dict[int, str]]:
    """The joints by (parent, child), with those between parts that the user knows of as `told_pair` says, and by part
    in what the motions contradict the user."""
    contradicted = {}
    for c in sorted(constraints, key=lambda c: not c.forbidden):
        edge, pair = (c.parent, c.child), {p: points[p] for p in (c.parent, c.child)}
        excluded = {d.type for d in constraints if d.forbidden and {d.parent, d.child} == set(pair)}
        told = told_pair(c, joints, pair, motions, radius, excluded, **certainty)
        if not c.forbidden:
            if c.type is not None and edge in joints and fits_far_worse(told[edge], joints[edge]):
                contradicted[c.child] = why_contradicted(edge, told[edge], joints[edge], radius, names)
            told = {edge: replace(fit, accepted=True) for edge, fit in told.items()}
        joints = {edge: fit for edge, fit in joints.items() if set(edge) != set(pair)} | told
    return joints, contradicted


def _pose_errors(
    points: Mapping[int, Tensor],
    motions: Mapping[int, Tensor],
    covariances: Mapping[int, Tensor] | None,
    known: Mapping[int, Tensor],
    radius: float,
    noise: float,
) -> dict[int, Tensor]:
    """Covariances [S, 6, 6] of the motions by part id, with the noise of the points."""
    errors = {}
    for p, x in points.items():
        told = torch.zeros(6, 6, dtype=torch.float64, device=x.device)
        if covariances is not None:
            told = torch.where(known[p][:, None, None], covariances[p].to(told), unknown_covariance(radius).to(told))
        errors[p] = told + surface_error(x.double(), motions[p].double(), noise, radius)
    return errors


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
    required: Mapping[int, int] | None = None,
    epsilon: float = EPSILON,
) -> KinematicTree:
    """The spanning tree of least total cost from `root` over the accepted joints.

    `joints` by (parent, child), both ways round; `contacts` of the accepted ones by (a, b), a < b; `required`: parents
    by child that the tree must have; `epsilon` as in `fit_joint`.
    """
    required = required or {}
    graph = {}
    for (parent, child), fit in joints.items():
        if fit.accepted:
            joint = _weighed(parent, child, fit, contacts[_pair(parent, child)], object_radius)
            graph[parent, child] = replace(
                joint, cost=joint.cost + _stacked(joints, parent, child, root, object_radius)
            )
    allowed = {(a, b): j.cost for (a, b), j in graph.items() if required.get(b, a) == a and required.get(a) != b}
    parents = cheapest_parents(allowed, root)
    reached, chosen = {root}, []
    while open_edges := [graph[a, b] for b, a in parents.items() if a in reached and b not in reached]:
        joint = min(open_edges, key=lambda j: j.cost)
        chosen.append(joint)
        reached.add(joint.child)
    others = _other_parents(allowed, parents, root, {edge for edge, fit in joints.items() if fit.type == "fixed"})
    chosen = [replace(j, other=graph[others[j.child], j.child]) if j.child in others else j for j in chosen]

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
    loops = [j for j in rest if _closes_loop(tree, j, contacts[_pair(j.parent, j.child)], object_radius, epsilon)]
    rejected = [j for j in rest if j not in loops]
    return replace(tree, loops=loops, rejected=rejected)


def _doubted(tree: KinematicTree) -> KinematicTree:
    """The tree with those of its joints called ambiguous that leave more than the noise explains."""
    fits = [replace(j.fit, ambiguous=j.fit.ambiguous or leaves_unexplained(j.fit)) for j in tree.joints]
    return replace(tree, joints=[replace(j, fit=fit) for j, fit in zip(tree.joints, fits, strict=True)])


def _other_parents(
    costs: Mapping[tuple[int, int], float], parents: Mapping[int, int], root: int, fixed: Set[tuple[int, int]]
) -> dict[int, int]:
    """By child: its parent in the cheapest tree that hangs it on another one, where that tree costs hardly more.

    `fixed`: pairs of parts, either way round, that stay together.
    """
    least, others = sum(costs[a, b] for b, a in parents.items()), {}
    for b, a in parents.items():
        elsewhere = cheapest_parents({edge: cost for edge, cost in costs.items() if edge != (a, b)}, root)
        cost = sum(costs[parent, child] for child, parent in elsewhere.items())
        if elsewhere.keys() != parents.keys():
            continue
        moves_alike = (a, elsewhere[b]) in fixed and (a, b) not in fixed
        if cost - least < (_STACKED_ALIKE if moves_alike else _CLOSE_CALL):
            others[b] = elsewhere[b]
    return others


def _free_groups(
    points: dict[int, Tensor],
    motions: dict[int, Tensor],
    joints: Mapping[tuple[int, int], JointFit],
    contacts: Mapping[tuple[int, int], Contact],
    root: int,
    object_radius: float,
    required: Mapping[int, int],
    noise: float = NOISE,
) -> dict[tuple[int, int], JointFit]:
    """Free joints by (root, base) for groups of parts that touch and are joined, but by no joint to the rest."""
    edges = [edge for edge, fit in joints.items() if fit.accepted]
    left = set(points) - reached_from(edges, root)
    touching = [edge for edge in edges if contacts[_pair(*edge)].gap <= _IN_TOUCH * object_radius]
    touching += [edge for b, a in required.items() for edge in ((a, b), (b, a))]
    groups = {}
    while left:
        group = reached_from([(a, b) for a, b in touching if {a, b} <= left], min(left))
        left -= group
        if len(group) > 1:
            base = choose_root({p: points[p] for p in group if p not in required}, motions, object_radius, noise)
            T_rel = inverse(motions[root].double()) @ motions[base].double()
            groups[root, base] = free_joint(T_rel, points[base])
    return groups


def _pair(a: int, b: int) -> tuple[int, int]:
    return min(a, b), max(a, b)


def _weighed(parent: int, child: int, fit: JointFit, contact: Contact, object_radius: float) -> Joint:
    off_axis = 0.0
    if fit.type in ("revolute", "screw", "cylindrical"):
        off_axis = contact.distance_to_axis(fit.axis, fit.origin)
    elif fit.type == "spherical":
        off_axis = contact.distance_to_point(fit.origin)
    cost = (fit.residual + contact.gap + off_axis) / object_radius + max(0, fit.dofs - 1)
    return Joint(parent, child, fit, contact.gap, cost)


def _stacked(
    joints: Mapping[tuple[int, int], JointFit], parent: int, child: int, root: int, object_radius: float
) -> float:
    """What a joint costs for not hanging on the root."""
    if parent == root:
        return 0.0
    fits = [joints.get(edge) for edge in ((parent, child), (root, parent), (root, child))]
    if any(fit is None or not fit.accepted for fit in fits):
        return _STACKED
    between, *on_root = fits
    moved = min((a["residual"] for a in on_root[1].alternatives if a["type"] == "fixed"), default=math.inf)
    not_quite = min(_NOT_QUITE * object_radius, _OF_MOTION * moved)
    not_quite_fixed = between.type == "fixed" and between.residual > not_quite
    by_one_angle = between.type == "prismatic" and {fit.type for fit in on_root} == {"revolute"}
    if not_quite_fixed or by_one_angle:
        fits = on_root
    kinds = {fit.type for fit in fits}
    if kinds == {"fixed"} and all(fit.ambiguous for fit in on_root):
        return _STACKED_ALIKE
    if [fit.type for fit in fits] == ["prismatic", "fixed", "prismatic"]:
        return _STACKED_ALIKE
    if kinds not in ({"prismatic"}, {"revolute"}):
        return _STACKED
    if kinds == {"prismatic"} and _leads_aside(between, on_root[0].axis) < _ASTRAY * object_radius:
        fits = on_root
    axes = torch.stack([fit.axis for fit in fits])
    if not bool(((axes @ axes.T).abs() > _PARALLEL).all()):
        return _STACKED
    if kinds == {"revolute"} and not by_one_angle:
        origins = torch.stack([fit.origin for fit in fits])
        apart = torch.linalg.cross(origins[:, None] - origins, axes.expand(len(fits), -1, -1)).norm(dim=-1)
        if bool((apart > _ONE_LINE * object_radius).any()):
            return _STACKED
        parent_turned, child_turned = (fit.values.abs().max() for fit in on_root)
        return _STACKED_ALIKE + (_TURNED_BACK if parent_turned > child_turned else 0)
    return _STACKED_ALIKE


def _leads_aside(slide: JointFit, axis: Tensor) -> float:
    """How far, at most, a slide leads from the way along `axis` [3]."""
    return float(torch.linalg.cross(slide.axis, axis).norm() * slide.values.abs().max())


def _closes_loop(tree: KinematicTree, joint: Joint, contact: Contact, object_radius: float, epsilon: float) -> bool:
    """Whether a joint outside the tree is one of the object's, and not an accident or a consequence of the tree.

    It must be as well supported as the tree's own joints between the two parts (in touch, axis at the contact), and
    it must not hold in all configurations: two drawers side by side slide along each other whatever their values are,
    which constrains nothing.
    """
    cycle = _path(tree, joint.child) ^ _path(tree, joint.parent)
    on_cycle = [j for j in tree.joints if j.child in cycle]
    # With more freedom a fit proves too little.
    if joint.fit.dofs != 1 or joint.fit.ambiguous or joint.fit.undetermined:
        return False
    gap, cost = max(j.gap for j in on_cycle), max(j.cost for j in on_cycle)
    if joint.gap > _AS_SUPPORTED * gap or joint.cost > _AS_SUPPORTED * cost:
        return False
    if joint.fit.type == "prismatic" and joint.fit.num_shown == 2:
        return False
    # Configurations in which every joint goes its own way.
    reach = tree.observed().abs().amax(0).cpu()
    factors = torch.rand(4, len(reach), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q = (2 * factors - 1) * reach
    T = dict(zip(tree.part_ids, forward_kinematics(tree, q).unbind(1), strict=True))
    T_rel = torch.cat([torch.eye(4).to(q)[None], inverse(T[joint.parent]) @ T[joint.child]])
    free = fit_joint(T_rel, contact.points.cpu(), object_radius=object_radius, types=(joint.fit.type,))
    return free.residual > epsilon * object_radius


def _path(tree: KinematicTree, part: int) -> set[int]:
    """The parts from one up to the root, without the root."""
    parents = {j.child: j.parent for j in tree.joints}
    path = set()
    while part in parents:
        path.add(part)
        part = parents[part]
    return path


def _numbered(part_ids: Iterable[int]) -> dict[int, str]:
    return {p: f"part {p}" for p in part_ids}
