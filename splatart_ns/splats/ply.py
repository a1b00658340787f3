"""Splats as PLY files in the layout of the 3D Gaussian Splatting reference code, which every splat viewer opens.

One binary little-endian float32 vertex per Gaussian: x y z, nx ny nz (zeros), f_dc_0..2, f_rest_* (all coefficients
of red, then of green, then of blue), opacity (a logit), scale_0..2 (logarithms), rot_0..3 (wxyz).
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from splatart_ns.errors import InputError
from splatart_ns.files import replacing
from splatart_ns.splats.splat import Splat

_MAX_HEADER_BYTES = 1 << 16
_MOST_NORM = 1e12
"""Of quaternions; beyond it, and below one over it, float32 cannot square them."""
_MOST_LOG_SCALE = 30.0
"""Larger Gaussians have variances in pixels that float32 cannot hold once they are rendered."""
_SH_DEGREE_OF_REST = {0: 0, 9: 1, 24: 2, 45: 3}
_CENTRE = ["x", "y", "z"]
_COLOUR = ["f_dc_0", "f_dc_1", "f_dc_2"]
_SCALE = ["scale_0", "scale_1", "scale_2"]
_ROTATION = ["rot_0", "rot_1", "rot_2", "rot_3"]
_REQUIRED = [*_CENTRE, *_COLOUR, "opacity", *_SCALE, *_ROTATION]
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip


def write_ply(splat: Splat, path: Path, parts: torch.Tensor | None = None) -> None:
    """Write a splat, part logits left out. A value that is not finite raises ValueError.

    `parts` [N], ids of 0 to 255, become the last property, `uchar part`.
    """
    n = len(splat)
    rest = splat.sh[:, 1:].transpose(1, 2).flatten(1)
    names = [*_CENTRE, "nx", "ny", "nz", *_COLOUR, *(f"f_rest_{i}" for i in range(rest.shape[1]))]
    names += ["opacity", *_SCALE, *_ROTATION]
    columns = [splat.means, torch.zeros_like(splat.means), splat.sh[:, 0], rest]
    columns += [splat.opacity_logits[:, None], splat.log_scales, splat.quats]
    table = torch.cat([c.detach().to("cpu", torch.float32) for c in columns], dim=1).numpy()
    if not np.isfinite(table).all():
        raise ValueError(f"{path}: a splat to be written has values that are not finite")

    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property float {name}" for name in names]
    rows = np.ascontiguousarray(table, "<f4").view("u1").reshape(n, 4 * len(names))
    if parts is not None:
        header.append("property uchar part")
        rows = np.column_stack([rows, parts.to("cpu", torch.uint8).numpy()])
    header.append("end_header")
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(rows.tobytes())


def read_ply(path: Path) -> Splat:
    """Read a splat (float32, no part logits); the SH degree follows from the number of f_rest properties.

    Raises InputError for anything that is not a whole, finite 3DGS PLY. Properties of other names are skipped.
    """
    path = Path(path)
    if os.path.exists(path) and not os.path.isfile(path):  # a pipe would never end
        raise InputError(f"{path}: is not a file; give a PLY file")
    try:
        with path.open("rb") as file:
            count, dtype = _read_header(file, path)
            size = path.stat().st_size - file.tell()
            if size != count * dtype.itemsize:
                raise InputError(
                    f"{path}: the header promises {count} vertices of {dtype.itemsize} bytes but {size} bytes follow; "
                    "the file is cut off or damaged, write it again"
                )
            vertices = np.frombuffer(file.read(size), dtype)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error

    num_rest = _count_rest(dtype, path)
    splat = Splat(
        means=_columns(vertices, _CENTRE, path),
        quats=_columns(vertices, _ROTATION, path),
        log_scales=_columns(vertices, _SCALE, path),
        opacity_logits=_columns(vertices, ["opacity"], path)[:, 0],
        sh=torch.cat(
            [
                _columns(vertices, _COLOUR, path)[:, None],
                _columns(vertices, [f"f_rest_{i}" for i in range(num_rest)], path)
                .reshape(count, 3, num_rest // 3)
                .transpose(1, 2),
            ],
            dim=1,
        ),
    )
    norm = splat.quats.double().norm(dim=-1)
    if len(wrong := ((norm < 1 / _MOST_NORM) | (norm > _MOST_NORM)).nonzero()):
        vertex = int(wrong[0])
        given = " ".join(f"{x:g}" for x in splat.quats[vertex].tolist())
        raise InputError(f"{path}: the rotation of vertex {vertex} is {given}; give a quaternion of about unit length")
    if len(wrong := (splat.log_scales > _MOST_LOG_SCALE).nonzero()):
        vertex, axis = wrong[0].tolist()
        given = f"scale_{axis} of vertex {vertex} is {float(splat.log_scales[vertex, axis]):g}, a logarithm"
        raise InputError(f"{path}: {given}; remove Gaussians larger than exp({_MOST_LOG_SCALE:g})")
    return splat


def _read_header(file: BinaryIO, path: Path) -> tuple[int, np.dtype]:
    """The number of vertices and their layout; leaves the file at the first vertex."""
    count = None
    properties: list[tuple[str, str]] = []
    if file.readline(16).strip() != b"ply":
        raise InputError(f"{path}: does not begin with 'ply'; give a PLY file")
    if (form := _read_line(file, path)) != "format binary_little_endian 1.0":
        raise InputError(f"{path}: is '{form}' but must be 'format binary_little_endian 1.0'; convert it")
    while (line := _read_line(file, path)) != "end_header":
        match line.split():
            case ["comment" | "obj_info", *_] | []:
                pass
            case ["element", "vertex", number] if count is None and number.isascii() and number.isdigit():
                count = int(number)
            case ["property", kind, name] if count is not None and kind in _TYPES:
                properties.append((name, _TYPES[kind]))
            case _:
                raise InputError(f"{path}: header line '{line}' has no place in a splat; keep one element, vertex")
    names = [name for name, _ in properties]
    if count is None:
        raise InputError(f"{path}: the header has no element vertex; give a splat's PLY")
    if missing := [name for name in _REQUIRED if name not in names]:
        raise InputError(f"{path}: the vertices lack {', '.join(missing)}; give a 3D Gaussian Splatting PLY")
    if len(set(names)) < len(names):
        raise InputError(f"{path}: a property of the vertices is named twice in the header; write the file again")
    return count, np.dtype(properties)


def _read_line(file: BinaryIO, path: Path) -> str:
    line = file.readline(1024)
    if not line.endswith(b"\n") or file.tell() > _MAX_HEADER_BYTES:
        raise InputError(f"{path}: the header does not end (no 'end_header'); the file is cut off or no PLY")
    return line.decode("ascii", "replace").strip()


def _count_rest(dtype: np.dtype, path: Path) -> int:
    names = [name for name in dtype.names or () if name.startswith("f_rest_")]
    if len(names) not in _SH_DEGREE_OF_REST or set(names) != {f"f_rest_{i}" for i in range(len(names))}:
        raise InputError(
            f"{path}: has {len(names)} f_rest properties but spherical harmonics of degree 0 to 3 have "
            "f_rest_0 to f_rest_8, f_rest_23 or f_rest_44, or none; write them all"
        )
    return len(names)


def _columns(vertices: np.ndarray, names: list[str], path: Path) -> torch.Tensor:
    """Properties as float32 [N, len(names)], checked to be finite."""
    table = np.empty((len(vertices), len(names)), np.float32)
    for i, name in enumerate(names):
        with np.errstate(over="ignore"):
            table[:, i] = vertices[name]
        bad = np.flatnonzero(~np.isfinite(table[:, i]))
        if len(bad):
            value = vertices[name][bad[0]]
            raise InputError(f"{path}: {name} of vertex {bad[0]} is {value}; remove Gaussians that are not finite")
    return torch.from_numpy(table)
