"""A tray of boxes, as cameras see it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from part_scene import cameras

from splatart_ns.capture.view import View

FLOOR = (-0.5, -0.4, -0.3), (0.5, 0.4, -0.25)
WALLS = [
    ((-0.5, -0.4, -0.3), (-0.45, 0.4, 0.2)),
    ((0.45, -0.4, -0.3), (0.5, 0.4, 0.2)),
    ((-0.5, -0.4, -0.3), (0.5, -0.35, 0.2)),
    ((-0.5, 0.35, -0.3), (0.5, 0.4, 0.2)),
]
TRAY = [FLOOR, *WALLS]


def photograph(grey: Callable[[np.ndarray, np.ndarray], np.ndarray], count: int = 32, pixels: int = 128) -> list[View]:
    """What cameras see of the tray, cast exactly; `grey` [H, W] of places and normals [H, W, 3]."""
    K = torch.tensor([[1.8 * pixels, 0, pixels / 2], [0, 1.8 * pixels, pixels / 2], [0, 0, 1]])
    rows, columns = np.mgrid[:pixels, :pixels] + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(K.numpy().astype(float)).T
    views = []
    for k, viewmat in enumerate(cameras(count)):
        R, t = viewmat[:3, :3].double().numpy(), viewmat[:3, 3].double().numpy()
        eye, direction = -R.T @ t, rays @ R
        depth, normal = np.full(rows.shape, np.inf), np.zeros((*rows.shape, 3))
        for low, high in TRAY:
            with np.errstate(divide="ignore"):
                ends = (np.stack([low, high])[:, None, None] - eye) / direction
            enter, leave = ends.min(0), ends.max(0).min(-1)
            first = (enter.max(-1) < leave) & (enter.max(-1) < depth)
            depth = np.where(first, enter.max(-1), depth)
            side = np.eye(3)[enter.argmax(-1)]
            normal = np.where(first[..., None], -np.sign(direction) * side, normal)
        shown = np.isfinite(depth)
        x = eye + direction * np.where(shown, depth, 0)[..., None]
        image = np.where(shown, np.clip(grey(x, normal), 0, 255), 0).round().astype(np.uint8)
        alpha = torch.from_numpy(255 * shown.astype(np.uint8))
        rgb = torch.from_numpy(image)[..., None].repeat(1, 1, 3)
        views.append(View(f"{k:04d}", viewmat, K, pixels, pixels, rgb, alpha, labels=(alpha > 0).to(torch.uint8)))
    return views


def texture(points: np.ndarray) -> np.ndarray:
    """Grey of the tray's places [..., 3], less its mean, at contrast 1."""
    return sum(np.sin(points @ np.array(w)) for w in ((31, 17, 23), (-19, 37, 11), (13, -23, 41))) / 3


def textured(contrast: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """A texture of so many grey levels."""
    return lambda x, _: 128 + contrast * texture(x)


def to_tray(points: torch.Tensor) -> torch.Tensor:
    """Distance of points [N, 3] to the surface of the tray [N], from either side of it."""
    low, high = torch.tensor(TRAY).unbind(1)
    outside = torch.maximum(low - points[:, None], points[:, None] - high)
    beyond = outside.clamp_min(0).norm(dim=-1)
    return torch.where(beyond > 0, beyond, -outside.amax(-1)).amin(-1)
