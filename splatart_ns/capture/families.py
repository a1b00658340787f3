"""Families of articulated objects that occur in the real world, their proportions drawn at random.

Objects are about 1 long, z is up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from splatart_ns.capture.assembly import (
    CLEARANCE,
    Assembly,
    Chain,
    Face,
    add_carcass,
    add_drawer,
    add_leaf,
    box,
    turn,
    turned,
)
from splatart_ns.capture.shapes import drum

_X, _Y, _Z = np.eye(3)


@dataclass(frozen=True)
class Family:
    """Objects of one kind."""

    build: Callable[[np.random.Generator, int], Assembly]
    """Makes one of a number of parts."""
    parts: Sequence[int]
    """Numbers of parts that it can have."""


def _degrees(low: float, high: float) -> tuple[float, float]:
    return math.radians(low), math.radians(high)


def _window(rng: np.random.Generator, reach: float, width: float = 120.0) -> tuple[float, float]:
    """Limits of a joint: `width` degrees about a middle within +-reach degrees."""
    middle = rng.uniform(-reach, reach)
    return _degrees(middle - 0.5 * width, middle + 0.5 * width)


def _split(rng: np.random.Generator, low: float, high: float, count: int) -> list[float]:
    """Borders of `count` ranges between two ends, often equal ones."""
    weights = np.ones(count) if rng.random() < 0.6 else rng.uniform(0.7, 1.4, count)
    return [float(x) for x in low + (high - low) * np.concatenate([[0.0], np.cumsum(weights) / weights.sum()])]


def _look(rng: np.random.Generator, shared: str) -> Callable[[str], str]:
    """Parts are alike to the last texel, or each has a texture of its own."""
    alike = rng.random() < 0.5
    return lambda part: shared if alike else part


def _cabinet(rng: np.random.Generator, parts: int) -> Assembly:
    """Doors and drawers above each other and side by side."""
    count = parts - 1
    columns = int(rng.integers(1 + (count > 4), 1 + min(count, 3)))
    cells = [count // columns + (k < count % columns) for k in rng.permutation(columns)]
    width, height = rng.uniform(0.36, 0.48) * (1.0 + 0.55 * (columns - 1)), max(rng.uniform(0.5, 1.0), 0.2 * max(cells))
    depth, wall, foot = rng.uniform(0.35, 0.5), rng.uniform(0.028, 0.036), rng.uniform(0.04, 0.1)
    assembly = Assembly("body")
    for x in (-depth + 0.05, -0.05):
        for y in (0.05 - 0.5 * width, 0.5 * width - 0.05):
            assembly.attach("body", box((x - 0.03, y - 0.03, 0.0), (x + 0.03, y + 0.03, foot)))
    borders = _split(rng, -0.5 * width, 0.5 * width, columns)
    rows = [_split(rng, foot + 0.5 * wall, foot + height, n) for n in cells]
    _fill(rng, assembly, borders, rows, depth, wall)
    return assembly


def _table(rng: np.random.Generator, parts: int) -> Assembly:
    """A top on legs with one or two rows of drawers."""
    count = parts - 1
    levels = 2 if count % 2 == 0 and (count > 3 or rng.random() < 0.5) else 1
    columns = count // levels
    width, height = max(rng.uniform(0.7, 0.9), 0.24 * columns), rng.uniform(0.17, 0.22) * levels
    depth, wall, foot = rng.uniform(0.4, 0.55), rng.uniform(0.028, 0.036), rng.uniform(0.3, 0.5)
    top = foot + height
    assembly = Assembly("body", box((-depth - 0.06, -0.5 * width - 0.06, top), (0.06, 0.5 * width + 0.06, top + 0.04)))
    for x in (-depth + 0.03, -0.03):
        for y in (-0.5 * width, 0.5 * width):
            assembly.attach("body", box((x - 0.03, y - 0.03, 0.0), (x + 0.03, y + 0.03, foot)))
    borders = _split(rng, -0.5 * width, 0.5 * width, columns)
    rows = [[foot + height * k / levels for k in range(levels + 1)]] * columns
    _fill(rng, assembly, borders, rows, depth, wall, doors=False)
    return assembly


def _fill(
    rng: np.random.Generator,
    assembly: Assembly,
    columns: list[float],
    rows: list[list[float]],
    depth: float,
    wall: float,
    doors: bool = True,
) -> None:
    """A carcass with a door or a drawer in each cell."""
    add_carcass(assembly, "body", columns, rows, depth, wall)
    drawer_look, door_look = _look(rng, "drawer"), _look(rng, "door")
    names = {"drawer": 0, "door": 0}
    for (y0, y1), borders in zip(zip(columns, columns[1:], strict=False), rows, strict=True):
        for z0, z1 in zip(borders, borders[1:], strict=False):
            w, h = y1 - y0, z1 - z0
            tall = h / w
            share = 0.15 if tall > 1.3 else 0.85 if tall < 0.6 else 0.5
            kind = "drawer" if not doors or rng.random() < share else "door"
            names[kind] += 1
            name = f"{kind}_{names[kind]}"
            if kind == "drawer":
                face = Face("body", (0.0, 0.5 * (y0 + y1), 0.5 * (z0 + z1)), _X, _Y)
                add_drawer(assembly, face, name, (w, h), wall, depth, drawer_look(name))
                continue
            flap = tall < 0.8 or rng.random() < 0.2
            face = [
                Face("body", (0.0, y0, z0), _X, _Y),
                Face("body", (0.0, y1, z1), _X, -_Y),
                Face("body", (0.0, y0, z1), _X, -_Z),
                Face("body", (0.0, y1, z0), _X, _Z),
            ][int(rng.integers(2)) + 2 * flap]
            size = (h, w) if flap else (w, h)
            add_leaf(assembly, face, name, *size, wall, _degrees(0.0, 110.0), door_look(name))


def _box(rng: np.random.Generator, parts: int) -> Assembly:
    """A box with a lid, two half lids, or the flaps of a carton."""
    x, y, height = rng.uniform(0.25, 0.4), rng.uniform(0.25, 0.45), rng.uniform(0.2, 0.6)
    wall = rng.uniform(0.03, 0.04)
    assembly = Assembly("box", box((-x, -y, 0.0), (x, y, wall)))
    for s in (-1, 1):
        assembly.attach("box", box((s * x, -y, 0.0), (s * (x - wall), y, height)))
        assembly.attach("box", box((wall - x, s * y, 0.0), (x - wall, s * (y - wall), height)))
    assembly.attach("box", box((x - 0.01, -0.3 * y, 0.5 * height), (x + 0.03, 0.1 * y, 0.5 * height + 0.06)))
    edges = [
        (Face("box", (-x, -y, height), _Z, _X), 2 * x, 2 * y),
        (Face("box", (x, y, height), _Z, -_X), 2 * x, 2 * y),
        (Face("box", (x, -y, height), _Z, _Y), 2 * y, 2 * x),
        (Face("box", (-x, y, height), _Z, -_Y), 2 * y, 2 * x),
    ]
    look = _look(rng, "flap")
    if parts == 2:
        edge = edges[int(rng.integers(4))]
        add_leaf(assembly, edge[0], "lid", edge[1], edge[2], wall, _degrees(0.0, 150.0))
    elif parts == 3:
        first = 2 * int(rng.integers(2))
        for k, (face, width, length) in enumerate(edges[first : first + 2]):
            add_leaf(assembly, face, f"lid_{k + 1}", 0.5 * width, length, wall, _degrees(0.0, 150.0), look("lid"))
    else:
        for k in sorted(rng.permutation(4)[: parts - 1]):
            face, width, length = edges[k]
            name, size = f"flap_{k + 1}", rng.uniform(0.4, 0.5) * width
            add_leaf(assembly, face, name, size, length, wall, _degrees(50.0, 185.0), look(name), handle=False)
    return assembly


def _laptop(rng: np.random.Generator, parts: int) -> Assembly:
    """Two slabs, hinged along an edge."""
    x, y, thick = rng.uniform(0.25, 0.35), rng.uniform(0.4, 0.5), rng.uniform(0.04, 0.07)
    assembly = Assembly("base", box((-x, -y, 0.0), (x, y, thick)))
    assembly.attach("base", box((x - 0.02, 0.2 * y, 0.3 * thick), (x + 0.03, 0.4 * y, 0.8 * thick)))
    face = Face("base", (-x, -y, thick), _Z, _X)
    add_leaf(assembly, face, "screen", 2 * x, 2 * y, rng.uniform(0.03, 0.04), _degrees(5.0, 150.0), handle=False)
    return assembly


def _arm(rng: np.random.Generator, parts: int) -> Assembly:
    """A serial arm on a foot, of parallel, orthogonal or skew axes, perhaps with a gripper of two fingers."""
    gripper = parts >= 6 and rng.random() < 0.5 or parts == 10
    links = parts - 1 - 2 * gripper
    style = ("parallel", "orthogonal", "skew")[int(rng.integers(3))]
    lengths = rng.uniform(0.7, 1.4, links)
    lengths *= max(1.0, 0.16 * links) / lengths.sum()
    radius = float(np.clip(0.3 * lengths.mean(), 0.055, 0.085))
    radii = radius * np.linspace(1.0, rng.uniform(0.75, 1.0), links + 1)
    x, y = rng.uniform(0.14, 0.2, 2)
    assembly = Assembly("base", box((-x, -y, 0.0), (x, y, 0.05)), drum(1.1 * radius, 0.04, 0.16 - radius))
    assembly.attach("base", box((-0.5 * radius, -0.5 * radius, 0.1 - radius), (0.5 * radius, 0.5 * radius, 0.155)))
    assembly.attach("base", box((-x + 0.02, -0.5 * y, 0.04), (-x + 0.05, 0.3 * y, 0.08)))
    chain = Chain(assembly, "base", np.eye(3), (0.0, 0.0, 0.16))
    _grow(rng, chain, [f"link_{i + 1}" for i in range(links)], lengths, radii, style)
    if gripper:
        chain.gripper(0.17, rng.uniform(0.08, 0.12), _look(rng, "finger"))
    else:
        w = radii[-1]
        tool = box((-0.7 * w, -1.6 * w, -0.3 * w), (0.7 * w, 0.9 * w, 0.5 * w))
        assembly.attach(chain.tip, turned(tool, turn(2, rng.uniform(0.0, math.pi)), chain.at))
    return assembly


def _grow(
    rng: np.random.Generator,
    chain: Chain,
    names: Sequence[str],
    lengths: Sequence[float],
    radii: Sequence[float],
    style: str,
    reach: float = 45.0,
) -> None:
    """Links of a chain, their axes parallel, orthogonal or skew."""
    azimuth, side, rolled = 0.0, 1, False
    for i, name in enumerate(names):
        roll = style != "parallel" and not rolled and rng.random() < (0.6 if i == 0 else 0.25)
        if roll:
            chain.roll(name, radii[i], _window(rng, reach))
        else:
            tilt = rng.uniform(-0.3, 0.3) if style == "skew" else 0.0
            chain.pitch(name, radii[i], azimuth, tilt, side, _window(rng, reach))
        rolled, side = roll, side * int(rng.choice((-1, 1)))
        if style == "orthogonal":
            azimuth = 0.5 * math.pi * int(rng.integers(2))
        elif style == "skew":
            azimuth = rng.uniform(0.0, math.pi)
        chain.reach(lengths[i], radii[i + 1], rng)


def _torso(rng: np.random.Generator, parts: int) -> Assembly:
    """A body with two arms, and a head where the number of parts is even."""
    links = (parts - 1) // 2
    x, y, height = rng.uniform(0.1, 0.14), rng.uniform(0.14, 0.2), rng.uniform(0.5, 0.65)
    assembly = Assembly("torso", box((-x, -y, 0.12), (x, y, height)), drum(0.06, 0.02, 0.14))
    assembly.attach("torso", box((-0.2, -0.2, 0.0), (0.2, 0.2, 0.04)))
    assembly.attach("torso", box((x - 0.01, -0.5 * y, 0.5 * height), (x + 0.03, 0.2 * y, 0.5 * height + 0.1)))
    radii = np.linspace(0.07, 0.06, links + 1)
    if parts % 2 == 0:
        chain = Chain(assembly, "torso", np.eye(3), (0.0, 0.0, height + 0.03))
        chain.roll("head", 0.06, _window(rng, 60.0))
        skull, nose = box((-0.09, -0.08, 0.04), (0.09, 0.08, 0.2)), box((0.08, -0.03, 0.08), (0.13, 0.03, 0.12))
        assembly.attach("head", skull, nose)
    lengths = rng.uniform(0.8, 1.2, links)
    lengths *= max(0.4, 0.16 * links) / lengths.sum()
    style = ("orthogonal", "skew")[int(rng.integers(2))]
    for label, side in (("left", 1), ("right", -1)):
        R = turn(0, -side * rng.uniform(0.4, 0.55) * math.pi)
        shoulder = np.array([0.0, side * (y + 0.09), height - 0.09])
        assembly.attach("torso", box((-0.025, side * (y - 0.01), shoulder[2] - 0.025), shoulder + (0.025, 0.0, 0.025)))
        chain = Chain(assembly, "torso", R, shoulder)
        _grow(rng, chain, [f"{label}_{i + 1}" for i in range(links)], lengths, radii, style, reach=20.0)
        hand = chain.place(box((-0.03, -0.05, 0.0), (0.03, 0.07, 0.05)), chain.at)
        assembly.attach(chain.tip, hand)
    return assembly


def _fan(rng: np.random.Generator, parts: int) -> Assembly:
    """Blades on a stand, whose head turns where there are three parts."""
    height, radius, count = rng.uniform(0.5, 0.7), rng.uniform(0.25, 0.35), int(rng.integers(3, 6))
    assembly = Assembly("stand", drum(0.2, 0.0, 0.04, chamfer=0.01), drum(0.04, 0.03, height - 0.09))
    assembly.attach("stand", box((0.1, -0.05, 0.03), (0.16, 0.05, 0.07)))
    head, at = "stand", np.array([0.0, 0.0, height])
    if parts == 3:
        assembly.attach("stand", drum(0.06, height - 0.12, height - 0.09))
        head, at = "head", np.zeros(3)
        assembly.hang("head", "stand", "revolute", (0.0, 0.0, height), _Z, _window(rng, 20.0, 100.0))
        assembly.attach("head", drum(0.06, CLEARANCE - 0.09, -0.05))
    else:
        assembly.attach("stand", drum(0.05, height - 0.1, height - 0.04))
    assembly.attach(head, drum(0.08, -0.12, 0.08, "x", at=at, chamfer=0.01))
    assembly.attach(head, box(at + (-0.06, -0.03, 0.07), at + (0.0, 0.03, 0.11)))
    front = at + (0.08, 0.0, 0.0)
    assembly.hang("rotor", head, "revolute", front, _X, _window(rng, 90.0))
    assembly.attach("rotor", drum(0.06, CLEARANCE, 0.08, "x", chamfer=0.01))
    blade = box((0.03, -0.055, 0.03), (0.05, 0.055, radius))
    pitched = turned(blade, turn(2, 0.4), (0.03, 0.0, 0.0))
    for k in range(count):
        assembly.attach("rotor", turned(pitched, turn(0, 2.0 * math.pi * k / count)))
    return assembly


def _dials(rng: np.random.Generator, parts: int) -> Assembly:
    """A panel with knobs and hand wheels, nearly round."""
    count = parts - 1
    columns = math.ceil(math.sqrt(count) - (rng.random() < 0.4))
    columns = max(columns, 1)
    rows = math.ceil(count / columns)
    pitch = max(0.26, 0.5 / max(columns, rows))
    width, height, depth = pitch * columns, pitch * rows, rng.uniform(0.15, 0.3)
    assembly = Assembly("panel", box((-depth, -0.5 * width - 0.05, 0.0), (0.0, 0.5 * width + 0.05, height + 0.1)))
    assembly.attach("panel", box((-depth - 0.05, -0.5 * width, 0.1), (-depth + 0.01, -0.3 * width, 0.2)))
    look = _look(rng, "knob")
    for k in range(count):
        row, column = divmod(k, columns)
        at = (0.0, (column + 0.5) * pitch - 0.5 * width, height + 0.05 - (row + 0.5) * pitch)
        name = f"knob_{k + 1}"
        assembly.hang(name, "panel", "revolute", at, _X, _window(rng, 180.0), look(name))
        radius = rng.uniform(0.3, 0.45) * pitch
        if rng.random() < 0.5:
            thick = rng.uniform(0.06, 0.1)
            assembly.attach(name, drum(radius, CLEARANCE, thick, "x", chamfer=0.015))
            ridge = box((thick - 0.01, -0.25 * radius, -0.3 * radius), (thick + 0.04, 0.25 * radius, 0.9 * radius))
            assembly.attach(name, ridge)
        else:
            assembly.attach(name, drum(0.35 * radius, CLEARANCE, 0.1, "x", chamfer=0.01))
            _wheel(assembly, name, radius, 0.06, 0.1, int(rng.integers(3, 6)))
    return assembly


def _wheel(assembly: Assembly, name: str, radius: float, low: float, high: float, spokes: int) -> None:
    """A rim with spokes about x, and a handle on the rim that tells its angle."""
    thick, sides = 0.22 * radius, 12
    arc = (radius - 0.5 * thick) * math.tan(math.pi / sides) + 0.1 * thick
    for k in range(sides):
        piece = box((low, -arc, radius - thick), (high, arc, radius))
        assembly.attach(name, turned(piece, turn(0, 2.0 * math.pi * k / sides)))
    for k in range(spokes):
        spoke = box((low + 0.005, -0.5 * thick, 0.0), (high - 0.005, 0.5 * thick, radius - 0.5 * thick))
        assembly.attach(name, turned(spoke, turn(0, 2.0 * math.pi * k / spokes)))
    assembly.attach(name, drum(0.6 * thick, high - 0.01, high + 0.05, "x", at=(0.0, 0.0, radius - 0.6 * thick)))


def _cart(rng: np.random.Generator, parts: int) -> Assembly:
    """A chassis with wheels, and a bed that tips where there are four or six parts."""
    wheels = parts - 1 - (parts % 2 == 0)
    x, y, radius = rng.uniform(0.35, 0.5), rng.uniform(0.15, 0.2), rng.uniform(0.11, 0.15)
    low, high = 0.7 * radius, 0.7 * radius + rng.uniform(0.1, 0.16)
    assembly = Assembly("chassis", box((-x, -y, low), (x, y, high)))
    assembly.attach("chassis", box((0.55 * x, -0.9 * y, high - 0.01), (0.95 * x, 0.9 * y, high + 0.2)))
    look, thick = _look(rng, "wheel"), rng.uniform(0.05, 0.08)
    for k in range(wheels):
        name, side = f"wheel_{k + 1}", 1 - 2 * (k % 2)
        front = 0.0 if wheels == 2 else 0.65 * x if k < 2 else -0.65 * x
        at = (front, side * (y + 0.02), radius)
        axle = sorted((side * (y - 0.02), side * (y + 0.02)))
        assembly.attach("chassis", drum(0.35 * radius, *axle, "y", at=(front, 0.0, radius)))
        assembly.hang(name, "chassis", "revolute", at, _Y, _window(rng, 180.0), look(name))
        near, far = side * CLEARANCE, side * thick
        assembly.attach(name, drum(radius, *sorted((near, far)), "y", chamfer=0.015))
        low_corner = (-0.15 * radius, far - side * 0.01, 0.1 * radius)
        assembly.attach(name, box(low_corner, (0.25 * radius, far + side * 0.025, 0.8 * radius)))
    if parts % 2 == 0:
        face = Face("chassis", (-x, -0.95 * y, high), _Z, _X)
        length, thick = 1.5 * x, 0.03
        add_leaf(assembly, face, "bed", length, 1.9 * y, thick, _degrees(0.0, 80.0), handle=False)
        for v in (0.02, 1.9 * y - 0.04):
            assembly.attach("bed", face.box((0.01, 0.05, v), (0.12, length - 0.05, v + 0.02)))
        assembly.attach("bed", face.box((0.01, length - 0.07, 0.02), (0.12, length - 0.05, 1.9 * y - 0.02)))
    return assembly


def _pliers(rng: np.random.Generator, parts: int) -> Assembly:
    """Two levers that cross, as those of pliers and scissors."""
    jaw, handle, width = rng.uniform(0.25, 0.45), rng.uniform(0.45, 0.6), rng.uniform(0.06, 0.09)
    thick, bend, boss = rng.uniform(0.04, 0.06), rng.uniform(0.05, 0.3), 0.8 * width
    ring = rng.random() < 0.5

    def lever(low: float, side: int) -> list:
        high = low + thick
        solids = [drum(boss, low, high, chamfer=0.005)]
        solids.append(turned(box((0.0, -0.5 * width, low), (jaw, 0.5 * width, high)), turn(2, 0.05 * side)))
        back = turn(2, math.pi + bend * side)
        solids.append(turned(box((0.0, -0.45 * width, low), (handle, 0.45 * width, high)), back))
        if ring:
            for k in range(10):
                piece = turned(
                    box((0.07, -0.032, low), (0.1, 0.032, high)), turn(2, 0.2 * math.pi * k), (handle + 0.06, 0, 0)
                )
                solids.append(turned(piece, back))
        else:
            solids.append(turned(box((handle - 0.2, -0.7 * width, low), (handle, 0.3 * width, high)), back))
        return solids

    assembly = Assembly("lever_1", *lever(0.0, 1))
    assembly.hang("lever_2", "lever_1", "revolute", (0.0, 0.0, thick + CLEARANCE), _Z, _degrees(5.0, 110.0))
    assembly.attach("lever_2", *lever(0.0, -1), drum(0.4 * boss, thick - 0.005, thick + 0.02))
    return assembly


def _ruler(rng: np.random.Generator, parts: int) -> Assembly:
    """A folding ruler: flat bars on parallel axes, each on the one before."""
    lengths = rng.uniform(0.8, 1.3, parts) * max(1.0, 0.22 * parts) / parts
    width, thick = rng.uniform(0.08, 0.11), rng.uniform(0.04, 0.06)

    def bar(length: float) -> list:
        solids = [box((0.0, -0.5 * width, 0.0), (length, 0.5 * width, thick))]
        solids += [drum(0.62 * width, 0.0, thick, at=(x, 0.0, 0.0), chamfer=0.005) for x in (0.0, length)]
        low = rng.uniform(0.2, 0.6) * length
        solids.append(box((low, 0.4 * width, 0.1 * thick), (low + 0.25 * length, 0.75 * width, 0.9 * thick)))
        return solids

    assembly = Assembly("bar_1", *bar(lengths[0]))
    look, up = _look(rng, "bar"), True
    for i in range(1, parts):
        name, step = f"bar_{i + 1}", thick + CLEARANCE
        limits = _window(rng, 70.0)
        assembly.hang(
            name, f"bar_{i}", "revolute", (lengths[i - 1], 0.0, step if up else -step), _Z, limits, look(name)
        )
        assembly.attach(name, *bar(lengths[i]))
        up = up if rng.random() < 0.6 else not up
    return assembly


FAMILIES = {
    "cabinet": Family(_cabinet, range(2, 11)),
    "table": Family(_table, range(2, 8)),
    "box": Family(_box, range(2, 6)),
    "laptop": Family(_laptop, (2,)),
    "arm": Family(_arm, range(4, 11)),
    "torso": Family(_torso, range(3, 11)),
    "fan": Family(_fan, (2, 3)),
    "dials": Family(_dials, range(2, 9)),
    "cart": Family(_cart, (3, 4, 5, 6)),
    "pliers": Family(_pliers, (2,)),
    "ruler": Family(_ruler, range(3, 7)),
}
"""By name."""
