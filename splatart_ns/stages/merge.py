"""Canonical part splats: each part from the state that shows it best, completed by what only other states show."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.geometry.se3 import inverse, matrix_from_quat
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.visibility import shown, visibility

SHOWN = 0.99
"""Gaussians beyond this share of a part's visibility are left out."""
COVERED = 3.0
"""A centre within so many standard deviations of a Gaussian is where that Gaussian already is."""


def merge_parts(
    splats: Sequence[Splat],
    views: Sequence[Sequence[View]],
    T: Tensor,
    known: Tensor | None = None,
    seen: Sequence[Tensor] | None = None,
) -> list[Splat]:
    """The splats of parts 1..P in the canonical frame, from all states.

    Args:
        splats: One labelled splat per state.
        views: Training views of each state; they decide which Gaussians are seen.
        T: Poses [S, P, 4, 4].
        known: Which of them were found [S, P] bool, by default all. A part is not taken from a state where its pose was
            not.
        seen: The `visibility` of each state's Gaussians, if it has been measured.

    Returns:
        One splat per part; empty for a part without Gaussians. Background and unseen Gaussians are gone.
    """
    seen = seen or [visibility(s, v) for s, v in zip(splats, views, strict=True)]
    footprint = _pixel_footprint([view for of_state in views for view in of_state])
    known = torch.ones(T.shape[:2], dtype=torch.bool) if known is None else known
    return [_merge_part(splats, seen, T[:, p], known[:, p], p + 1, footprint) for p in range(T.shape[1])]


def _pixel_footprint(views: Sequence[View]) -> float:
    """Median size of a pixel at the world's origin, length."""
    return float(torch.tensor([float(v.viewmat[:3, 3].norm() / v.K[0, 0]) for v in views]).median())


def _merge_part(
    splats: Sequence[Splat], seen: Sequence[Tensor], T: Tensor, known: Tensor, part: int, footprint: float
) -> Splat:
    pieces, amount = [], []
    for splat, visible, pose, found in zip(splats, seen, T, known, strict=True):
        visible = torch.where((splat.part_ids == part) & found.to(visible.device), visible, 0.0)
        pieces.append(splat.select(shown(visible, SHOWN) & (visible > 0)).detach().transformed(inverse(pose)))
        amount.append(float(visible.sum()))
    order = sorted(range(len(pieces)), key=lambda s: -amount[s])
    merged = pieces[order[0]]
    for s in order[1:]:
        merged = Splat.cat([merged, pieces[s].select(~covered(pieces[s].means, merged, footprint))])
    return merged


def covered(points: Tensor, splat: Splat, footprint: float) -> Tensor:
    """Which points [N, 3] lie within `COVERED` standard deviations of a Gaussian of `splat` [N] bool.

    The Gaussians count as blurred by `footprint`, length. Each point is tried against the nearest few.
    """
    if len(points) == 0 or len(splat) == 0:
        return torch.zeros(len(points), dtype=torch.bool, device=points.device)
    k = min(16, len(splat))
    nearest = cKDTree(splat.means.cpu().numpy()).query(points.cpu().numpy(), k=k)[1].reshape(-1, k)
    nearest = torch.from_numpy(nearest).to(points.device)
    axes = matrix_from_quat(splat.quats)[nearest]
    own = (axes.mT @ (points[:, None] - splat.means[nearest])[..., None])[..., 0]
    variance = splat.scales[nearest].square() + footprint**2
    return ((own.square() / variance).sum(-1) < COVERED**2).any(-1)
