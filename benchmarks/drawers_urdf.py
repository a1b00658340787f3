"""An object of any number of parts: a wall of drawers."""

from __future__ import annotations

import math
from pathlib import Path


def write_drawers(path: Path, parts: int) -> None:
    """A URDF of a board and `parts` - 1 drawers before it, side by side in rows, of different colours."""
    columns = math.ceil(math.sqrt(parts - 1))
    rows = math.ceil((parts - 1) / columns)
    links = [_box("board", (0.05, 0.3 * columns, 0.3 * rows), (0.7, 0.7, 0.65))]
    joints = []
    for k in range(parts - 1):
        hue = 2 * math.pi * k / (parts - 1)
        colour = tuple(0.5 + 0.35 * math.cos(hue + shift) for shift in (0, 2.1, 4.2))
        links.append(_box(f"drawer_{k}", (0.2, 0.24, 0.24), colour))
        y, z = 0.3 * (k % columns - (columns - 1) / 2), 0.3 * (k // columns - (rows - 1) / 2)
        joints.append(
            f'<joint name="slide_{k}" type="prismatic"><parent link="board"/><child link="drawer_{k}"/>'
            f'<origin xyz="0.13 {y:.4f} {z:.4f}"/><axis xyz="1 0 0"/>'
            '<limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>'
        )
    path.write_text(f'<robot name="drawers_{parts}">\n' + "\n".join([*links, *joints]) + "\n</robot>\n")


def _box(name: str, size: tuple[float, ...], colour: tuple[float, ...]) -> str:
    numbers = " ".join(f"{v:.4f}" for v in size)
    rgba = " ".join(f"{v:.3f}" for v in (*colour, 1))
    return (
        f'<link name="{name}"><visual><geometry><box size="{numbers}"/></geometry>'
        f'<material name="{name}"><color rgba="{rgba}"/></material></visual></link>'
    )
