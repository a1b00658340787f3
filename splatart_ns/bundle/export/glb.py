"""The object as one GLB file: a node per link, nested as the joints are, and an animation that sweeps every joint.

glTF has no joints: each node's `extras` tell the part, the joint's name and its freedoms (type, axis, limits, what they
follow), so that a program can pose the file. y is up, as glTF wants: the node about the root turns z there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from trimesh.exchange.gltf import export_glb

from splatart_ns.bundle.export.colour import linear_from_srgb
from splatart_ns.bundle.export.robot import Joint, Link, Robot

ANIMATION = "sweep"
_TOP = "z_up"  # the node in which z is up
_SECONDS, _KEYS = 3.0, 24  # of each freedom's way to both limits and back; keys at least
_KEYS_A_RADIAN = 4  # of the farther limit: between two keys a turn is then well below half a turn, the shorter way
_FARTHEST = 200 * np.pi  # radian, of the animation, whatever the limits are
_FLOAT = 5126
_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # z to y


def write_glb(robot: Robot, folder: Path) -> Path:
    """Write `<name>.glb`."""
    scene = trimesh.Scene(base_frame="world")
    top = np.eye(4)
    top[:3, :3] = _UP
    scene.graph.update(frame_to=_TOP, frame_from="world", matrix=top)
    parents = {robot.root: _TOP} | {joint.child: joint.parent for joint in robot.joints}
    for link in robot.links.values():
        offset = np.eye(4)
        if link.name != robot.root:
            offset[:3, 3] = link.origin - robot.links[parents[link.name]].origin
        geometry = None
        if link.surface is not None:
            geometry = f"{link.name}_surface"
            scene.geometry[geometry] = _for_gltf(link.surface)
        scene.graph.update(frame_to=link.name, frame_from=parents[link.name], matrix=offset, geometry=geometry)
    complete = partial(_complete, robot)
    data = export_glb(scene, include_normals=True, buffer_postprocessor=complete)
    path = folder / f"{robot.name}.glb"
    path.write_bytes(data)
    return path


def _for_gltf(surface: trimesh.Trimesh) -> trimesh.Trimesh:
    """With the vertex colours that glTF wants, which are of light, and normals of unit length throughout."""
    colours = surface.visual.vertex_colors.copy()
    colours[:, :3] = (255 * linear_from_srgb(colours[:, :3] / 255)).round()
    normals = surface.vertex_normals.copy()
    normals[np.linalg.norm(normals, axis=1) < 0.5] = [0, 0, 1]  # of triangles without an area
    return trimesh.Trimesh(surface.vertices, surface.faces, None, normals, vertex_colors=colours, process=False)


def _complete(robot: Robot, buffers: dict[str, bytes], tree: dict[str, Any]) -> None:
    """Add what trimesh does not write: extras, a material for coloured vertices, the animation."""
    nodes = {node["name"]: node for node in tree["nodes"]}
    tree["materials"] = [
        {
            "name": "vertex_colours",
            "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9},
            "doubleSided": True,
        }
    ]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
    nodes[robot.root]["extras"] = {"part": robot.links[robot.root].part}
    for joint in robot.joints:
        nodes[joint.child]["extras"] = _extras(robot.links[joint.child], joint)
        # A node that an animation moves has translation and rotation in the place of a matrix.
        nodes[joint.child].pop("matrix", None)
        nodes[joint.child]["translation"] = robot.offset(joint).tolist()
    if robot.freedoms:
        indices = {node["name"]: i for i, node in enumerate(tree["nodes"])}
        tree["animations"] = [_animation(robot, indices, buffers, tree["accessors"])]


def _extras(link: Link, joint: Joint) -> dict[str, Any]:
    return {
        "part": link.part,
        "joint": joint.name,
        "freedoms": [
            {
                "name": f.name,
                "type": f.type,
                "axis": f.axis.tolist(),
                "limits": list(f.limits),
                "follows": None if f.mimic is None else {"name": f.mimic[0], "factor": f.mimic[1]},
            }
            for f in joint.freedoms
        ],
    }


def sweep(robot: Robot) -> tuple[np.ndarray, list[dict[str, float]]]:
    """Times [K] in seconds, as float32 has them, and the values of all freedoms at them.

    One freedom after the other goes to both its limits, or a hundred turns, and back.
    """
    leaders = [f for f in robot.freedoms if f.mimic is None]
    times, values = [0.0], [robot.complete({})]
    for n, f in enumerate(leaders):
        low, high, keys = *f.limits, _KEYS
        if f.type == "revolute":
            low, high = max(low, -_FARTHEST), min(high, _FARTHEST)
            keys = max(keys, math.ceil(_KEYS_A_RADIAN * max(-low, high)))
        for k in range(1, keys + 1):
            s = np.sin(2 * np.pi * k / keys)
            times.append(_SECONDS * (n + k / keys))
            values.append(robot.complete({f.name: max(high, 0.0) * max(s, 0.0) + min(low, 0.0) * max(-s, 0.0)}))
    return np.array(times, np.float32).astype(float), values


def local_motion(joint: Joint, values: Mapping[str, float]) -> tuple[np.ndarray, Rotation]:
    """How far [3], in the parent's frame, and which way a joint's freedoms move the child from rest."""
    shift, turn = np.zeros(3), Rotation.identity()
    for f in joint.freedoms:
        if f.type == "prismatic":
            shift = shift + turn.apply(values[f.name] * f.axis)
        else:
            turn = turn * Rotation.from_rotvec(values[f.name] * f.axis)
    return shift, turn


def _animation(robot: Robot, indices: Mapping[str, int], buffers: dict, accessors: dict) -> dict[str, Any]:
    times, configurations = sweep(robot)
    time = _accessor("time", times, "SCALAR", buffers, accessors)
    channels, samplers = [], []
    for joint in robot.joints:
        motions = [local_motion(joint, values) for values in configurations]
        tracks = {}
        if any(f.type == "prismatic" for f in joint.freedoms):
            tracks["translation"] = np.array([robot.offset(joint) + shift for shift, _ in motions]), "VEC3"
        if any(f.type == "revolute" for f in joint.freedoms):
            tracks["rotation"] = np.array([turn.as_quat(canonical=True) for _, turn in motions]), "VEC4"
        for path, (track, kind) in tracks.items():
            output = _accessor(f"{joint.name} {path}", track, kind, buffers, accessors)
            channels.append({"sampler": len(samplers), "target": {"node": indices[joint.child], "path": path}})
            samplers.append({"input": time, "output": output, "interpolation": "LINEAR"})
    return {"name": ANIMATION, "channels": channels, "samplers": samplers}


def _accessor(key: str, values: np.ndarray, kind: str, buffers: dict, accessors: dict) -> int:
    """Append float32 values to the buffer; the new accessor's index."""
    values = np.ascontiguousarray(values, "<f4")
    buffers[key] = values.tobytes()
    accessor = {"bufferView": len(buffers) - 1, "componentType": _FLOAT, "count": len(values), "type": kind}
    rows = values.reshape(len(values), -1)
    accessors[key] = accessor | {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
    return len(accessors) - 1
