"""Textures made by code, and how they are laid on a solid."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

Colour = tuple[int, int, int]

_BORDER = 4
"""Texels repeated about each cell, so that neither filter nor mipmap reaches into the next one."""

_ACROSS = ((1, 1.0), (0, -1.0), (0, 1.0))
"""By the axis along which one looks: the axis that runs to the right seen from its positive end, and its sign."""


def lay_out(
    corners: np.ndarray, palette: Sequence[Colour], grain: float, texel: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Paint a solid from its six sides.

    Args:
        corners: triangles [F, 3, 3].
        palette: RGB, three colours of the ground and one of the marks on it.
        grain: the size of the pattern's features, length.
        texel: length of a texel.

    Returns:
        The texture [H, W, 3] uint8, six cells side by side, and texture coordinates [F, 3, 2].
    """
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normals).argmax(axis=-1)
    positive = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0.0

    cells, pixels, left = [], np.empty((len(corners), 3, 2)), 0
    for k in range(3):
        u, sign = _ACROSS[k]
        v = 3 - k - u
        width, height = (max(int(round((high[a] - low[a]) / texel)), 8) for a in (u, v))
        for side in (False, True):
            cells.append(_framed(paint(width, height, palette, grain / texel, rng)))
            mine = (axis == k) & (positive == side)
            x = (corners[mine][..., u] - low[u]) / (high[u] - low[u])
            y = (corners[mine][..., v] - low[v]) / (high[v] - low[v])
            x = x if (sign > 0.0) == side else 1.0 - x
            pixels[mine] = np.stack([left + _BORDER + x * width, _BORDER + (1.0 - y) * height], axis=-1)
            left += width + 2 * _BORDER
    texture = np.zeros((max(c.shape[0] for c in cells), left, 3), dtype=np.uint8)
    left = 0
    for cell in cells:
        texture[: cell.shape[0], left : left + cell.shape[1]] = cell
        left += cell.shape[1]
    uv = pixels / (texture.shape[1], texture.shape[0])
    uv[..., 1] = 1.0 - uv[..., 1]
    return texture, uv


def paint(width: int, height: int, palette: Sequence[Colour], grain: float, rng: np.random.Generator) -> np.ndarray:
    """A picture [height, width, 3] uint8: blotches of three colours, with a patch of stripes, checks or dots on them.

    Args:
        palette: RGB, three colours of the ground and one of the marks.
        grain: size of the features in pixels.
    """
    field = _noise(width, height, 3.0 * grain, rng) + 0.6 * _noise(width, height, 1.4 * grain, rng)
    rank = (field > np.quantile(field, 0.42)).astype(int) + (field > np.quantile(field, 0.76))
    ground = np.asarray(palette[:3], dtype=np.float32)[rank]
    ground *= (1.0 + 0.12 * _noise(width, height, 0.5 * grain, rng))[..., None]

    y, x = np.mgrid[:height, :width].astype(np.float32)
    centre = rng.uniform(0.25, 0.75, 2) * (width, height)
    turn = rng.uniform(0.0, np.pi)
    a = np.cos(turn) * (x - centre[0]) + np.sin(turn) * (y - centre[1])
    b = np.cos(turn) * (y - centre[1]) - np.sin(turn) * (x - centre[0])
    reach = rng.uniform(0.2, 0.34) * min(max(width, height), 3 * min(width, height))
    kind = rng.integers(3)
    if kind == 0:
        marks = (np.maximum(np.abs(a), np.abs(b)) < reach) & (np.floor(a / grain) % 2 == 0)
    elif kind == 1:
        checks = (np.floor(a / (1.3 * grain)) + np.floor(b / (1.3 * grain))) % 2 == 0
        marks = (np.maximum(np.abs(a), np.abs(b)) < reach) & checks
    else:
        step = 2.2 * grain
        dots = np.hypot(a % step - 0.5 * step, b % step - 0.5 * step) < 0.75 * grain
        marks = (np.hypot(a, b) < 1.2 * reach) & dots
    ground[marks] = palette[3]
    return np.clip(cv2.GaussianBlur(ground, (0, 0), 0.8), 0, 255).astype(np.uint8)


def _noise(width: int, height: int, size: float, rng: np.random.Generator) -> np.ndarray:
    """Smooth noise [height, width] of unit deviation, its features about `size` pixels wide."""
    coarse = rng.standard_normal((int(np.ceil(height / size)) + 3, int(np.ceil(width / size)) + 3))
    shape = (int(np.ceil(coarse.shape[1] * size)), int(np.ceil(coarse.shape[0] * size)))
    fine = cv2.resize(coarse.astype(np.float32), shape, interpolation=cv2.INTER_CUBIC)
    fine = fine[int(size) : int(size) + height, int(size) : int(size) + width]
    return (fine - fine.mean()) / max(float(fine.std()), 1e-6)


def _framed(image: np.ndarray) -> np.ndarray:
    return cv2.copyMakeBorder(image, *[_BORDER] * 4, cv2.BORDER_REPLICATE)
