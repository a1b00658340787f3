"""A URDF as data: links, joints, shapes, and where they are at given joint values."""

from __future__ import annotations

import logging
import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from splatart_ns.capture import meshes
from splatart_ns.capture.surface import Surface, join, merge_coincident
from splatart_ns.capture.values import LONGEST, show
from splatart_ns.errors import InputError

_log = logging.getLogger(__name__)

MOVABLE = ("revolute", "continuous", "prismatic")
_MOST_BYTES, _MOST_LINKS = 64 << 20, 10_000


@dataclass(frozen=True)
class Mimic:
    """A joint's value as multiplier * (the other joint's value) + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """How a link hangs on its parent."""

    name: str
    type: str
    """"revolute", "continuous", "prismatic" or "fixed"."""
    parent: str
    child: str
    T_parent_joint: np.ndarray
    """[4, 4]: the joint's frame, and the child's at value 0, in the parent link's frame."""
    axis: np.ndarray
    """[3], unit length, in the joint's frame."""
    limits: tuple[float, float] | None
    mimic: Mimic | None

    def motion(self, value: float) -> np.ndarray:
        """T_joint_child [4, 4] at a value in radian or length."""
        T = np.eye(4)
        if self.type in ("revolute", "continuous"):
            T[:3, :3] = Rotation.from_rotvec(value * self.axis).as_matrix()
        elif self.type == "prismatic":
            T[:3, 3] = value * self.axis
        return T


@dataclass(frozen=True)
class Part:
    """Links that hold together rigidly."""

    name: str
    """The first of the links that has a shape, else the first link."""
    links: tuple[str, ...]
    """The first one is the link whose frame is the part's frame."""
    has_geometry: bool

    @property
    def frame_link(self) -> str:
        return self.links[0]


@dataclass(frozen=True)
class Robot:
    """A tree of links and joints, as a URDF tells it."""

    path: Path
    name: str
    links: dict[str, tuple[ElementTree.Element, ...]]
    """Link name to its <visual> elements that show anything."""
    joints: tuple[Joint, ...]
    root: str

    @property
    def movable(self) -> tuple[Joint, ...]:
        return tuple(j for j in self.joints if j.type in MOVABLE)

    def joint(self, name: str) -> Joint:
        for joint in self.movable:
            if joint.name == name:
                return joint
        known = ", ".join(j.name for j in self.movable) or "none"
        raise InputError(f"{self.path}: there is no movable joint {name!r}; the movable joints are: {known}.")

    def complete(self, values: Mapping[str, float]) -> dict[str, float]:
        """A value for every movable joint: those given, 0 (or the limit next to it) for others, mimics computed."""
        out: dict[str, float] = {}
        for joint in self.movable:
            low, high = joint.limits or (-math.inf, math.inf)
            out[joint.name] = float(values.get(joint.name, min(max(0.0, low), high)))
        # A mimic may follow a mimic, but none itself.
        mimics = [joint for joint in self.movable if joint.mimic is not None]
        for _ in mimics:
            before = dict(out)
            for joint in mimics:
                out[joint.name] = joint.mimic.multiplier * out[joint.mimic.joint] + joint.mimic.offset
            if out == before:
                break
        return out

    def halfway(self, first: Mapping[str, float], second: Mapping[str, float]) -> dict[str, float]:
        """The values of all movable joints in the middle between two configurations."""
        return self.complete({name: 0.5 * (first[name] + second[name]) for name in first})

    def link_poses(self, values: Mapping[str, float]) -> dict[str, np.ndarray]:
        """T_world_link [4, 4] of every link; the world is the root link's frame."""
        values = self.complete(values)
        poses = {self.root: np.eye(4)}
        children = _children(self.joints)
        queue = [self.root]
        while queue:
            link = queue.pop(0)
            for joint in children.get(link, ()):
                poses[joint.child] = poses[link] @ joint.T_parent_joint @ joint.motion(values.get(joint.name, 0.0))
                queue.append(joint.child)
        return poses

    def parts(self, frozen: Mapping[str, float] | None = None) -> tuple[Part, ...]:
        """Links grouped by fixed and frozen joints: the root's part first, then down the tree in the file's order."""
        held = frozen or {}
        children = _children(self.joints)
        parts, roots = [], [self.root]
        while roots:
            links, queue = [], [roots.pop(0)]
            while queue:
                link = queue.pop(0)
                links.append(link)
                for joint in children.get(link, ()):
                    moves = joint.type in MOVABLE and joint.name not in held
                    (roots if moves else queue).append(joint.child)
            shaped = [link for link in links if self.links[link]]
            parts.append(Part((shaped or links)[0], tuple(links), bool(shaped)))
        return tuple(parts)

    def hinges(self, frozen: Mapping[str, float]) -> dict[str, tuple[str | None, tuple[Joint, ...]]]:
        """Each part that has a shape to the next above it that has one, None where none has, and the joints between."""
        parts = self.parts(frozen)
        part_of = {link: part for part in parts for link in part.links}
        above = {part_of[j.child].name: j for j in self.joints if part_of[j.child] is not part_of[j.parent]}
        out = {}
        for part in (p for p in parts if p.has_geometry):
            parent, joints = part, []
            while parent.name in above and (parent is part or not parent.has_geometry):
                joints.append(above[parent.name])
                parent = part_of[joints[-1].parent]
            out[part.name] = parent.name if joints and parent.has_geometry else None, tuple(joints)
        return out

    def surface(self, part: Part, values: Mapping[str, float]) -> Surface | None:
        """A part's surface in its own frame, None where no link of it has a shape. `values` place frozen joints."""
        poses = self.link_poses(values)
        T_part_world = np.linalg.inv(poses[part.frame_link])
        surfaces = [
            shape.moved(T_part_world @ poses[link]) for link in part.links for shape in self._link_surfaces(link)
        ]
        return merge_coincident(join(surfaces)) if surfaces else None

    def _link_surfaces(self, link: str) -> list[Surface]:
        return [_visual(v, self.path).moved(_origin(v, self.path)) for v in self.links[link]]


def read_urdf(path: Path) -> Robot:
    """Read a URDF. Floating and planar joints are read as fixed, at their zero; a warning says so, and of what else is
    left out.

    Raises:
        InputError: not a URDF, or one whose links and joints do not make a tree.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the path of a URDF.")
    if path.stat().st_size > _MOST_BYTES:
        raise InputError(f"{path}: the file is larger than {_MOST_BYTES >> 20} MiB; give a URDF of fewer links.")
    try:
        robot = ElementTree.fromstring(path.read_bytes())
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # the latter of an encoding that is none
        raise InputError(f"{path}: not well-formed XML ({error}); give a URDF.") from error
    if robot.tag != "robot":
        raise InputError(f"{path}: the outermost element is <{robot.tag}>, not <robot>; give a URDF.")
    if any("xacro" in str(e.tag) for e in robot.iter()):
        raise InputError(f"{path}: holds xacro macros; expand it first with `xacro {path.name} > robot.urdf`.")

    colours = {m.get("name"): m for m in robot.iter("material") if m.find("color") is not None}
    links: dict[str, tuple[ElementTree.Element, ...]] = {}
    for element in robot.findall("link"):
        name = _attribute(element, "name", path)
        if name in links:
            raise InputError(f"{path}: two links are called {name!r}; rename one.")
        visuals = tuple(v for v in element.findall("visual") if _has_shape(v, path))
        for visual in visuals:
            material = visual.find("material")
            if material is not None and material.find("color") is None and material.get("name") in colours:
                material.append(colours[material.get("name")].find("color"))
        links[name] = visuals
    textures = {t.get("filename"): None for m in robot.iter("material") for t in m.findall("texture")}
    for name in filter(None, textures):
        _log.warning("%s: <texture filename=%r> is left out: only those that mesh files name are read", path, name)
    elements = robot.findall("joint")
    if max(len(links), len(elements)) > _MOST_LINKS:
        raise InputError(f"{path}: has {len(links)} links and {len(elements)} joints; give at most {_MOST_LINKS}.")
    joints = tuple(_joint(element, path) for element in elements)
    return Robot(path, robot.get("name", path.stem), links, joints, _root(links, joints, path))


def _joint(element: ElementTree.Element, path: Path) -> Joint:
    name, type = _attribute(element, "name", path), _attribute(element, "type", path)
    if type not in (*MOVABLE, "fixed", "floating", "planar"):
        raise InputError(f"{path}: joint {name!r} is of type {type!r}; use revolute, continuous, prismatic or fixed.")
    if type in ("floating", "planar"):
        _log.warning("%s: joint %r is %s and not moved: it is held at its zero", path, name, type)
    parent, child = element.find("parent"), element.find("child")
    if parent is None or child is None:
        raise InputError(f"{path}: joint {name!r} lacks its <parent> or <child>; add it.")

    axis_element = element.find("axis")
    axis = np.array([1.0, 0.0, 0.0]) if axis_element is None else _numbers(axis_element, "xyz", 3, path)
    length = float(np.linalg.norm(axis))
    if type in MOVABLE and not length > 0.0:
        raise InputError(f"{path}: joint {name!r} has the axis {axis.tolist()}; give it a direction.")

    limits, limit = None, element.find("limit")
    if type in ("revolute", "prismatic") and limit is not None:
        low, high = (_numbers(limit, key, 1, path, "0")[0] for key in ("lower", "upper"))
        if low > high:
            raise InputError(f"{path}: joint {name!r} has limits {low} to {high}; exchange lower and upper.")
        limits = (float(low), float(high))

    mimic_element, mimic = element.find("mimic"), None
    if mimic_element is not None and type in MOVABLE:
        mimic = Mimic(
            _attribute(mimic_element, "joint", path),
            float(_numbers(mimic_element, "multiplier", 1, path, "1")[0]),
            float(_numbers(mimic_element, "offset", 1, path, "0")[0]),
        )
    return Joint(
        name=name,
        type=type if type in MOVABLE else "fixed",
        parent=_attribute(parent, "link", path),
        child=_attribute(child, "link", path),
        T_parent_joint=_origin(element, path),
        axis=axis / length if length > 0.0 else axis,
        limits=limits,
        mimic=mimic,
    )


def _root(links: Mapping[str, object], joints: tuple[Joint, ...], path: Path) -> str:
    """The link that is nobody's child, once links and joints are known to make one tree."""
    for name, count in Counter(j.name for j in joints).items():
        if count > 1:
            raise InputError(f"{path}: two joints are called {name!r}; rename one.")
    movable = {j.name for j in joints if j.type in MOVABLE}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise InputError(f"{path}: joint {joint.name!r} names the link {link!r}, which is not there; add it.")
        if joint.mimic is not None and joint.mimic.joint not in movable:
            found = f"joint {joint.name!r} mimics {joint.mimic.joint!r}, which is no movable joint"
            raise InputError(f"{path}: {found}; name one that is.")
    _check_mimics(joints, path)
    parents = Counter(j.child for j in joints)
    for link, count in parents.items():
        if count > 1:
            raise InputError(f"{path}: link {link!r} is the child of two joints; a URDF is a tree, remove one.")
    roots = [link for link in links if link not in parents]
    if len(roots) != 1:
        found = ", ".join(roots) or "none"
        raise InputError(f"{path}: a URDF has one root link, here they are: {found}; join them into one tree.")
    reached, children = {roots[0]}, _children(joints)
    queue = [roots[0]]
    while queue:
        below = [j.child for j in children.get(queue.pop(), ())]
        reached.update(below)
        queue.extend(below)
    lost = [link for link in links if link not in reached]
    if lost:
        raise InputError(f"{path}: the links {', '.join(lost)} hang in a loop; a URDF is a tree, remove a joint.")
    return roots[0]


def _check_mimics(joints: tuple[Joint, ...], path: Path) -> None:
    """No joint mimics itself, by way of others or not."""
    followed = {j.name: j.mimic.joint for j in joints if j.mimic is not None}
    settled: set[str] = set()
    for name in followed:
        chain: set[str] = set()
        while name in followed and name not in settled:
            if name in chain:
                raise InputError(f"{path}: joint {name!r} mimics itself; remove a <mimic>.")
            chain.add(name)
            name = followed[name]
        settled |= chain


def _children(joints: tuple[Joint, ...]) -> dict[str, list[Joint]]:
    out: dict[str, list[Joint]] = {}
    for joint in joints:
        out.setdefault(joint.parent, []).append(joint)
    return out


def _has_shape(visual: ElementTree.Element, path: Path) -> bool:
    """Whether a <visual> shows anything: some robots have links with a box or sphere without any extent, or with an
    empty mesh."""
    if visual.find("geometry") is None:
        return False
    sizes = [(visual.find(f"geometry/{tag}"), key, n) for tag, key, n in (("box", "size", 3), ("sphere", "radius", 1))]
    if any(shape is not None and not _numbers(shape, key, n, path).any() for shape, key, n in sizes):
        return False
    mesh = visual.find("geometry/mesh")
    if mesh is not None and meshes.is_empty_stl(file := find_mesh(_attribute(mesh, "filename", path), path)):
        _log.warning("%s: the mesh is empty and left out", file)
        return False
    return True


def _visual(visual: ElementTree.Element, path: Path) -> Surface:
    """The shape of a <visual>, before its <origin>."""
    colour_element = visual.find("material/color")
    colour = None if colour_element is None else tuple(_numbers(colour_element, "rgba", 4, path)[:3])
    shapes = list(visual.find("geometry"))
    if len(shapes) != 1:
        raise InputError(f"{path}: a <geometry> holds {len(shapes)} shapes; give it one.")
    shape = shapes[0]
    if shape.tag == "mesh":
        scale = _numbers(shape, "scale", 3, path, "1 1 1")
        if not scale.all():
            raise InputError(f"{path}: <mesh scale={shape.get('scale')!r}> makes the mesh flat; mend it.")
        mesh = find_mesh(_attribute(shape, "filename", path), path)
        return meshes.load_mesh(mesh, colour).moved(np.diag([*scale, 1.0]))
    if shape.tag == "box":
        return meshes.box(_sizes(shape, "size", 3, path), colour)
    if shape.tag == "cylinder":
        return meshes.cylinder(_sizes(shape, "radius", 1, path)[0], _sizes(shape, "length", 1, path)[0], colour)
    if shape.tag == "capsule":
        return meshes.capsule(_sizes(shape, "radius", 1, path)[0], _sizes(shape, "length", 1, path)[0], colour)
    if shape.tag == "sphere":
        return meshes.sphere(_sizes(shape, "radius", 1, path)[0], colour)
    raise InputError(f"{path}: the shape <{shape.tag}> is not known; use mesh, box, cylinder, capsule or sphere.")


def find_mesh(name: str, urdf: Path) -> Path:
    """The file that a URDF means by a mesh's name: package://, file://, absolute, or relative to the URDF.

    A package is looked for upwards from the URDF: the folder of that name, or the one that holds the rest of the path.
    """
    folder = urdf.resolve().parent
    if not name.startswith(("package://", "model://")):
        return folder / name.removeprefix("file://")
    package, _, rest = name.split("://", 1)[1].partition("/")
    around = (folder, *folder.parents)
    # Another package may have a file of the same path, so that of this name is looked for everywhere first.
    for root in (*(above / package for above in around), *around):
        if (root / rest).is_file():
            return root / rest
    found = [above / package for above in (folder, *folder.parents) if (above / package).is_dir()]
    mend = f"{found[0]} has no {rest}; put that file there" if found else f"put the package {package!r} there"
    raise InputError(f"{urdf}: {name} is not found in the folders above the URDF; {mend}.")


def _origin(element: ElementTree.Element, path: Path) -> np.ndarray:
    T = np.eye(4)
    origin = element.find("origin")
    if origin is not None:
        T[:3, :3] = _rotation(origin, path).as_matrix()
        T[:3, 3] = _numbers(origin, "xyz", 3, path, "0 0 0")
    return T


def _rotation(origin: ElementTree.Element, path: Path) -> Rotation:
    """What an <origin> is turned by: roll, pitch and yaw or, since URDF 1.2, a quaternion in their place."""
    if origin.get("quat_xyzw") is None or origin.get("rpy") is not None:
        return Rotation.from_euler("xyz", _numbers(origin, "rpy", 3, path, "0 0 0"))
    quaternion = _numbers(origin, "quat_xyzw", 4, path)
    if not quaternion.any():
        raise InputError(f"{path}: <origin quat_xyzw={origin.get('quat_xyzw')!r}> is no rotation; mend it.")
    return Rotation.from_quat(quaternion)


def _attribute(element: ElementTree.Element, key: str, path: Path) -> str:
    value = element.get(key)
    if not value:
        raise InputError(f"{path}: a <{element.tag}> lacks its attribute {key!r}; add it.")
    return value


def _sizes(element: ElementTree.Element, key: str, count: int, path: Path) -> np.ndarray:
    sizes = _numbers(element, key, count, path)
    if not (sizes > 0).all():
        raise InputError(f"{path}: <{element.tag} {key}={element.get(key)!r}> should be above 0; mend it.")
    return sizes


def _numbers(element: ElementTree.Element, key: str, count: int, path: Path, default: str | None = None) -> np.ndarray:
    text = element.get(key, default)
    try:
        numbers = np.array([float(x) for x in text.split()]) if text is not None else np.empty(0)
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != count or not (np.abs(numbers) < LONGEST).all():
        raise InputError(f"{path}: <{element.tag} {key}={show(text)}> should hold {count} finite numbers; mend it.")
    return numbers
