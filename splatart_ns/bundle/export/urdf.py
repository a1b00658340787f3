"""The object as a URDF, which ROS and nearly every robot simulator read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh.transformations as tra
import yourdfpy
from lxml import etree

from splatart_ns.bundle.export.inertia import between
from splatart_ns.bundle.export.loads import load
from splatart_ns.bundle.export.meshes import MESHES, MeshFiles, write_meshes
from splatart_ns.bundle.export.robot import DAMPING, FRICTION, VELOCITY, Inertia, Joint, Link, Robot


def write_urdf(robot: Robot, folder: Path) -> Path:
    """Write `<name>.urdf` and its meshes. The root is the base link; loops, which URDF has not, are left out."""
    files = write_meshes(robot, folder)
    links = [_link(link, files[link.name]) for link in robot.links.values()]
    joints = []
    for joint in robot.joints:
        links += [yourdfpy.Link(name, _inertial(between(robot.links[joint.child].inertia))) for name in joint.between]
        joints += _joints(robot, joint)
    model = yourdfpy.Robot(robot.name, links, joints)
    keep = str  # file names as they are
    tree = yourdfpy.URDF(model, build_scene_graph=False, load_meshes=False, filename_handler=keep).write_xml()
    _add_mimics(tree, robot)
    _add_mujoco(tree)
    path = folder / f"{robot.name}.urdf"
    with path.open("wb") as file:  # lxml would take a name with '%' for a URI
        tree.write(file, xml_declaration=True, encoding="utf-8", pretty_print=True)
    return path


def _link(link: Link, files: MeshFiles) -> yourdfpy.Link:
    visuals = []
    if files.surface is not None:
        colour = yourdfpy.Material(f"{link.name}_colour", yourdfpy.Color(link.colour))
        visuals.append(yourdfpy.Visual(geometry=_mesh(files.surface), origin=np.eye(4), material=colour))
    collisions = [yourdfpy.Collision(f"{link.name}_{i}", np.eye(4), _mesh(f)) for i, f in enumerate(files.pieces)]
    return yourdfpy.Link(link.name, _inertial(link.inertia), visuals, collisions)


def _mesh(file: str) -> yourdfpy.Geometry:
    return yourdfpy.Geometry(mesh=yourdfpy.Mesh(f"{MESHES}/{file}"))


def _inertial(inertia: Inertia) -> yourdfpy.Inertial:
    return yourdfpy.Inertial(tra.translation_matrix(inertia.centre), inertia.mass, inertia.tensor)


def _joints(robot: Robot, joint: Joint) -> list[yourdfpy.Joint]:
    """A joint per freedom, the first of which is at the link's origin, where the others are too."""
    T = tra.translation_matrix(robot.offset(joint))
    if not joint.freedoms:
        return [yourdfpy.Joint(joint.name, "fixed", joint.parent, joint.child, T)]
    links = [joint.parent, *joint.between, joint.child]
    joints = []
    for freedom, parent, child in zip(joint.freedoms, links, links[1:], strict=False):
        limit = yourdfpy.Limit(load(robot, joint, freedom).effort, VELOCITY, *freedom.limits)
        dynamics = yourdfpy.Dynamics(DAMPING, FRICTION)
        joints.append(yourdfpy.Joint(freedom.name, freedom.type, parent, child, T, freedom.axis, dynamics, limit))
        T = np.eye(4)
    return joints


def _add_mimics(tree: etree._ElementTree, robot: Robot) -> None:
    """yourdfpy reads <mimic> but does not write it."""
    elements = {element.get("name"): element for element in tree.getroot().findall("joint")}
    for f in robot.freedoms:
        if f.mimic is not None:
            leader, factor = f.mimic
            etree.SubElement(elements[f.name], "mimic", joint=leader, multiplier=repr(factor), offset="0.0")


def _add_mujoco(tree: etree._ElementTree) -> None:
    """What MuJoCo needs to read a URDF as it is meant; others skip the element."""
    compiler = {"meshdir": MESHES, "strippath": "true", "discardvisual": "false", "fusestatic": "false"}
    etree.SubElement(etree.SubElement(tree.getroot(), "mujoco"), "compiler", compiler)
