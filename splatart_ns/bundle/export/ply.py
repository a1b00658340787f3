"""The Gaussians of all parts in one PLY, which opens in splat viewers; each Gaussian says its part."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.posing import normalized, posed_splat
from splatart_ns.capture.capture import Normalization
from splatart_ns.splats.ply import write_ply


def write_whole_ply(bundle: Bundle, name: str, scale: float, folder: Path) -> Path:
    """Write `<name>.ply`, in the canonical frame and metres, with the property `part`: the part's id."""
    splat = normalized(posed_splat(bundle, {}), Normalization(np.zeros(3), scale))
    ids = torch.cat([torch.full((len(part.splat),), part.id) for part in bundle.parts])
    path = folder / f"{name}.ply"
    write_ply(splat, path, parts=ids)
    return path
