"""The object as USD with UsdPhysics: rigid bodies, joints with limits and damping, convex collision."""

from __future__ import annotations

import errno
import math
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from splatart_ns.bundle.export.colour import linear_from_srgb
from splatart_ns.bundle.export.inertia import between
from splatart_ns.bundle.export.loads import load
from splatart_ns.bundle.export.robot import DAMPING, GRAVITY, Freedom, Inertia, Joint, Link, Loop, Robot

STATIC_FRICTION, DYNAMIC_FRICTION = 0.8, 0.6
"""Between surfaces."""


def write_usd(robot: Robot, folder: Path) -> Path:
    """Write `<name>.usd`: metres, z up, the root fixed to the world; loops are left out of the articulation."""
    from pxr import Tf, Usd

    path = folder / f"{robot.name}.usd"
    stage = Usd.Stage.CreateNew(str(path))
    _Writer(stage, robot).write()
    try:
        stage.Save()
    except Tf.ErrorException as error:
        raise OSError(errno.EIO, "usd-core could not save it", str(path)) from error
    return path


class _Writer:
    """A stage that is being filled."""

    def __init__(self, stage, robot: Robot):
        from pxr import Gf, UsdGeom, UsdPhysics

        self.stage, self.robot = stage, robot
        self.gf, self.geom, self.physics = Gf, UsdGeom, UsdPhysics
        self.top = f"/{robot.name}"

    def write(self) -> None:
        self.geom.SetStageUpAxis(self.stage, self.geom.Tokens.z)
        self.geom.SetStageMetersPerUnit(self.stage, 1.0)
        self.physics.SetStageKilogramsPerUnit(self.stage, 1.0)
        top = self.geom.Xform.Define(self.stage, self.top)
        self.stage.SetDefaultPrim(top.GetPrim())
        scene = self.physics.Scene.Define(self.stage, f"{self.top}/scene")
        scene.CreateGravityDirectionAttr(self.gf.Vec3f(0, 0, -1))
        scene.CreateGravityMagnitudeAttr(GRAVITY)
        self.add_material()
        for link in self.robot.links.values():
            self.add_link(link)
        self.geom.Scope.Define(self.stage, f"{self.top}/joints")
        self.fix_root()
        for joint in self.robot.joints:
            self.add_joint(joint)
        for loop in self.robot.loops:
            self.add_loop(loop)
        for a, b in self.robot.uncollided:
            filtered = self.physics.FilteredPairsAPI.Apply(self.stage.GetPrimAtPath(self.path(a)))
            filtered.CreateFilteredPairsRel().AddTarget(self.path(b))

    def path(self, link: str) -> str:
        return f"{self.top}/{link}"

    def add_material(self) -> None:
        from pxr import UsdShade

        self.material = UsdShade.Material.Define(self.stage, f"{self.top}/material")
        friction = self.physics.MaterialAPI.Apply(self.material.GetPrim())
        friction.CreateStaticFrictionAttr(STATIC_FRICTION)
        friction.CreateDynamicFrictionAttr(DYNAMIC_FRICTION)

    def add_body(self, name: str, origin: np.ndarray, inertia: Inertia) -> None:
        xform = self.geom.Xform.Define(self.stage, self.path(name))
        xform.AddTranslateOp(self.geom.XformOp.PrecisionDouble).Set(self.gf.Vec3d(*origin.tolist()))
        xform.AddOrientOp(self.geom.XformOp.PrecisionDouble).Set(self.gf.Quatd(1.0))
        self.physics.RigidBodyAPI.Apply(xform.GetPrim())
        mass = self.physics.MassAPI.Apply(xform.GetPrim())
        moments, axes = np.linalg.eigh(inertia.tensor)
        axes[:, 2] *= np.linalg.det(axes)
        mass.CreateMassAttr(inertia.mass)
        mass.CreateCenterOfMassAttr(self.gf.Vec3f(*inertia.centre.tolist()))
        mass.CreateDiagonalInertiaAttr(self.gf.Vec3f(*moments.tolist()))
        mass.CreatePrincipalAxesAttr(self.quat(axes))

    def add_link(self, link: Link) -> None:
        from pxr import UsdShade

        self.add_body(link.name, link.origin, link.inertia)
        if link.surface is not None:
            visual = self.add_mesh(f"{self.path(link.name)}/visual", link.surface)
            colours = link.surface.visual.vertex_colors[:, :3] / 255
            # displayColor is linear, colours of images are sRGB.
            primvar = visual.CreateDisplayColorPrimvar(self.geom.Tokens.vertex)
            primvar.Set(linear_from_srgb(colours).astype(np.float32))
        for i, piece in enumerate(link.pieces):
            mesh = self.add_mesh(f"{self.path(link.name)}/collision_{i}", piece)
            mesh.CreatePurposeAttr(self.geom.Tokens.guide)
            self.physics.CollisionAPI.Apply(mesh.GetPrim())
            self.physics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr("convexHull")
            binding = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
            binding.Bind(self.material, UsdShade.Tokens.weakerThanDescendants, "physics")

    def add_mesh(self, path: str, mesh: trimesh.Trimesh):
        out = self.geom.Mesh.Define(self.stage, path)
        out.CreatePointsAttr(np.asarray(mesh.vertices, np.float32))
        out.CreateFaceVertexCountsAttr(np.full(len(mesh.faces), 3, np.int32))
        out.CreateFaceVertexIndicesAttr(np.asarray(mesh.faces, np.int32).reshape(-1))
        out.CreateExtentAttr(np.asarray(mesh.bounds, np.float32))
        out.CreateSubdivisionSchemeAttr(self.geom.Tokens.none)
        out.CreateDoubleSidedAttr(True)
        return out

    def fix_root(self) -> None:
        joint = self.physics.FixedJoint.Define(self.stage, f"{self.top}/joints/world")
        joint.CreateBody1Rel().SetTargets([self.path(self.robot.root)])
        self.physics.ArticulationRootAPI.Apply(joint.GetPrim())

    def add_joint(self, joint: Joint) -> None:
        """A joint per freedom, with small links between them."""
        moved = self.robot.links[joint.child]
        for name in joint.between:
            self.add_body(name, moved.origin, between(moved.inertia))
        offset = self.robot.offset(joint)
        if not joint.freedoms:
            fixed = self.physics.FixedJoint.Define(self.stage, f"{self.top}/joints/{joint.name}")
            self.connect(fixed, joint.parent, joint.child, offset, np.zeros(3), np.eye(3))
        links = [joint.parent, *joint.between, joint.child]
        for freedom, parent, child in zip(joint.freedoms, links, links[1:], strict=False):
            effort = load(self.robot, joint, freedom).effort
            self.add_freedom(freedom, parent, child, offset, effort)
            offset = np.zeros(3)

    def add_freedom(self, freedom: Freedom, parent: str, child: str, offset: np.ndarray, effort: float) -> None:
        turns = freedom.type == "revolute"
        kind = self.physics.RevoluteJoint if turns else self.physics.PrismaticJoint
        joint = kind.Define(self.stage, f"{self.top}/joints/{freedom.name}")
        self.connect(joint, parent, child, offset, np.zeros(3), _frame_of(freedom.axis))
        joint.CreateAxisAttr(self.geom.Tokens.x)
        low, high = np.degrees(freedom.limits) if turns else freedom.limits
        joint.CreateLowerLimitAttr(float(low))
        joint.CreateUpperLimitAttr(float(high))
        drive = self.physics.DriveAPI.Apply(joint.GetPrim(), "angular" if turns else "linear")
        drive.CreateTypeAttr("force")
        drive.CreateStiffnessAttr(0.0)
        drive.CreateDampingAttr(DAMPING * math.pi / 180 if turns else DAMPING)  # angular drives are in degrees
        drive.CreateMaxForceAttr(effort)

    def add_loop(self, loop: Loop) -> None:
        """A joint outside the articulation: its own kind, or a general one with the other directions locked."""
        if loop.type == "free":
            return
        kinds = {
            "fixed": self.physics.FixedJoint,
            "revolute": self.physics.RevoluteJoint,
            "prismatic": self.physics.PrismaticJoint,
            "spherical": self.physics.SphericalJoint,
        }
        joint = kinds.get(loop.type, self.physics.Joint).Define(self.stage, f"{self.top}/joints/{loop.name}")
        anchors = [loop.origin - self.robot.links[name].origin for name in (loop.parent, loop.child)]
        self.connect(joint, loop.parent, loop.child, *anchors, _frame_of(loop.axis))
        joint.CreateExcludeFromArticulationAttr(True)
        if loop.type in ("revolute", "prismatic", "spherical"):
            joint.CreateAxisAttr(self.geom.Tokens.x)
        if loop.type in ("screw", "cylindrical"):
            for direction in ("transY", "transZ", "rotY", "rotZ"):
                limit = self.physics.LimitAPI.Apply(joint.GetPrim(), direction)
                limit.CreateLowAttr(1.0)  # lower above upper locks
                limit.CreateHighAttr(-1.0)

    def connect(self, joint, parent: str, child: str, p0: np.ndarray, p1: np.ndarray, R: np.ndarray) -> None:
        """The joint's frame in both bodies: at `p0` [3] and `p1` [3], turned by `R` [3, 3]."""
        joint.CreateBody0Rel().SetTargets([self.path(parent)])
        joint.CreateBody1Rel().SetTargets([self.path(child)])
        joint.CreateLocalPos0Attr(self.gf.Vec3f(*p0.tolist()))
        joint.CreateLocalPos1Attr(self.gf.Vec3f(*p1.tolist()))
        joint.CreateLocalRot0Attr(self.quat(R))
        joint.CreateLocalRot1Attr(self.quat(R))

    def quat(self, R: np.ndarray):
        x, y, z, w = Rotation.from_matrix(R).as_quat().tolist()
        return self.gf.Quatf(w, x, y, z)


def _frame_of(axis: np.ndarray) -> np.ndarray:
    """A rotation [3, 3] whose first column is the unit vector `axis`."""
    helper = np.eye(3)[np.abs(axis).argmin()]
    y = np.cross(axis, helper)
    y /= np.linalg.norm(y)
    return np.stack([axis, y, np.cross(axis, y)], axis=1)
