"""The object as MJCF, MuJoCo's own format: with loops, actuators and the pairs of links that must not collide."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from splatart_ns.bundle.export.inertia import between
from splatart_ns.bundle.export.loads import Load, load
from splatart_ns.bundle.export.meshes import MESHES, MeshFiles, write_meshes
from splatart_ns.bundle.export.robot import DAMPING, FRICTION, GRAVITY, Freedom, Inertia, Joint, Link, Loop, Robot

ARMATURE = 0.001
"""Inertia of a motor, kilogram metre^2 or kilogram: keeps light links stable."""


def write_mjcf(robot: Robot, folder: Path) -> Path:
    """Write `<name>.xml` and its meshes. The root is fixed to the world; each joint has a position actuator."""
    files = write_meshes(robot, folder)
    model = Element("mujoco", model=robot.name)
    SubElement(model, "compiler", angle="radian", autolimits="true", meshdir=MESHES)
    SubElement(model, "option", integrator="implicitfast", gravity=f"0 0 {-GRAVITY}")
    _add_defaults(SubElement(model, "default"))
    _add_assets(SubElement(model, "asset"), files.values())
    world = SubElement(model, "worldbody")
    SubElement(world, "light", pos="0 0 3", dir="0 0 -1", directional="true")
    bodies = {robot.root: _add_body(world, robot.links[robot.root], np.zeros(3), None, files)}
    for joint in robot.joints:
        parent, child = bodies[joint.parent], robot.links[joint.child]
        bodies[joint.child] = _add_body(parent, child, robot.offset(joint), joint, files)
    contact = SubElement(model, "contact")
    for a, b in robot.uncollided:
        SubElement(contact, "exclude", body1=a, body2=b)
    equality = SubElement(model, "equality")
    for freedom in robot.freedoms:
        if freedom.mimic is not None:
            _add_following(equality, freedom.name, *freedom.mimic)
    for loop in robot.loops:
        _add_loop(equality, bodies[loop.parent], loop, robot)
    actuator = SubElement(model, "actuator")
    for joint in robot.joints:
        for freedom in joint.freedoms:
            if freedom.mimic is None:
                _add_actuator(actuator, freedom, load(robot, joint, freedom))
    ElementTree.indent(model)
    path = folder / f"{robot.name}.xml"
    ElementTree.ElementTree(model).write(path, encoding="utf-8", xml_declaration=True)
    return path


def _text(numbers: Iterable[float]) -> str:
    return " ".join(repr(float(x)) for x in numbers)


def _add_defaults(default: Element) -> None:
    SubElement(
        default,
        "joint",
        damping=str(DAMPING),
        frictionloss=str(FRICTION),
        armature=str(ARMATURE),
        solreflimit="0.01 1",
    )
    visual = SubElement(default, "default", {"class": "visual"})
    SubElement(visual, "geom", type="mesh", contype="0", conaffinity="0", group="2")
    collision = SubElement(default, "default", {"class": "collision"})
    SubElement(collision, "geom", type="mesh", group="3")


def _add_assets(asset: Element, files: Iterable[MeshFiles]) -> None:
    for link in files:
        # The surface may be open or thin, and its inertia is not asked for.
        if link.surface is not None:
            SubElement(asset, "mesh", name=Path(link.surface).stem, file=link.surface, inertia="shell")
        for piece in link.pieces:
            SubElement(asset, "mesh", name=Path(piece).stem, file=piece, inertia="shell")


def _add_body(parent: Element, link: Link, offset: np.ndarray, joint: Joint | None, files: dict) -> Element:
    body = SubElement(parent, "body", name=link.name, pos=_text(offset))
    _add_inertia(body, link.inertia)
    for freedom in joint.freedoms if joint is not None else ():
        kind = {"revolute": "hinge", "prismatic": "slide"}[freedom.type]
        # What follows another is held by its equality alone, and that other has the limits.
        limits = {"range": _text(freedom.limits)} if freedom.mimic is None else {}
        SubElement(body, "joint", name=freedom.name, type=kind, axis=_text(freedom.axis), **limits)
    meshes = files[link.name]
    if meshes.surface is not None:
        attributes = {"class": "visual", "mesh": Path(meshes.surface).stem, "rgba": _text(link.colour)}
        SubElement(body, "geom", attributes)
    for piece in meshes.pieces:
        SubElement(body, "geom", {"class": "collision", "mesh": Path(piece).stem})
    return body


def _add_inertia(body: Element, inertia: Inertia) -> None:
    six = inertia.tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    SubElement(body, "inertial", pos=_text(inertia.centre), mass=repr(inertia.mass), fullinertia=_text(six))


def _add_following(equality: Element, follower: str, leader: str, factor: float) -> None:
    """A joint that follows another, stiffly: it carries all the load along a screw."""
    stiff = {"solref": "0.005 1", "solimp": "0.99 0.999 0.001"}
    SubElement(equality, "joint", joint1=follower, joint2=leader, polycoef=_text([0, factor, 0, 0, 0]), **stiff)


def _add_loop(equality: Element, parent: Element, loop: Loop, robot: Robot) -> None:
    """Hold a point for a spherical joint, two points of the axis for a revolute one, all of it for a fixed one.

    MuJoCo has no constraint that lets bodies slide: there a small body slides on the parent, and the child is fixed to
    that. A dot in a name keeps it apart from identifiers.
    """
    bodies = {"body1": loop.parent, "body2": loop.child}
    anchor = loop.origin - robot.links[loop.parent].origin
    match loop.type:
        case "fixed":
            SubElement(equality, "weld", name=loop.name, **bodies)
        case "spherical":
            SubElement(equality, "connect", name=loop.name, anchor=_text(anchor), **bodies)
        case "revolute":
            SubElement(equality, "connect", name=loop.name, anchor=_text(anchor), **bodies)
            second = anchor + robot.size / 8 * loop.axis
            SubElement(equality, "connect", anchor=_text(second), **bodies)
        case "prismatic" | "screw" | "cylindrical":
            carrier = SubElement(parent, "body", name=f"{loop.name}.carrier", pos=_text(anchor))
            _add_inertia(carrier, between(robot.links[loop.child].inertia))
            turn, slide = f"{loop.name}.turn", f"{loop.name}.slide"
            SubElement(carrier, "joint", name=slide, type="slide", axis=_text(loop.axis))
            if loop.type != "prismatic":
                SubElement(carrier, "joint", name=turn, type="hinge", axis=_text(loop.axis))
            if loop.type == "screw":
                _add_following(equality, slide, turn, loop.pitch)
            SubElement(equality, "weld", name=loop.name, body1=f"{loop.name}.carrier", body2=loop.child)


def _add_actuator(actuator: Element, freedom: Freedom, load: Load) -> None:
    """A position actuator with critical damping, were the links behind it one body.

    MuJoCo's own `dampratio` takes them for loose, which is far too little damping behind a light link.
    """
    stiffness = load.stiffness(freedom)
    damping = 2 * math.sqrt(stiffness * load.inertia)
    SubElement(
        actuator, "position", name=freedom.name, joint=freedom.name, kp=repr(stiffness), kv=repr(damping),
        ctrlrange=_text(freedom.limits), forcerange=_text([-load.effort, load.effort]),
    )  # fmt: skip
