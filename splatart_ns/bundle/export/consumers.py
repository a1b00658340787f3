"""The programs that people open exports with, asked headless where each link is at given joint values.

Each class reads a file (raising what its library raises), and then gives T_root_link [4, 4] by link at values of all
freedoms. Libraries that are not installed raise ImportError.
"""

from __future__ import annotations

import json
import weakref
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh
import yourdfpy
from scipy.interpolate import interp1d
from scipy.spatial.transform import Rotation, Slerp

from splatart_ns.bundle.export.robot import Robot

Poses = dict[str, np.ndarray]


class YourdfpyModel:
    """A URDF in yourdfpy, with its visual and collision meshes."""

    def __init__(self, path: Path, robot: Robot):
        self._robot = robot
        self._urdf = yourdfpy.URDF.load(str(path), build_collision_scene_graph=True, load_collision_meshes=True)
        if not self._urdf.validate():
            raise ValueError("; ".join(str(error) for error in self._urdf.errors))

    def poses(self, values: Mapping[str, float]) -> Poses:
        # Joints that follow others are left to the file.
        own = {f.name: values[f.name] for f in self._robot.freedoms if f.mimic is None}
        self._urdf.update_cfg(own)
        return {name: self._urdf.get_transform(name, self._robot.root) for name in self._robot.links}


class MujocoModel:
    """A URDF or MJCF in MuJoCo."""

    def __init__(self, path: Path, robot: Robot):
        import mujoco

        self._robot, self._mujoco = robot, mujoco
        try:
            self.model = mujoco.MjModel.from_xml_path(str(path))
        except ValueError as error:
            if "volume is too small" not in str(error):
                raise
            mend = "give a larger --scale, or --format mjcf"
            raise ValueError(f"the object is too small for MuJoCo's URDF reader; {mend} ({error})") from error
        self.data = mujoco.MjData(self.model)

    def poses(self, values: Mapping[str, float]) -> Poses:
        for name, value in values.items():
            self.data.qpos[self.model.joint(name).qposadr[0]] = value
        self._mujoco.mj_kinematics(self.model, self.data)
        poses = {}
        for name in self._robot.links:
            body = self.data.body(name)
            poses[name] = _matrix(body.xpos, body.xmat.reshape(3, 3))
        return _from(poses, self._robot.root)


class PybulletModel:
    """A URDF in pybullet."""

    def __init__(self, path: Path, robot: Robot):
        import pybullet

        self._robot, self._pybullet = robot, pybullet
        self._client = pybullet.connect(pybullet.DIRECT)
        weakref.finalize(self, pybullet.disconnect, self._client)  # also where the file cannot be loaded
        self._body = pybullet.loadURDF(str(path), useFixedBase=True, physicsClientId=self._client)
        count = pybullet.getNumJoints(self._body, physicsClientId=self._client)
        infos = [pybullet.getJointInfo(self._body, i, physicsClientId=self._client) for i in range(count)]
        self._joints = {info[1].decode(): info[0] for info in infos}
        self._links = {info[12].decode(): info[0] for info in infos}

    def poses(self, values: Mapping[str, float]) -> Poses:
        client = {"physicsClientId": self._client}
        for name, value in values.items():
            self._pybullet.resetJointState(self._body, self._joints[name], value, **client)
        poses = {}
        for name in self._robot.links:
            if name == self._robot.root:
                # Of the base it gives the centre of mass alone.
                com, turn = self._pybullet.getBasePositionAndOrientation(self._body, **client)
                local = self._pybullet.getDynamicsInfo(self._body, -1, **client)[3:5]
                T = _matrix(com, Rotation.from_quat(turn).as_matrix())
                poses[name] = T @ np.linalg.inv(_matrix(local[0], Rotation.from_quat(local[1]).as_matrix()))
            else:
                state = self._pybullet.getLinkState(
                    self._body, self._links[name], computeForwardKinematics=True, **client
                )
                poses[name] = _matrix(state[4], Rotation.from_quat(state[5]).as_matrix())
        return _from(poses, self._robot.root)


class UsdModel:
    """A USD stage, posed by the frames, axes and limits of its UsdPhysics joints."""

    def __init__(self, path: Path, robot: Robot):
        from pxr import Usd, UsdPhysics

        self._robot = robot
        stage = Usd.Stage.Open(str(path))
        parsed = UsdPhysics.LoadUsdPhysicsFromRange(stage, [str(stage.GetDefaultPrim().GetPath())])
        bad = [
            str(p) for paths, objects in parsed.values() for p, o in zip(paths, objects, strict=True) if not o.isValid
        ]
        if bad:
            raise ValueError(f"UsdPhysics does not take {', '.join(bad)}")
        _run_usd_validators(stage)
        self._joints = []
        for prim in stage.Traverse():
            joint = UsdPhysics.Joint(prim)
            if prim.IsA(UsdPhysics.Joint) and not joint.GetExcludeFromArticulationAttr().Get():
                bodies = [
                    rel.GetTargets()[0].name if rel.GetTargets() else None
                    for rel in (joint.GetBody0Rel(), joint.GetBody1Rel())
                ]
                frames = [
                    _usd_frame(joint.GetLocalPos0Attr().Get(), joint.GetLocalRot0Attr().Get()),
                    _usd_frame(joint.GetLocalPos1Attr().Get(), joint.GetLocalRot1Attr().Get()),
                ]
                self._joints.append((prim.GetName(), prim.GetTypeName(), bodies, frames))

    def poses(self, values: Mapping[str, float]) -> Poses:
        poses = {None: np.eye(4)}
        waiting = list(self._joints)
        while waiting:
            ready = [j for j in waiting if j[2][0] in poses]
            if not ready:
                raise ValueError("joints do not hang together")
            for name, kind, (body0, body1), (frame0, frame1) in ready:
                T = np.eye(4)
                if kind == "PhysicsRevoluteJoint":
                    T[:3, :3] = Rotation.from_rotvec([values[name], 0, 0]).as_matrix()
                elif kind == "PhysicsPrismaticJoint":
                    T[0, 3] = values[name]
                poses[body1] = poses[body0] @ frame0 @ T @ np.linalg.inv(frame1)
            waiting = [j for j in waiting if j not in ready]
        return _from({name: poses[name] for name in self._robot.links}, self._robot.root)


class GlbModel:
    """A GLB in trimesh, posed by the freedoms in its nodes' extras."""

    def __init__(self, path: Path, robot: Robot):
        graph = trimesh.load_scene(path).graph
        self._root = robot.root
        self._nodes = []
        for child in (joint.child for joint in robot.joints):
            parent = graph.transforms.parents[child]
            extras = graph.transforms.edge_data[parent, child]["metadata"]
            self._nodes.append((child, parent, graph.get(child, parent)[0], extras["freedoms"]))

    def poses(self, values: Mapping[str, float]) -> Poses:
        poses = {self._root: np.eye(4)}
        for child, parent, rest, freedoms in self._nodes:
            T = poses[parent] @ rest
            for f in freedoms:
                value = values[f["name"]]
                if f["follows"] is not None:
                    value = f["follows"]["factor"] * values[f["follows"]["name"]]
                step = value * np.array(f["axis"])
                turns = f["type"] == "revolute"
                T = T @ (
                    _matrix(np.zeros(3), Rotation.from_rotvec(step).as_matrix()) if turns else _matrix(step, np.eye(3))
                )
            poses[child] = T
        return poses


class GlbAnimation:
    """The sweep in a GLB, played as a viewer plays it."""

    def __init__(self, path: Path, robot: Robot):
        data = path.read_bytes()
        length = int.from_bytes(data[12:16], "little")
        tree = json.loads(data[20 : 20 + length])
        buffer = data[28 + length :]
        self._robot = robot
        self._rest = {node["name"]: np.array(node.get("translation", [0, 0, 0]), float) for node in tree["nodes"]}
        self._shifts: dict[str, interp1d] = {}
        self._turns: dict[str, Slerp] = {}
        for animation in tree.get("animations", []):
            for channel in animation["channels"]:
                sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
                times, values = (_glb_values(tree, buffer, sampler[key]) for key in ("input", "output"))
                name = tree["nodes"][target["node"]]["name"]
                if target["path"] == "translation":
                    self._shifts[name] = interp1d(times, values, axis=0)
                else:
                    self._turns[name] = Slerp(times, Rotation.from_quat(values))

    def poses(self, time: float) -> Poses:
        poses = {self._robot.root: np.eye(4)}
        for joint in self._robot.joints:
            name = joint.child
            shift = self._shifts[name](time) if name in self._shifts else self._rest[name]
            turn = self._turns[name](time).as_matrix() if name in self._turns else np.eye(3)
            poses[name] = poses[joint.parent] @ _matrix(shift, turn)
        return poses


def _glb_values(tree: dict, buffer: bytes, accessor: int) -> np.ndarray:
    about = tree["accessors"][accessor]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[about["type"]]
    start = tree["bufferViews"][about["bufferView"]]["byteOffset"]
    values = np.frombuffer(buffer, "<f4", about["count"] * width, start).astype(float)
    return values if width == 1 else values.reshape(-1, width)


def _run_usd_validators(stage) -> None:
    try:
        from pxr import UsdValidation
    except ImportError:  # came with usd-core 24.11
        return
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    if errors := UsdValidation.ValidationContext(validators).Validate(stage):
        raise ValueError("; ".join(error.GetMessage() for error in errors))


def _matrix(position, R: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, position
    return T


def _usd_frame(position, quat) -> np.ndarray:
    x, y, z = quat.GetImaginary()
    return _matrix(position, Rotation.from_quat([x, y, z, quat.GetReal()]).as_matrix())


def _from(poses: Poses, root: str) -> Poses:
    """The poses seen from the root."""
    T_root_world = np.linalg.inv(poses[root])
    return {name: T_root_world @ T for name, T in poses.items()}
