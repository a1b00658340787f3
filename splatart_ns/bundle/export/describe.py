"""From a bundle to the plain description that every robot format is written from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from splatart_ns.bundle import bundle as model
from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.export.freedoms import freedom_names, freedoms, joint_value
from splatart_ns.bundle.export.inertia import solid_inertia
from splatart_ns.bundle.export.names import RESERVED, identifier, identifiers
from splatart_ns.bundle.export.overlap import overlaps
from splatart_ns.bundle.export.robot import Joint, Link, Loop, Robot
from splatart_ns.bundle.export.shapes import PartShape
from splatart_ns.bundle.posing import configured_motions
from splatart_ns.errors import InputError

DENSITY = 400.0
"""kg / m^3, of the filled mesh: between hollow furniture and solid wood."""
LIMIT_MARGIN = 0.05
"""Of a joint's range, by which limits are wider at both ends."""
_SIZES = (0.005, 50.0)
"""Metres, of objects that simulators can be trusted with."""
_MOST, _MOST_MARGIN = 1e6, 100.0
"""Bounds of scales and densities, one way and the other, and of margins."""
_GUESSED = 0.1
"""A larger share of a part's surface that nobody saw is told."""
_METRES = {
    **dict.fromkeys(("metre", "meter", "metres", "meters", "m"), 1.0),
    **dict.fromkeys(("centimetre", "centimeter", "centimetres", "centimeters", "cm"), 0.01),
    **dict.fromkeys(("millimetre", "millimeter", "millimetres", "millimeters", "mm"), 0.001),
}


def check_numbers(scale: float | None, density: float, limit_margin: float) -> None:
    """Raise InputError for numbers that `describe` cannot take."""
    for name, number in {"scale": 1.0 if scale is None else scale, "density": density}.items():
        if not 1 / _MOST <= number <= _MOST:
            raise InputError(f"--{name} is {number}; give a number from {1 / _MOST:g} to {_MOST:g}")
    if not 0 <= limit_margin <= _MOST_MARGIN:
        raise InputError(f"--limit-margin is {limit_margin}; give a number from 0 to {_MOST_MARGIN:g}")


def metres_per_unit(bundle: Bundle, scale: float | None) -> tuple[float, list[str]]:
    """The scale of an export, `scale` if it is given, and what to say about it."""
    if scale is not None:
        return scale, []
    unit = bundle.length_unit.lower()
    if unit in _METRES:
        return _METRES[unit], []
    return 1.0, [f"The bundle's unit of length is '{bundle.length_unit}': taken as metres; say better with --scale."]


def describe(
    bundle: Bundle,
    shapes: Mapping[str, PartShape] | None,
    name: str,
    scale: float | None = None,
    density: float = DENSITY,
    limit_margin: float = LIMIT_MARGIN,
) -> Robot:
    """The bundle as a robot, in metres.

    Args:
        shapes: By part, in the canonical frame and the bundle's unit; see `part_shapes`. None for links without
            meshes, which is enough for a PLY.
        name: Of the whole; made an identifier.
        scale: Metres per unit of the bundle; by default as its unit says, else 1.
        density: kg / m^3.
        limit_margin: How much wider than a joint's range its limits are at both ends, in ranges.

    Raises:
        InputError: a scale, density or margin as in `check_numbers`.
    """
    check_numbers(scale, density, limit_margin)
    metres, notes = metres_per_unit(bundle, scale)
    names = dict(zip(bundle.part_names, identifiers(bundle.part_names), strict=True))
    tree = {joint.child: joint for joint in bundle.tree_joints}
    # Parts that hang on nothing come last, held to the root.
    loose = [part for part in bundle.part_names if part != bundle.root and part not in tree]
    links = {}
    for part in [bundle.root, *tree, *loose]:
        origin = tree[part].origin.double().numpy() * metres if part in tree else np.zeros(3)
        shape = (PartShape(None, ()) if shapes is None else shapes[part]).moved(metres, origin)
        inertia = solid_inertia(shape.surface, shape.pieces, density)
        links[names[part]] = Link(names[part], part, origin, inertia, shape.surface, shape.pieces)
        if shape.surface is None and shapes is not None:
            notes.append(f"Part '{part}' has no surface: written with the least mass and without a mesh.")
        elif shapes is not None and (share := shapes[part].surface.metadata.get("unseen_share", 0.0)) > _GUESSED:
            notes.append(f"Part '{part}': no camera looked at {share:.0%} of its surface, whose shape is a guess.")

    joint_names, joints = _joints(bundle, names, loose, metres, limit_margin)
    for joint in joints:
        if joint.source is None:
            notes.append(f"Part '{links[joint.child].part}' hangs on nothing: fixed to '{bundle.root}'.")
        elif not joint.freedoms and (kind := tree[links[joint.child].part].type) != "fixed":
            notes.append(f"Joint '{joint.source}' ({kind}) did not move in the capture: written as fixed.")
    loops = [_loop(joint, joint_names, names, metres) for joint in bundle.joints if not joint.in_tree]
    notes += [f"'{old}' is written as '{new}'." for old, new in [*names.items(), *joint_names.items()] if old != new]

    neighbours = {frozenset((joint.parent, joint.child)) for joint in joints}
    placed = {link.name: [p.copy().apply_translation(link.origin) for p in link.pieces] for link in links.values()}
    robot = Robot(
        name=identifier(name),
        root=names[bundle.root],
        links=links,
        joints=tuple(joints),
        loops=tuple(loops),
        overlaps=overlaps(placed, neighbours),
        scale=metres,
        notes=tuple(notes),
    )
    if shapes is not None and not _SIZES[0] < robot.size < _SIZES[1]:
        note = f"The object is {robot.size:.3g} m across, for which simulators are not made; check --scale."
        robot = replace(robot, notes=(*robot.notes, note))
    return robot


def _joints(
    bundle: Bundle, names: Mapping[str, str], loose: Sequence[str], scale: float, margin: float
) -> tuple[dict[str, str], list[Joint]]:
    """The identifier of each of the bundle's joints, loops too, and the tree's joints; parts in `loose` are fixed.

    `names` are the links by part. Identifiers of joints, of the freedoms of chains and of the links in these differ.
    """
    chosen = identifiers([joint.name for joint in bundle.joints] + [f"{part} held" for part in loose])
    joint_names = {joint.name: name for joint, name in zip(bundle.joints, chosen, strict=False)}
    taken = [*RESERVED, *chosen, *names.values()]
    joints = []
    for joint in bundle.tree_joints:
        name, called = joint_names[joint.name], freedom_names(joint)
        if len(called) == 1:
            called = [name]
        else:
            called = identifiers(called, taken)
            taken += called
        chain = freedoms(joint, called, scale, margin)
        between = identifiers([f"{freedom.name}_link" for freedom in chain[:-1]], taken)
        taken += between
        joints.append(Joint(name, names[joint.parent], names[joint.child], chain, tuple(between), joint.name))
    for part, name in zip(loose, chosen[len(bundle.joints) :], strict=True):
        joints.append(Joint(name, names[bundle.root], names[part], (), (), None))
    return joint_names, joints


def _loop(joint: model.Joint, joint_names: Mapping[str, str], names: Mapping[str, str], scale: float) -> Loop:
    axis = joint.axis.double().numpy()
    return Loop(
        joint_names[joint.name],
        joint.type,
        names[joint.parent],
        names[joint.child],
        axis / np.linalg.norm(axis),
        joint.origin.double().numpy() * scale,
        joint.pitch * scale,
    )


def expected_poses(bundle: Bundle, robot: Robot, values: Mapping[str, float]) -> dict[str, np.ndarray]:
    """T_canonical_link [4, 4] in metres of every link at values of the freedoms, by the bundle's own joints."""
    values = robot.complete(values)
    sources = {joint.name: joint for joint in bundle.joints}
    q = {}
    for joint in robot.joints:
        if joint.freedoms:
            numbers = [values[f.name] for f in joint.freedoms]
            q[joint.source] = joint_value(sources[joint.source], numbers, robot.scale)
    motions = configured_motions(bundle, q)
    poses = {}
    for link in robot.links.values():
        T = motions[link.part].numpy().copy()
        T[:3, 3] = T[:3, 3] * robot.scale + T[:3, :3] @ link.origin
        poses[link.name] = T
    return poses
