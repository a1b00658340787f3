"""What a synthetic capture shows: a robot's parts in each of its states, and the truth about them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from splatart_ns.capture.images import MAX_LABEL
from splatart_ns.capture.robot import Part, Robot
from splatart_ns.capture.surface import Surface
from splatart_ns.errors import InputError

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_MARGIN = 1.05
"""Room about the object's bounding sphere in the image."""


@dataclass(frozen=True)
class Scene:
    """What is rendered, and where it is in each state."""

    robot: Robot
    frozen: dict[str, float]
    parts: tuple[Part, ...]
    ids: dict[str, int]
    """Part name to id, of the parts that have a shape."""
    surfaces: dict[int, Surface]
    """Part id to the part's surface in its own frame."""
    configurations: list[dict[str, float]]
    novel: dict[str, float]
    centre: np.ndarray
    """[3]: of the box about all states."""
    radius: float
    """Of the sphere about the centre that holds all states."""

    @staticmethod
    def of(
        robot: Robot,
        frozen: dict[str, float],
        surfaces: Mapping[str, Surface],
        configurations: list[dict[str, float]],
    ) -> Scene:
        """`surfaces` are those of `part_surfaces`."""
        parts = robot.parts(frozen)
        ids = {name: i for i, name in enumerate(surfaces, start=1)}
        novel = robot.halfway(*configurations[:2])

        points = []
        for values in (*configurations, novel):
            poses = robot.link_poses(values)
            for part in (p for p in parts if p.name in ids):
                T, corners = poses[part.frame_link], surfaces[part.name].triangles.reshape(-1, 3)
                points.append(corners @ T[:3, :3].T + T[:3, 3])
        points = np.concatenate(points)
        centre = np.round(0.5 * (points.min(axis=0) + points.max(axis=0)), 9)
        radius = float(np.linalg.norm(points - centre, axis=-1).max())
        by_id = {ids[name]: surface for name, surface in surfaces.items()}
        return Scene(robot, frozen, parts, ids, by_id, configurations, novel, centre, radius)

    def part_poses(self, values: Mapping[str, float]) -> dict[str, np.ndarray]:
        """T_world_part [4, 4] by part name."""
        poses = self.robot.link_poses(values)
        return {p.name: poses[p.frame_link] for p in self.parts}

    def placed(self, values: Mapping[str, float]) -> dict[int, Surface]:
        """Part id to surface in the world."""
        poses = self.part_poses(values)
        return {i: self.surfaces[i].moved(poses[name]) for name, i in self.ids.items()}

    def camera_distance(self, fov_degrees: float) -> float:
        """From the centre to a camera that sees all of the bounding sphere."""
        return _MARGIN * self.radius / math.sin(math.radians(0.5 * fov_degrees))


def part_surfaces(robot: Robot, frozen: Mapping[str, float]) -> dict[str, Surface]:
    """Part name to its surface in its own frame, of the parts that have a shape.

    Raises:
        InputError: there is none, or more than labels have room for; a mesh that cannot be read.
    """
    shaped = [part for part in robot.parts(frozen) if part.has_geometry]
    if not shaped:
        raise InputError(f"{robot.path}: no link has a <visual> that shows anything; there is nothing to render.")
    if len(shaped) > MAX_LABEL:
        found = f"has {len(shaped)} parts; labels have room for {MAX_LABEL}"
        raise InputError(f"{robot.path}: {found}, freeze some joints.")
    return {part.name: robot.surface(part, frozen) for part in shaped}


def camera_poses(count: int, centre: np.ndarray, distance: float, views: str, rng: np.random.Generator) -> np.ndarray:
    """Cameras [count, 4, 4] (OpenGL camera-to-world) that look at the centre, z up: a jittered Fibonacci lattice."""
    place = (np.arange(count) + rng.uniform(0.25, 0.75, count)) / max(count, 1)
    z = 1.0 - (place if views == "hemisphere" else 2.0 * place)
    spacing = math.sqrt(4.0 * math.pi / max(count, 1))
    azimuth = np.arange(count) * _GOLDEN_ANGLE + rng.uniform(0.0, 2.0 * math.pi)
    azimuth += rng.uniform(-0.15, 0.15, count) * spacing
    across = np.sqrt(1.0 - z**2)
    back = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=-1)
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(count)], axis=-1)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2] = right, np.cross(back, right), back
    T[:, :3, 3] = centre + distance * back
    return np.round(T, 9)


def ground_truth(scene: Scene, fov_degrees: float, resolution: int, length_unit: str, points_per_part: int) -> dict:
    """The content of ground_truth.json."""
    robot, start = scene.robot, scene.part_poses(scene.configurations[0])
    index = {p.name: i for i, p in enumerate(scene.parts)}
    part_of = {link: p.name for p in scene.parts for link in p.links}
    link_poses = robot.link_poses(scene.configurations[0])

    def motion(values: Mapping[str, float]) -> dict[str, list]:
        poses = scene.part_poses(values)
        return {name: _rounded(poses[name] @ np.linalg.inv(start[name])) for name in poses}

    joints = []
    for joint in robot.movable:
        if joint.name in scene.frozen:
            continue
        T_world_joint = link_poses[joint.parent] @ joint.T_parent_joint
        parent, child = part_of[joint.parent], part_of[joint.child]
        mimic = joint.mimic and {
            "joint": joint.mimic.joint,
            "multiplier": joint.mimic.multiplier,
            "offset": joint.mimic.offset,
        }
        joints.append(
            {
                "name": joint.name,
                "type": joint.type,
                "parent": parent,
                "child": child,
                "parent_id": scene.ids.get(parent),
                "child_id": scene.ids.get(child),
                "parent_index": index[parent],
                "child_index": index[child],
                "axis": _rounded(T_world_joint[:3, :3] @ joint.axis),
                "origin": _rounded(T_world_joint[:3, 3]),
                "limits": joint.limits and list(joint.limits),
                "mimic": mimic,
                "values": [values[joint.name] for values in scene.configurations],
            }
        )

    def moving(values: Mapping[str, float]) -> dict[str, float]:
        return {name: v for name, v in values.items() if name not in scene.frozen}

    return {
        "format": "articulated-ground-truth-1",
        "source": {"urdf": robot.path.name, "robot_name": robot.name, "frozen_joints": scene.frozen},
        "units": {
            "length": length_unit,
            "angle": "radian",
            "poses": "4x4, part frame to world frame",
            "joint_axis_and_origin": "world frame, at state 0",
        },
        "world_frame": "frame of the URDF root link; z is up",
        "segmentation": {"background": 0, "part_ids": {str(i): name for name, i in scene.ids.items()}},
        "parts": [
            {
                "index": index[p.name],
                "id": scene.ids.get(p.name),
                "name": p.name,
                "has_geometry": p.has_geometry,
                "root": index[p.name] == 0,
                "frame_link": p.frame_link,
                "links": list(p.links),
            }
            for p in scene.parts
        ],
        "joints": joints,
        "states": [
            {
                "index": k,
                "folder": f"state_{k:02d}",
                "joint_values": moving(values),
                "part_poses": {name: _rounded(T) for name, T in scene.part_poses(values).items()},
                "motion_from_state_0": motion(values),
            }
            for k, values in enumerate(scene.configurations)
        ],
        "cameras": {
            "model": "pinhole",
            "convention": "OpenGL camera-to-world (x right, y up, looks along -z); pixel centres at +0.5",
            "look_at": scene.centre.tolist(),
            "radius": scene.camera_distance(fov_degrees),
            "fov_degrees": fov_degrees,
            "resolution": resolution,
            "object_bounding_radius": scene.radius,
        },
        "novel": [
            {
                "folder": "eval/novel_00",
                "joint_values": moving(scene.novel),
                "motion_from_state_0": motion(scene.novel),
            }
        ],
        "points": f"ground_truth_points/part_<id>.ply: {points_per_part} points a part, sampled by area, at state 0",
    }


def _rounded(values: np.ndarray) -> list:
    return (np.round(values, 9) + 0.0).tolist()
