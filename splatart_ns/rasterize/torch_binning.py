"""Which tiles each Gaussian touches, and in what order, in plain torch: what `torch_backend` walks."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

TILE_WIDTH = 8
TILE_HEIGHT = 4
MAX_ALPHA = 0.999
MIN_ALPHA = 1 / 255
LAYERS = 8
"""Pairs of a tile that make a block."""
_FAR_BELOW = -1e4  # exponent of the empty slots: exp2 gives exactly 0


@dataclass(frozen=True)
class Grid:
    """The tiles of an image of some size, row by row."""

    width: int
    height: int

    @property
    def columns(self) -> int:
        return -(-self.width // TILE_WIDTH)

    @property
    def rows(self) -> int:
        return -(-self.height // TILE_HEIGHT)

    def centers(self, tiles: Tensor) -> Tensor:
        """Centres of some tiles [2, T], pixels."""
        row = tiles // self.columns
        column = tiles - row * self.columns
        return torch.stack([column * TILE_WIDTH + TILE_WIDTH // 2, row * TILE_HEIGHT + TILE_HEIGHT // 2])

    def image(self, tiles: Tensor, values: Tensor) -> Tensor:
        """The image [H, W, D] of some tiles' values [T, D, pixels], zero elsewhere."""
        lines = values.unflatten(-1, (TILE_HEIGHT, TILE_WIDTH)).permute(0, 2, 3, 1).flatten(2).flatten(0, 1)
        image = lines.new_zeros(self.rows * TILE_HEIGHT * self.columns, lines.shape[1])
        image.index_copy_(0, self._lines(tiles), lines)
        image = image.view(self.rows * TILE_HEIGHT, self.columns * TILE_WIDTH, values.shape[1])
        return image[: self.height, : self.width]

    def values(self, tiles: Tensor, image: Tensor) -> Tensor:
        """The inverse of `image`, zero outside the image."""
        D = image.shape[-1]
        image = pad(image, (0, 0, 0, -self.width % TILE_WIDTH, 0, -self.height % TILE_HEIGHT))
        lines = image.reshape(self.rows * TILE_HEIGHT * self.columns, TILE_WIDTH * D)
        lines = lines.index_select(0, self._lines(tiles))
        return lines.view(len(tiles), TILE_HEIGHT * TILE_WIDTH, D).transpose(1, 2).contiguous()

    def _lines(self, tiles: Tensor) -> Tensor:
        """Where the lines of some tiles [T * TILE_HEIGHT] are among those of all tiles, pixel row by pixel row."""
        first = tiles + tiles // self.columns * ((TILE_HEIGHT - 1) * self.columns)
        return (first[:, None] + torch.arange(TILE_HEIGHT, device=tiles.device) * self.columns).flatten()


@dataclass
class Pairs:
    """The M (tile, Gaussian) pairs of one view, tile after tile, near to far within a tile."""

    table: Tensor
    """The n Gaussians that are drawn, near to far [9 + D, n + 1]; one more draws nothing. x and y; log2(alpha) at
    (dx, dy) from there, a dx^2 + cross dx dy + c dy^2 + level = a (dx + slope dy)^2 + rest dy^2 + level, as a, cross,
    c, slope, rest and level; the colour; 1."""
    ranks: Tensor
    """The Gaussian of each pair [M + 1]; the last pair stands for an empty slot."""
    order: Tensor
    """Where each pair is [M + 1] when they are listed Gaussian after Gaussian."""
    starts: Tensor
    """Where each Gaussian's pairs start in that list [n]."""
    ids: Tensor
    """Indices of the Gaussians [n]."""
    tiles: Tensor
    """The tiles that have pairs, most pairs first."""
    begins: Tensor
    """The first pair of each of these tiles."""
    counts: Tensor
    """Their numbers of pairs."""
    origins: Tensor
    """Their centres [2, tiles], pixels."""
    saturates: bool
    """Whether some opacity exceeds MAX_ALPHA."""

    @staticmethod
    def find(means2d, conics, opacities, colors, depths, visible, grid: Grid) -> Pairs:
        """Pairs in which the Gaussian reaches alpha 1/255 on the tile; arguments [N, .] as of `rasterize_to_pixels`."""
        ids = (visible & (opacities >= MIN_ALPHA)).nonzero()[:, 0]
        ids = ids.index_select(0, _depth_order(depths.index_select(0, ids)))

        # q(x, y) = a (x + slope y)^2 + rest y^2, in float64 (which MPS lacks) because rest cancels for needles.
        # Alpha >= 1/255 where q <= reach; the slack makes culling err on the safe side.
        wide = means2d.dtype if means2d.device.type == "mps" else torch.float64
        a, b, c = conics.index_select(0, ids).to(wide).unbind(-1)
        mx, my = means2d.index_select(0, ids).to(wide).unbind(-1)
        opacity = opacities.index_select(0, ids).to(wide)
        slope = b / a
        rest = (c - b * slope).clamp_min(1e-12)
        reach = (1 + 1e-4) * 2 * (255 * opacity).log() + 1e-4

        # One entry per Gaussian and row of tiles that it touches, then per tile: the ellipse's edges within the row
        # are extremal at +-tip, or where the row ends.
        half = (reach / rest).sqrt()
        tip = slope * (reach / (rest * (rest / a + slope.square()))).sqrt()
        index, row, row_starts = _expand(*_span(my - half, my + half, grid.rows, TILE_HEIGHT))
        tip, slope_, x, low, width2, ratio = (
            v.to(means2d).index_select(0, index) for v in (tip, slope, mx, my - 0.5, reach / a, rest / a)
        )
        low = row * TILE_HEIGHT - low
        high = low + (TILE_HEIGHT - 1)
        left, right = (
            x - slope_ * y + side * (width2 - ratio * y * y).clamp_min(0).sqrt()
            for side, y in ((-1, tip.clamp(low, high)), (1, tip.neg().clamp(low, high)))
        )
        entry, column, starts = _expand(*_span(left, right, grid.columns, TILE_WIDTH))

        # Entries are in depth order, and a stable sort by tile keeps that.
        tile = (row * grid.columns).index_select(0, entry) + column
        order = _stable_argsort(tile, grid.rows * grid.columns)
        counts = torch.bincount(tile, minlength=grid.rows * grid.columns)
        ends = counts.cumsum(0)
        counts, tiles = counts.sort(descending=True)
        tiles = tiles[: int(counts.count_nonzero())]
        counts = counts[: len(tiles)]

        scale = -0.5 * math.log2(math.e)
        form = scale * a, 2 * scale * b, scale * c, slope, scale * rest, opacity.log2()
        table = torch.stack([mx, my, *form]).to(means2d)
        table = pad(torch.cat([table, colors.index_select(0, ids).T, torch.ones_like(table[:1])]), (0, 1))
        table[7, -1] = _FAR_BELOW
        return Pairs(
            table=table,
            ranks=pad(index.index_select(0, entry.index_select(0, order)), (0, 1), value=len(ids)),
            order=pad(order, (0, 1), value=len(order)),
            starts=pad(starts, (0, 1), value=len(entry)).index_select(0, row_starts),
            ids=ids,
            tiles=tiles,
            begins=ends.index_select(0, tiles) - counts,
            counts=counts,
            origins=grid.centers(tiles).to(means2d),
            saturates=bool((opacity > MAX_ALPHA).any()),
        )

    def __len__(self) -> int:
        return len(self.order) - 1

    def slots(self, tiles: Tensor, layer: int, blocks: int) -> Tensor:
        """Pairs of some of `tiles` [T, LAYERS * blocks] from a layer on, M where a tile has no more.

        Blocks of LAYERS pairs lie side by side, in the order [LAYERS, blocks]: that makes each layer of all blocks long
        runs of memory.
        """
        begins = self.begins[tiles, None]
        slots = begins + (_layers(blocks, begins.device) + layer)
        return slots.where(slots < begins + self.counts[tiles, None], len(self))

    def columns(self, slots: Tensor, tiles: Tensor) -> Tensor:
        """What compositing needs of pairs [T, L] of some of `tiles` [9 + D, T, L].

        These are the Gaussian's centre relative to the tile's (2); log2(alpha) over the tile as a polynomial, in the
        order of `torch_backend._monomials` (6); the colour, and 1, which composites to alpha.
        """
        ranks = self.ranks.index_select(0, slots.flatten())
        columns = self.table.index_select(1, ranks).unflatten(1, slots.shape)
        x, y, a, cross, _, slope, rest, level = columns[:8]
        columns[:2] -= self.origins[:, tiles, None]
        # The factored form keeps its digits where the coefficients of the polynomial are small differences.
        u = torch.addcmul(x, slope, y)
        au, ry = a * u, rest * y
        level.addcmul_(au, u).addcmul_(ry, y)
        torch.mul(au, -2, out=slope)
        torch.addcmul(ry.mul_(-2), cross, u, value=-1, out=rest)
        return columns


@functools.cache
def _layers(blocks: int, device: torch.device) -> Tensor:
    """The layers of some blocks [LAYERS * blocks] in the order of `Pairs.slots`."""
    return torch.arange(LAYERS * blocks, device=device).view(blocks, LAYERS).T.flatten()


def _span(low: Tensor, high: Tensor, count: int, size: int) -> tuple[Tensor, Tensor]:
    """First of `count` tiles with a pixel centre in [low, high], and the number of such tiles (0 when none)."""
    first = ((low - (size - 0.5)) / size).ceil().clamp(0, count)
    last = ((high - 0.5) / size).floor().clamp(-1, count - 1)
    return first.long(), (last - first + 1).clamp_min(0).long()


def _expand(first: Tensor, counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """For ranges first .. first + count - 1: the index of the range, and the value, of every element; the starts."""
    starts = counts.cumsum(0) - counts
    index = torch.repeat_interleave(counts)
    return index, torch.arange(len(index), device=index.device) + (first - starts).index_select(0, index), starts


def _depth_order(depths: Tensor) -> Tensor:
    if depths.dtype != torch.float32:
        return depths.argsort(stable=True)
    # The bits of a float order like the float, the negative ones backwards.
    bits = (depths + 0.0).view(torch.int32)
    bits = bits ^ (bits >> 31 & 0x7FFFFFFF)
    return _stable_argsort(bits.long() + 2**31, 2**32)


def _stable_argsort(keys: Tensor, end: int) -> Tensor:
    """Order of integers in [0, end). On a CPU numpy's radix sort of 16 bits is many times faster than torch's sort."""
    if keys.device.type != "cpu":
        return keys.argsort(stable=True)
    keys = keys.numpy()
    order = np.argsort(keys.astype(np.uint16), kind="stable")
    for shift in range(16, (end - 1).bit_length(), 16):
        order = order[np.argsort((keys >> shift).astype(np.uint16)[order], kind="stable")]
    return torch.from_numpy(order)
