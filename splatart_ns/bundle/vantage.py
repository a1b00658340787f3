"""Where the cameras of a capture were: kept in the bundle's provenance, to tell what of a part nobody saw."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from splatart_ns.bundle.bundle import Bundle, Part
from splatart_ns.capture.capture import Capture
from splatart_ns.capture.worlds import in_one_world
from splatart_ns.geometry.se3 import inverse, transform_points

MOST = 300
"""Cameras that a bundle keeps, of all states together."""


def vantage_points(capture: Capture, worlds: np.ndarray) -> list[list[list[float]]]:
    """Positions of the training cameras [S][N][3] in the canonical world, an even choice of them.

    Rounded to about a ten thousandth of the object's radius. `worlds` [S, 4, 4]: the similarities that bring the worlds
    that the states came in into the canonical one.
    """
    placed = np.stack([state.placement for state in capture.states])
    capture = in_one_world(capture, worlds @ np.linalg.inv(placed))
    digits = 4 + math.floor(math.log10(capture.normalization.scale))
    most = max(1, MOST // len(capture.states))
    points = []
    for state in capture.states:
        frames = [frame for frame in state.frames if frame.split == "train"]
        frames = frames[:: -(-len(frames) // most) or 1]
        points.append([frame.T_world_camera[:3, 3].round(digits).tolist() for frame in frames])
    return points


def in_canonical_world(capture: Capture, bundle: Bundle) -> Capture:
    """The capture that a bundle was fitted to, with the worlds of its states brought into the canonical one."""
    return in_one_world(capture, bundle.provenance["worlds"]) if "worlds" in bundle.provenance else capture


def cameras_around(bundle: Bundle, part: Part) -> Tensor | None:
    """Where the cameras of all states were as seen from a part [N, 3] float64, in the canonical frame.

    None where the bundle does not say: versions before did not keep it.
    """
    if "cameras" not in bundle.provenance:
        return None
    states = [torch.tensor(points, dtype=torch.float64).reshape(-1, 3) for points in bundle.provenance["cameras"]]
    around = torch.cat([transform_points(inverse(T), x) for T, x in zip(part.motion, states, strict=True)])
    return around if len(around) else None
