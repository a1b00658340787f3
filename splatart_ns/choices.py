"""What commands, batches and the library let people choose from; light, so that `--help` is quick."""

from __future__ import annotations

from typing import Any, Literal

from splatart_ns.errors import InputError

Quality = Literal["draft", "standard", "high"]
Rasterizer = Literal["auto", "torch", "numba", "gsplat"]
Worlds = Literal["shared", "rigid", "similar"]
"""How the states' worlds differ: not at all, by a rigid motion (a device measured lengths), or by one with a scale."""
RefineCameras = Literal["auto", "on", "off"]
Views = Literal["sphere", "hemisphere"]
"""From where an object is looked at."""
Channel = Literal["rgb", "depth", "accumulation", "parts"]
"""What a picture shows."""
Format = Literal["urdf", "mjcf", "usd", "glb", "ply", "html"]
"""Of exports."""


def require_seed(seed: Any, what: str = "--seed") -> None:
    """Raises InputError for anything but a whole number below 2^32."""
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**32:
        raise InputError(f"{what} is {seed!r}; give 0 to {2**32 - 1}.")


def require_downscale(downscale: Any, what: str = "--downscale") -> None:
    """Raises InputError for anything but a whole number above 0, or None."""
    if downscale is not None and (isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1):
        raise InputError(f"{what} is {downscale!r}; give 1 or more, or leave it out.")
