"""Mesh files beside a robot's description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import trimesh

from splatart_ns.bundle.export.robot import Link, Robot

MESHES = "meshes"
"""The folder, beside the description. File names are unique in it, since some simulators drop the folder's name."""


@dataclass(frozen=True)
class MeshFiles:
    """File names of a link's meshes, all in `MESHES`."""

    surface: str | None
    pieces: tuple[str, ...]


def write_meshes(robot: Robot, folder: Path) -> dict[str, MeshFiles]:
    """Write all links' meshes as OBJ, in the links' frames, with a colour per vertex; return their names by link."""
    (folder / MESHES).mkdir()
    return {link.name: _write(link, folder / MESHES) for link in robot.links.values()}


def _write(link: Link, folder: Path) -> MeshFiles:
    surface = None
    if link.surface is not None:
        surface = _write_obj(link.surface, folder / f"{link.name}_visual.obj")
    pieces = [_write_obj(piece, folder / f"{link.name}_collision_{i}.obj") for i, piece in enumerate(link.pieces)]
    return MeshFiles(surface, tuple(pieces))


def _write_obj(mesh: trimesh.Trimesh, path: Path) -> str:
    # Without normals and materials: simulators compute the first and colours are in the vertices.
    path.write_text(mesh.export(file_type="obj", include_normals=False, digits=9, header=None), encoding="ascii")
    return path.name
