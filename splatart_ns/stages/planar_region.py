"""Regions of one colour, in which stereo finds nothing: planes through what it finds around them.

Piecewise planar stereo: planes come from a region's border, and from the directions that other regions' planes have
(Furukawa et al., "Manhattan-world stereo", 2009). Which of them it is, if any, is told by all views: there the region
would look the same, before nothing that is found, and in front of everything else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from torch import Tensor

from splatart_ns.capture.hull import project
from splatart_ns.capture.seen_surface import SeenSurface, agreed, object_pixels, pixel_rays
from splatart_ns.capture.view import View

_EVEN = 18
"""Brightness (0..765) differs by less among a pixel of a region and its neighbours."""
_LEAST_CELLS = 9
_BORDER = 2
"""Cells around a region in which what is found may lie on its plane."""
_TRIES, _PLANES = 120, 4
"""Random planes through a border of which the best is taken, and how many are, one after the other."""
_NEAR = 0.004
"""What is so near to a plane, relative to its depth, lies on it."""
_LEAST_ON, _LEAST_SHARE = 6, 0.12
"""So much of a border, and so large a share of it, lies on a plane through it."""
_LEAST_AREA = 5.0
"""Of a triangle that makes a plane, cells."""
_COVERED = 0.3
"""So large a share of a region's cells has a place on a plane."""
_DIRECTIONS, _LEAST_WEIGHT, _SAME_DIRECTION = 6, 0.03, 0.995
"""Most directions, the least share of all cells that one has, and the least cosine within one."""
_OFFSETS, _LEAST_ON_PARALLEL = 2, 4
"""Planes of each direction that are tried, and how much of the border lies on them."""
_LIKE = 30
"""Places look alike whose brightness (0..765) differs by less. (20 and 40 tell right places of a fridge, a table and a
cupboard from wrong ones as well; with 80 half of the wrong ones pass.)"""
_OBLIQUE = 0.15
"""Least cosine between a plane's normal and the ray from the view in which it is found ..."""
_FACING = 0.2
"""... and to another that has a say."""
_HIDES, _BEHIND = 0.01, 0.02
"""What is found so much nearer than a place, relative to the depth, hides it; so much further away, it shows that
nothing is there ..."""
_PASSED = 2
"""... in so many views."""
_UNLIKE, _PLACE_UNLIKE = 0.2, 0.35
"""Share of the views to which a region may look otherwise, in the mean over its places, and each place."""


_Planes = Iterator[tuple[np.ndarray, np.ndarray]]
"""Planes, p [3] of the points with p x = 1 in the view's frame, and which of a region's cells each may hold [N]."""


@dataclass(frozen=True)
class _Region:
    """Cells of one view that show one colour and in which nothing was found, and what was found in and around it."""

    view: int
    number: int
    cells: np.ndarray
    """Column and row [N, 2]."""
    rays: np.ndarray
    """Through the cells' middle pixels [N, 3], 1 along the optical axis."""
    border: np.ndarray
    """Column and row of the cells where something was found [M, 2]."""
    border_rays: np.ndarray
    """[M, 3]."""
    border_depth: np.ndarray
    """[M]."""


@dataclass(frozen=True)
class _Piece:
    """Part of a region on a plane."""

    view: int
    number: int
    """The region's."""
    normal: Tensor
    """Towards the view, in its frame [3]."""
    row: Tensor
    """Of the cells [N]."""
    column: Tensor
    depth: Tensor
    """[N]."""

    def part(self, kept: Tensor) -> _Piece:
        """Of some of the cells [N] bool."""
        return replace(self, row=self.row[kept], column=self.column[kept], depth=self.depth[kept])


def with_planes(
    views: Sequence[View], others: Tensor, found: SeenSurface, normals: Tensor, near: Tensor, far: Tensor
) -> SeenSurface:
    """What stereo found, and planes over regions of one colour where it found nothing.

    Args:
        others: As in `agreed`, which decides about the planes' places as well.
        found: By stereo between the views.
        normals: Of what is found [V, h, w, 3], in the views' frames.
        near, far: Depths between which a cell's surface lies [V, h, w].
    """
    shown = [object_pixels(view) for view in views]
    numbers = [_numbers(view, here, found.stride, near.shape[1:]) for view, here in zip(views, shown, strict=True)]
    depth, normals = found.depth.clone(), normals.clone()
    pieces: list[_Piece] = []
    for parallel in (False, True):
        directions = _directions(pieces, views) if parallel else None
        done = {(piece.view, piece.number) for piece in pieces}
        tried = [
            piece
            for i, view in enumerate(views)
            for region in _regions(i, view, numbers[i], found)
            if (i, region.number) not in done
            for piece in _pieces(region, view, directions, near[i].numpy(), far[i].numpy())
        ]
        best = _best(tried, views, shown, found)
        for piece in best:
            depth[piece.view, piece.row, piece.column] = piece.depth
            normals[piece.view, piece.row, piece.column] = piece.normal
        pieces += best
        found = agreed(views, others, depth, normals, found.stride)
    return found


def _numbers(view: View, shown: Tensor, stride: int, shape: Sequence[int]) -> np.ndarray:
    """The region of each cell of a view [h, w], from 1 on; 0 where there is texture, or no object."""
    bright = view.rgb.sum(-1).numpy().astype(np.int16)
    even = ndimage.maximum_filter(bright, 3) - ndimage.minimum_filter(bright, 3) < _EVEN
    numbers = ndimage.label(even & ndimage.binary_erosion(shown.numpy(), np.ones((3, 3))))[0]
    of_cells = np.zeros(shape, np.int32)
    middle = numbers[stride // 2 :: stride, stride // 2 :: stride]
    of_cells[: middle.shape[0], : middle.shape[1]] = middle
    return of_cells


def _regions(index: int, view: View, numbers: np.ndarray, found: SeenSurface) -> Iterator[_Region]:
    """The regions of a view in which cells are blank and around which something is found."""
    depth, stride = found.depth[index].numpy(), found.stride
    known = np.isfinite(depth)

    def rays(cells: np.ndarray) -> np.ndarray:
        column, row = torch.from_numpy(stride * cells + stride // 2).unbind(-1)
        return pixel_rays(view, row, column).double().numpy()

    blank = np.bincount(numbers[~known])
    for number, box in enumerate(ndimage.find_objects(numbers), 1):
        if number >= len(blank) or blank[number] < _LEAST_CELLS:
            continue
        window = tuple(slice(max(side.start - _BORDER, 0), side.stop + _BORDER) for side in box)
        corner = window[1].start, window[0].start
        inside = numbers[window] == number
        around = ndimage.binary_dilation(inside, np.ones((3, 3)), iterations=_BORDER) & known[window]
        cells, border = (np.argwhere(which)[:, ::-1] + corner for which in (inside & ~known[window], around))
        if len(border) >= _LEAST_ON_PARALLEL:
            yield _Region(index, number, cells, rays(cells), border, rays(border), depth[border[:, 1], border[:, 0]])


def _pieces(
    region: _Region, view: View, directions: np.ndarray | None, near: np.ndarray, far: np.ndarray
) -> Iterator[_Piece]:
    """Planes over a region of a view: through its border, or of given `directions` [D, 3] in the world."""
    column, row = region.cells.T
    planes = _through(region, view) if directions is None else _parallel(region, directions @ _rotation(view).T)
    for plane, inside in planes:
        towards = region.rays @ plane
        depth = 1 / np.maximum(towards, 1e-6)
        inside = inside & (depth >= near[row, column]) & (depth <= far[row, column])
        facing = towards / (np.linalg.norm(region.rays, axis=1) * np.linalg.norm(plane))
        if inside.sum() >= max(_LEAST_CELLS, _COVERED * len(inside)) and facing.mean() > _OBLIQUE:
            at = (torch.from_numpy(x[inside]) for x in (row, column, depth.astype(np.float32)))
            yield _Piece(region.view, region.number, -F.normalize(torch.from_numpy(plane).float(), dim=0), *at)


def _through(region: _Region, view: View) -> _Planes:
    """Planes through much of the border, and the cells between what lies on them."""
    random = np.random.default_rng(region.view)
    rays, inverse, border = region.border_rays, 1 / region.border_depth, region.border
    least = max(_LEAST_ON, _LEAST_SHARE * len(border))
    for _ in range(_PLANES):
        if len(border) < least:
            return
        three = random.integers(len(border), size=(_TRIES, 3))
        sides = border[three[:, 1:]] - border[three[:, :1]]
        three = three[abs(np.linalg.det(sides)) > 2 * _LEAST_AREA]
        if len(three) == 0:
            return
        planes = np.linalg.solve(rays[three], inverse[three][..., None])[..., 0]
        on = abs(planes @ rays.T / inverse - 1) < _NEAR
        on = on[on.sum(1).argmax()]
        if on.sum() < least:
            return
        outline = cv2.convexHull(border[on].astype(np.int32))
        inside = np.zeros(np.maximum(border.max(0), region.cells.max(0))[::-1] + 1, np.uint8)
        cv2.fillConvexPoly(inside, outline, 1)
        yield np.linalg.lstsq(rays[on], inverse[on], rcond=None)[0], inside[tuple(region.cells.T[::-1])] > 0
        rays, inverse, border = rays[~on], inverse[~on], border[~on]


def _parallel(region: _Region, directions: np.ndarray) -> _Planes:
    """Planes of given normals [D, 3] in the view's frame through some of the border, over all cells."""
    near = 1.5 * _NEAR * region.border_depth.mean()
    for normal in directions:
        offset = region.border_depth * (region.border_rays @ normal)
        for _ in range(_OFFSETS):
            offset = np.sort(offset)
            first, end = (np.searchsorted(offset, offset + reach) for reach in (-near, near))
            if len(offset) == 0 or (most := end - first).max() < _LEAST_ON_PARALLEL:
                break
            at = offset[first[most.argmax()] : end[most.argmax()]].mean()
            yield normal / at, np.ones(len(region.cells), bool)
            offset = offset[abs(offset - at) >= 2 * near]


def _rotation(view: View) -> np.ndarray:
    """World to camera [3, 3]."""
    return view.viewmat[:3, :3].double().numpy()


def _directions(pieces: Sequence[_Piece], views: Sequence[View]) -> np.ndarray:
    """Normals that much of some pieces has in the world [D, 3], of whatever sign."""
    normals = np.array([piece.normal.double().numpy() @ _rotation(views[piece.view]) for piece in pieces])
    weight = np.array([len(piece.row) for piece in pieces], float)
    found: list[np.ndarray] = []
    least = _LEAST_WEIGHT * weight.sum()
    while len(weight) and len(found) < _DIRECTIONS:
        cosine = normals @ normals.T
        alike = abs(cosine) > _SAME_DIRECTION
        largest = (alike @ weight).argmax()
        if alike[largest] @ weight < least:
            break
        mean = (np.sign(cosine[largest]) * weight * alike[largest]) @ normals
        found.append(mean / np.linalg.norm(mean))
        normals, weight = normals[~alike[largest]], weight[~alike[largest]]
    return np.array(found).reshape(-1, 3)


def _best(pieces: Sequence[_Piece], views: Sequence[View], shown: Sequence[Tensor], found: SeenSurface) -> list[_Piece]:
    """Of each region the piece that looks most alike in all views, if it does; less the cells that do not."""
    if not pieces:
        return []
    best: dict[tuple[int, int], tuple[float, _Piece]] = {}
    counts = [len(piece.row) for piece in pieces]
    seen = (of_all.split(counts) for of_all in _seen(pieces, views, shown, found))
    for piece, unlike, passed in zip(pieces, *seen, strict=True):
        wrong = float(unlike.mean() + passed.float().mean())
        if wrong < best.get((piece.view, piece.number), (_UNLIKE,))[0]:
            best[piece.view, piece.number] = wrong, piece.part((unlike <= _PLACE_UNLIKE) & ~passed)
    return [piece for _, piece in best.values()]


def _seen(
    pieces: Sequence[_Piece], views: Sequence[View], shown: Sequence[Tensor], found: SeenSurface
) -> tuple[Tensor, Tensor]:
    """In which share of the views that would see them places look otherwise [N], and which views see past [N] bool."""
    places = (_places(piece, views[piece.view], found.stride) for piece in pieces)
    points, normals, bright = (torch.cat(column) for column in zip(*places, strict=True))
    like, unlike, passed = torch.zeros(3, len(points))
    for view, here, depth in zip(views, shown, found.depth, strict=True):
        column, row, z, inside = project(view, points)
        cell = row // found.stride, column // found.stride
        camera = -view.viewmat[:3, 3] @ view.viewmat[:3, :3]
        facing = inside & ((F.normalize(camera - points, dim=-1) * normals).sum(-1) > _FACING)
        nearest = -F.max_pool2d(-depth[None], 3, stride=1, padding=1)[0][cell]
        looking = facing & (nearest >= (1 - _HIDES) * z)
        same = here[row, column] & ((view.rgb[row, column].sum(-1).float() - bright).abs() < _LIKE)
        like += looking & same
        unlike += looking & ~same
        passed += facing & depth[cell].isfinite() & (depth[cell] > (1 + _BEHIND) * z)
    return unlike / (like + unlike).clamp_min(1), passed >= _PASSED


def _places(piece: _Piece, view: View, stride: int) -> tuple[Tensor, Tensor, Tensor]:
    """A piece's points in the world [N, 3], their normals [N, 3] and brightness [N]."""
    row, column = (stride * x + stride // 2 for x in (piece.row, piece.column))
    xyz = (pixel_rays(view, row, column) * piece.depth[:, None] - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]
    return xyz, (piece.normal @ view.viewmat[:3, :3]).expand_as(xyz), view.rgb[row, column].sum(-1).float()
