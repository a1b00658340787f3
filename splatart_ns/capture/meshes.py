"""Mesh files and primitive shapes as surfaces."""

from __future__ import annotations

import io
import logging
import re
import zipfile
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from splatart_ns.capture.images import read_bytes
from splatart_ns.capture.surface import Surface, join
from splatart_ns.capture.values import LONGEST, is_inside
from splatart_ns.errors import InputError

_log = logging.getLogger(__name__)

_GREY = (0.7, 0.7, 0.7)
"""The colour of what has none, in the mesh or in the URDF."""

_LONGEST_EMPTY_STL = 1000
"""Bytes."""
_SUFFIXES = {".obj", ".dae", ".stl", ".glb", ".gltf", ".ply", ".off"}


class _Beside(trimesh.resolvers.FilePathResolver):
    """Finds what a mesh file names (materials, textures) relative to that file, up to two folders above its own.

    trimesh 5 refuses paths such as ../images/wood.jpg, and then drops the texture without a word.
    """

    def get(self, name: str) -> bytes:
        path = Path(self.parent) / name.strip().replace("\\", "/").removeprefix("file://")
        if not is_inside(Path(self.parent).resolve().parent.parent, path):
            _log.warning("%s lies far from the mesh that names it; its material is left out", path)
            raise FileNotFoundError(path)
        if not path.is_file():
            _log.warning("%s is not there, though a mesh beside it names it; its material is left out", path)
            raise FileNotFoundError(path)
        return read_bytes(path)


def load_mesh(path: Path, colour: tuple[float, float, float] | None = None) -> Surface:
    """The surface in a mesh file, with its materials.

    Args:
        path: OBJ, COLLADA, STL, glTF, PLY or OFF.
        colour: RGB in 0..1 for faces to which the file gives neither colour nor texture.

    Raises:
        InputError: the file is missing, of another kind, or holds no triangles.
    """
    if not path.is_file():
        raise InputError(f"{path}: the mesh is not there; put it there or mend its name in the URDF.")
    if path.suffix.lower() not in _SUFFIXES:
        raise InputError(f"{path}: meshes of type {path.suffix!r} are not read; convert it to OBJ, DAE, STL or GLB.")
    data = read_bytes(path)
    if zipfile.is_zipfile(io.BytesIO(data)):  # which a few bytes can fill any memory with
        raise InputError(f"{path}: the mesh is a ZIP archive; unpack it.")
    try:
        scene = trimesh.load_scene(
            io.BytesIO(data),
            file_type=path.suffix[1:].lower(),
            resolver=_Beside(str(path)),
            process=False,
        )
        surfaces = []
        for node in scene.graph.nodes_geometry:
            T, name = scene.graph[node]
            mesh = scene.geometry[name]
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) > 0:
                surfaces.append(_surface(mesh, colour).moved(T))
    except InputError:
        raise
    except Exception as error:  # The readers raise whatever a broken file makes them stumble over.
        raise InputError(f"{path}: the mesh cannot be read ({error}); export it again.") from error
    surfaces = [s for s in surfaces if len(s.corners) > 0]
    if not surfaces:
        raise InputError(f"{path}: the mesh holds no triangles; export it again.")
    surface = join(surfaces)
    if path.suffix.lower() == ".dae":
        surface = surface.moved(np.diag([_unit(path, data)] * 3 + [1.0]))
    if not np.abs(surface.corners).max() < LONGEST:
        raise InputError(f"{path}: the mesh has corners that are not finite or far away; export it again.")
    return surface


def is_empty_stl(path: Path) -> bool:
    """Whether a file is an STL of no triangles, as CAD programs write it for a part without a body."""
    if path.suffix.lower() != ".stl" or not path.is_file() or path.stat().st_size > _LONGEST_EMPTY_STL:
        return False
    data = read_bytes(path)
    return data[80:] == bytes(4) or re.fullmatch(rb"\s*solid\b[^\n]*\n\s*endsolid\b[^\n]*\s*", data) is not None


def box(size: np.ndarray, colour: tuple[float, float, float] | None = None) -> Surface:
    """A box about the origin, side lengths [3]."""
    return _plain(trimesh.creation.box(extents=size), colour)


def cylinder(radius: float, length: float, colour: tuple[float, float, float] | None = None) -> Surface:
    """A cylinder about the origin along z."""
    return _plain(trimesh.creation.cylinder(radius=radius, height=length, sections=48), colour)


def capsule(radius: float, length: float, colour: tuple[float, float, float] | None = None) -> Surface:
    """A cylinder about the origin along z with a half sphere on each end; `length` is the cylinder's alone."""
    return _plain(trimesh.creation.capsule(radius=radius, height=length, count=[48, 24]), colour)


def sphere(radius: float, colour: tuple[float, float, float] | None = None) -> Surface:
    """A sphere about the origin."""
    return _plain(trimesh.creation.icosphere(subdivisions=3, radius=radius), colour)


def _plain(mesh: trimesh.Trimesh, colour: tuple[float, float, float] | None) -> Surface:
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    return Surface.of(corners, colours=np.broadcast_to(_GREY if colour is None else colour, corners.shape))


def _surface(mesh: trimesh.Trimesh, colour: tuple[float, float, float] | None) -> Surface:
    faces = np.asarray(mesh.faces)
    corners = np.asarray(mesh.vertices, dtype=np.float64)[faces]
    visual, default = mesh.visual, np.broadcast_to(_GREY if colour is None else colour, corners.shape)
    if visual.kind == "vertex":
        return Surface.of(corners, colours=visual.vertex_colors[faces][..., :3] / 255.0)
    if visual.kind == "face":
        colours = np.repeat(visual.face_colors[:, None, :3] / 255.0, 3, axis=1)
        return Surface.of(corners, colours=colours)
    if visual.kind != "texture":
        return Surface.of(corners, colours=default)

    tint, image = _material(visual.material)
    if image is not None and visual.uv is not None:
        tint = (1.0, 1.0, 1.0) if tint is None else tint
        return Surface.of(corners, np.asarray(visual.uv)[faces], np.broadcast_to(tint, corners.shape), image)
    return Surface.of(corners, colours=default if tint is None else np.broadcast_to(tint, corners.shape))


def _material(material: object) -> tuple[np.ndarray | None, np.ndarray | None]:
    """The base colour [3] and the texture [H, W, 3] uint8 of a trimesh material; None for what it lacks."""
    if isinstance(material, trimesh.visual.material.PBRMaterial):
        tint, image = material.baseColorFactor, material.baseColorTexture
        tint = None if tint is None else np.asarray(tint)[:3]
        if tint is not None and np.issubdtype(tint.dtype, np.integer):
            tint = tint / 255.0
    else:
        image = getattr(material, "image", None)
        # Where an OBJ has no material, trimesh makes one up; a picture that came from a file has a format.
        image = None if image is None or image.format is None else image
        told = image is None and bool(getattr(material, "kwargs", None))
        # Kd beside a map_Kd is left out: exporters leave it at black, 0.8 or white as they like.
        tint = np.asarray(material.diffuse)[:3] / 255.0 if told else None
    if image is None:
        return tint, None
    return tint, np.asarray(_opaque(image))


def _opaque(image: Image.Image) -> Image.Image:
    if image.mode in ("RGBA", "LA", "P"):
        image = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", image.size, "white"), image).convert("RGB")
    return image.convert("RGB")


def _unit(path: Path, data: bytes) -> float:
    """Metres per unit of a COLLADA file, which readers of URDF (rviz, Gazebo) apply."""
    found = re.search(rb'<unit\b[^>]*\bmeter\s*=\s*["\']([^"\']*)["\']', data[:100_000])
    try:
        unit = float(found.group(1)) if found else 1.0
    except ValueError:
        unit = 0.0
    if not 1e-9 < unit < 1e9:
        raise InputError(f"{path}: its unit is {found.group(1)!r} metres; give a length above 0.")
    return unit
