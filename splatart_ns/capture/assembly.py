"""Putting an articulated object together: parts, joints, and the mechanisms that furniture and robots are made of.

Solids are convex, as `interpenetration` asks. Lengths are of an object about 1 long.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import trimesh

from splatart_ns.capture.articulated_object import Joint
from splatart_ns.capture.shapes import drum, rounded_box

CLEARANCE = 0.002
"""Between surfaces that slide on each other."""
_SEAM = 0.006
"""From the edge of a front to the edge of its cell."""


class Assembly:
    """Parts and joints as they are added, parents before children."""

    def __init__(self, root: str, *solids: trimesh.Trimesh) -> None:
        self.solids: dict[str, list[trimesh.Trimesh]] = {root: list(solids)}
        self.looks: dict[str, str] = {root: root}
        """Part to the name of its texture; parts of one look have one texture."""
        self.joints: list[Joint] = []

    def attach(self, part: str, *solids: trimesh.Trimesh) -> None:
        """Add solids, in the part's frame."""
        self.solids[part] += solids

    def hang(
        self,
        part: str,
        parent: str,
        type: str,
        origin: Sequence[float],
        axis: Sequence[float],
        limits: tuple[float, float],
        look: str | None = None,
    ) -> None:
        """Add a part without solids at a joint; `origin` and `axis` in the parent's frame."""
        self.solids[part] = []
        self.looks[part] = look or part
        joint = Joint(f"{part}_joint", type, parent, part, tuple(map(float, origin)), tuple(map(float, axis)), limits)
        self.joints.append(joint)


def box(low: Sequence[float], high: Sequence[float]) -> trimesh.Trimesh:
    """A box between two corners, in any order, its edges a little rounded."""
    low, high = np.minimum(low, high), np.maximum(low, high)
    radius = min(0.25 * float((high - low).min()), 0.012)
    return rounded_box(high - low, radius, 0.5 * (low + high), steps=1)


def turned(mesh: trimesh.Trimesh, R: np.ndarray, at: Sequence[float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """The solid turned by R [3, 3] and then moved."""
    return trimesh.Trimesh(np.asarray(mesh.vertices) @ R.T + at, mesh.faces, process=False)


def turn(axis: int, angle: float) -> np.ndarray:
    """Rotation [3, 3] about a coordinate axis."""
    R, c, s = np.eye(3), math.cos(angle), math.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


class Face:
    """A face of a part, as a frame for what is mounted on it.

    Args:
        part: its name.
        at: a point of the face, in the part's frame.
        normal, across: outwards, and along the face: signed coordinate axes.
    """

    def __init__(self, part: str, at: Sequence[float], normal: Sequence[float], across: Sequence[float]) -> None:
        self.part, self.at = part, np.asarray(at, dtype=np.float64)
        self.normal, self.across = np.asarray(normal, dtype=np.float64), np.asarray(across, dtype=np.float64)
        self.along = np.cross(self.normal, self.across)
        self.axes = np.stack([self.normal, self.across, self.along], axis=1)

    def point(self, coordinates: Sequence[float]) -> np.ndarray:
        """A point (out, across, along) in the part's frame."""
        return self.at + self.axes @ coordinates

    def box(self, low: Sequence[float], high: Sequence[float]) -> trimesh.Trimesh:
        """A box between corners (out, across, along), about the part's axes but with its origin at (0, 0, 0)."""
        return box(self.axes @ low, self.axes @ high)

    def drum(self, radius: float, low: float, high: float, axis: int) -> trimesh.Trimesh:
        """A cylinder through (0, 0, 0) along out (0), across (1) or along (2)."""
        direction = self.axes[:, axis]
        k = int(np.abs(direction).argmax())
        low, high = sorted((low * direction[k], high * direction[k]))
        return drum(radius, low, high, "xyz"[k], chamfer=0.1 * min(radius, high - low))


def add_leaf(
    assembly: Assembly,
    face: Face,
    name: str,
    width: float,
    height: float,
    thickness: float,
    limits: tuple[float, float],
    look: str | None = None,
    handle: bool = True,
) -> None:
    """Hinge a door, lid or flap on a face: closed at 0, it lies on it.

    The hinge runs along the face's edge through `face.at`, the leaf reaches `width` across it. Two pairs of knuckles
    meet on the hinge, so that both parts are seen at the axis.
    """
    r = 0.5 * thickness
    origin = (r, r + _SEAM, 0.0)
    assembly.hang(
        name,
        face.part,
        "revolute",
        face.point(origin),
        np.cross(face.across, face.normal),
        limits,
        look,
    )
    for low, high in ((0.06, 0.2), (0.8, 0.94)):
        knuckle = [face.drum(r, low * height, high * height, 2)]
        knuckle.append(face.box((-1.3 * r, -0.9 * r, low * height), (-0.2 * r, 0.9 * r, high * height)))
        assembly.attach(face.part, *(turned(s, np.eye(3), face.point(origin)) for s in knuckle))
    reach = width - origin[1] - _SEAM
    solids = [face.box((-r + CLEARANCE, 1.2 * r, _SEAM), (r, reach, height - _SEAM))]
    gap = CLEARANCE / height
    for low, high in ((0.2 + gap, 0.34), (0.66, 0.8 - gap)):
        solids.append(face.drum(r, low * height, high * height, 2))
        solids.append(face.box((-0.8 * r, 0.3 * r, low * height), (0.8 * r, 1.4 * r, high * height)))
    if handle:
        u, v = reach - 0.14 * width, 0.5 * height
        solids.append(face.box((0.8 * r, u, v - 0.12 * height), (r + 0.035, u + 0.07 * width, v + 0.12 * height)))
    assembly.attach(name, *solids)


def add_drawer(
    assembly: Assembly, face: Face, name: str, cell: tuple[float, float], wall: float, depth: float, look: str
) -> None:
    """Slide a drawer into an opening about `face.at`.

    Args:
        cell: size across and along of its front.
        wall: thickness of the walls about the opening; half of it covers the cell's edge.
        depth: of the opening.
    """
    w, h = 0.5 * cell[0], 0.5 * cell[1]
    inner, floor, thick = w - 0.5 * wall - 2 * CLEARANCE, -h + 0.5 * wall + CLEARANCE, 0.012
    reach, rim = depth - wall - 0.01, 0.3 * h
    assembly.hang(name, face.part, "prismatic", face.at, face.normal, (0.0, 0.8 * reach), look)
    assembly.attach(
        name,
        face.box((CLEARANCE, _SEAM - w, _SEAM - h), (wall, w - _SEAM, h - _SEAM)),
        face.box((-reach, -inner, floor), (2 * CLEARANCE, inner, floor + thick)),
        face.box((-reach, -inner, floor), (2 * CLEARANCE, thick - inner, rim)),
        face.box((-reach, inner - thick, floor), (2 * CLEARANCE, inner, rim)),
        face.box((-reach, -inner, floor), (thick - reach, inner, rim)),
        face.box((wall - CLEARANCE, -0.3 * w, 0.1 * h), (wall + 0.035, 0.3 * w, 0.1 * h + 0.03)),
    )


def add_carcass(
    assembly: Assembly,
    part: str,
    columns: Sequence[float],
    rows: Sequence[Sequence[float]],
    depth: float,
    wall: float,
) -> None:
    """Shelves with a back, open towards +x at x = 0.

    Args:
        columns: y of the borders between columns of cells, and of the two outer ones.
        rows: for each column, z of the borders between its cells, and of the two outer ones.
    """
    half = 0.5 * wall
    low, high = rows[0][0] - half, rows[0][-1] + half
    assembly.attach(part, box((-depth, columns[0] - half, low), (wall - depth, columns[-1] + half, high)))
    for y in columns:
        assembly.attach(part, box((-depth, y - half, low), (0.0, y + half, high)))
    for (left, right), borders in zip(zip(columns, columns[1:], strict=False), rows, strict=True):
        for z in borders:
            assembly.attach(part, box((-depth, left, z - half), (0.0, right, z + half)))


class Chain:
    """A serial arm that grows from a part, straight along its own z while its joints are at 0.

    Args:
        part: what it grows from.
        R: [3, 3], turns the chain's axes into the part's.
        at: where the first joint sits, in the part's frame.
    """

    def __init__(self, assembly: Assembly, part: str, R: np.ndarray, at: Sequence[float]) -> None:
        self._assembly, self.tip, self._R, self.at = assembly, part, R, np.asarray(at, dtype=np.float64)

    def place(self, mesh: trimesh.Trimesh, at: Sequence[float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
        """A solid in the chain's axes, about a point of the tip's frame."""
        return turned(mesh, self._R, at)

    def roll(self, name: str, radius: float, limits: tuple[float, float]) -> None:
        """A turntable: the next link turns about the chain's direction."""
        self._assembly.attach(self.tip, self.place(drum(radius, -radius, 0.0, chamfer=0.1 * radius), self.at))
        self._assembly.hang(name, self.tip, "revolute", self.at, self._R[:, 2], limits)
        knuckle = drum(0.9 * radius, CLEARANCE, 0.8 * radius, chamfer=0.1 * radius)
        self._assembly.attach(name, self.place(knuckle))
        self.tip, self.at = name, np.zeros(3)

    def pitch(
        self,
        name: str,
        radius: float,
        azimuth: float,
        tilt: float,
        side: int,
        limits: tuple[float, float],
    ) -> None:
        """A knuckle: the next link turns about an axis across the chain, beside this one.

        Args:
            azimuth: of the axis about the chain's direction, from its y.
            tilt: of the axis towards the chain's direction.
            side: 1 or -1, on which the next link sits.
        """
        turn_in = self._R @ turn(2, azimuth) @ turn(0, tilt)
        axis, half = turn_in[:, 1], 0.9 * radius
        pin = drum(radius, -half, half, "y", chamfer=0.1 * radius)
        self._assembly.attach(self.tip, turned(pin, turn_in, self.at))
        self._assembly.hang(name, self.tip, "revolute", self.at, axis, limits)
        low, high = sorted((side * (half + CLEARANCE), side * 3.0 * half))
        knuckle = drum(0.95 * radius, low, high, "y", chamfer=0.1 * radius)
        self._assembly.attach(name, turned(knuckle, turn_in))
        self.tip, self.at = name, 2.0 * half * side * axis

    def reach(self, length: float, radius: float, rng: np.random.Generator) -> None:
        """Lengthen the tip by a beam, for a next joint of this radius, with a mark that is not symmetric."""
        w = 0.42 * radius
        turn_in = self._R @ turn(2, 0.5 * math.pi * int(rng.integers(4)))
        beam = box((-w, -w, 0.3 * radius), (w, w, length))
        low, high = sorted(rng.uniform(1.2 * radius, max(length - 1.2 * radius, 1.6 * radius), 2))
        mark = box((0.8 * w, -0.6 * w, low), (1.6 * w, 0.6 * w, high + 0.2 * radius))
        self._assembly.attach(self.tip, turned(beam, turn_in, self.at), turned(mark, turn_in, self.at))
        self.at = self.at + self._R[:, 2] * length

    def gripper(self, size: float, travel: float, look: Callable[[str], str]) -> None:
        """A palm with two fingers that slide apart along the chain's y."""
        half, thick = 0.3 * size + travel + 0.12 * size, 0.25 * size
        self._assembly.attach(
            self.tip, self.place(box((-0.25 * size, -half, -thick), (0.25 * size, half, 0.0)), self.at)
        )
        palm, at = self.tip, self.at
        for name, side in (("finger_1", 1), ("finger_2", -1)):
            inner, outer = side * 0.02 * size, side * 0.3 * size
            self._assembly.hang(name, palm, "prismatic", at, side * self._R[:, 1], (0.0, travel), look(name))
            self._assembly.attach(
                name,
                self.place(box((-0.22 * size, inner, CLEARANCE), (0.22 * size, outer, 0.3 * size))),
                self.place(box((-0.13 * size, inner, 0.25 * size), (0.13 * size, 0.7 * outer, 0.95 * size))),
            )
