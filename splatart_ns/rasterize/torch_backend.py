"""Alpha compositing of 2D Gaussians in plain torch: any device with float64, any float type, any number of channels.

The image is cut into tiles of 8x4 pixels, and every tile walks its own Gaussians from front to back, many layers of
many tiles at once. Over a tile the logarithm of a Gaussian's alpha is a quadratic polynomial of the pixel, so one
matrix product with the six monomials gives all exponents, and another one takes all gradients of the geometry back as
the six moments of the gradient image. What runs along a ray runs in two levels, layer after layer within blocks of
`LAYERS` and then over the blocks, so that no operation is small.

Compositing follows gsplat: alpha is at most 0.999, alphas below 1/255 are skipped, and a pixel stops before the
Gaussian that would take its transmittance to 1e-4 or less. Unlike gsplat 1.4.0, whose Gaussians end at three
standard deviations, a Gaussian ends exactly where its alpha falls below 1/255.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag, threshold_

from splatart_ns.rasterize.torch_binning import LAYERS, MAX_ALPHA, MIN_ALPHA, TILE_HEIGHT, TILE_WIDTH, Grid, Pairs

BLOCKS = 12
"""Most blocks of LAYERS pairs that a tile walks before tiles that are opaque are left."""
SLOTS = 8192
"""Pairs in one step for each of torch's threads, up to `MOST_THREADS` of them."""
MOST_THREADS = 4
KEPT_BYTES = 24 * 2**20
"""Alphas and weights that forward keeps for backward, which composes again what is beyond."""
MIN_TRANSMITTANCE = 1e-4
_PIXELS = TILE_HEIGHT * TILE_WIDTH


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colors: Tensor,
    depths: Tensor,
    visible: Tensor,
    width: int,
    height: int,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor]:
    """Composite projected Gaussians front to back over black.

    Args:
        means2d: Centres [C, N, 2], pixels; the first pixel's centre is (0.5, 0.5).
        conics: Inverse covariances [C, N, 3] as (xx, xy, yy), 1 / pixels^2.
        opacities: [C, N].
        colors: Any D channels [C, N, D].
        depths: Sort keys [C, N]; Gaussians of equal depth keep their order.
        visible: Which Gaussians to draw [C, N], bool; the others' values are not used.
        width, height: Image size.
        absgrad: Let backward set `means2d.absgrad` [C, N, 2], the sums over pixels of the absolute gradients (AbsGS).

    Returns:
        The image [C, H, W, D] and its alpha [C, H, W, 1], differentiable in means2d, conics, opacities and colors.
    """
    return _Rasterize.apply(means2d, conics, opacities, colors, depths, visible, width, height, absgrad)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, opacities, colors, depths, visible, width, height, absgrad):
        _reuse_pages()
        grid = Grid(width, height)
        keep_steps = any(ctx.needs_input_grad[:4])
        kept_bytes = KEPT_BYTES // max(len(means2d), 1)
        image = colors.new_empty(len(colors), height, width, colors.shape[-1])
        alpha = image.new_empty(*image.shape[:-1], 1)
        views = []
        for c, view in enumerate(zip(means2d, conics, opacities, colors, depths, visible, strict=True)):
            pairs = Pairs.find(*view, grid)
            values, steps = _composite(pairs, keep_steps, kept_bytes)
            image[c], alpha[c] = (grid.image(pairs.tiles, v) for v in (values[:, :-1], values[:, -1:]))
            views.append((pairs, steps))
        ctx.save_for_backward(means2d, opacities)
        ctx.grid, ctx.views, ctx.absgrad = grid, views, absgrad
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx, v_image, v_alpha):
        means2d, opacities = ctx.saved_tensors
        (C, N), D = opacities.shape, v_image.shape[-1]
        moments = v_image.new_empty(C, N, 7 + D + 2 * ctx.absgrad)
        for c, (pairs, steps) in enumerate(ctx.views):
            v_values = torch.cat([ctx.grid.values(pairs.tiles, v[c]) for v in (v_image, v_alpha)], 1)
            moments[c] = _backward(pairs, steps, v_values, N, ctx.absgrad)
        v_conics = moments[..., :3] * moments.new_tensor([-0.5, -1.0, -0.5])
        v_log = moments[..., 5]
        v_opacities = (v_log / opacities).where(v_log != 0, 0.0)  # what is not drawn may have any opacity, even 0
        if ctx.absgrad:
            means2d.absgrad = moments[..., 7 + D :]
        return moments[..., 3:5], v_conics, v_opacities, moments[..., 6 : 6 + D], None, None, None, None, None


@dataclass
class _Step:
    """Some layers of some tiles, and what backward needs of them."""

    tiles: Tensor
    """Which of the pairs' tiles [T]."""
    slots: Tensor
    """Their pairs [T, L], L = LAYERS * blocks."""
    columns: Tensor
    """See `Pairs.columns`."""
    incoming: Tensor
    """Transmittance in front of the step [T, pixels]."""
    stops: bool | None = None
    """Whether some pixel reaches its last Gaussian in this step; unknown before it is composed."""
    blended: tuple[Tensor, Tensor, Tensor] | None = None
    """What `blend` gave, where it is kept."""

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.slots), LAYERS, self.slots.shape[1] // LAYERS

    def blend(self, saturates: bool, alpha: Tensor, weight: Tensor, front: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Fills in alphas and weights [T, LAYERS, blocks, pixels]; returns them and what passes [T, blocks, pixels].

        front: Scratch [T, LAYERS + 1, blocks, pixels], for the transmittances.
        """
        basis = _monomials(alpha.dtype, alpha.device)
        torch.mm(self.columns[2:8].flatten(1).T, basis, out=alpha.view(-1, _PIXELS))
        threshold_(alpha.exp2_(), MIN_ALPHA, 0.0)
        if saturates:
            alpha.clamp_max_(MAX_ALPHA)
        layers = front.unbind(1)
        layers[0].fill_(1)
        for i, a in enumerate(alpha.unbind(1)):
            torch.addcmul(layers[i], layers[i], a, value=-1, out=layers[i + 1])
        passed = torch.cat([self.incoming[:, None], layers[-1]], 1).cumprod(1)
        front.mul_(passed[:, None, :-1])
        if self.stops is None:
            self.stops = bool(passed[:, -1].amin() <= MIN_TRANSMITTANCE)
        if self.stops:
            alpha.mul_(torch.gt(front[:, 1:], MIN_TRANSMITTANCE, out=weight))
        torch.mul(alpha, front[:, :-1], out=weight)
        return alpha, weight, passed[:, 1:]


class _Workspace:
    """Buffers for the largest step, shared by all steps: they fit the caches better than fresh ones."""

    def __init__(self, like: Tensor, buffers: int, slots: int) -> None:
        """slots: Of the largest step."""
        self.memory = like.new_empty(buffers, (slots + slots // LAYERS) * _PIXELS)

    def buffer(self, i: int, step: _Step, more: int = 0) -> Tensor:
        """View of a buffer [T, LAYERS + more, blocks, pixels]."""
        T, layers, blocks = step.shape
        shape = T, layers + more, blocks, _PIXELS
        return self.memory[i, : math.prod(shape)].view(shape)

    def blend(self, step: _Step, saturates: bool, first: int) -> tuple[Tensor, Tensor, Tensor]:
        """`step.blend` in the buffers `first` and the next, with the first of all as scratch."""
        alpha, weight = (self.buffer(i, step) for i in (first, first + 1))
        return step.blend(saturates, alpha, weight, self.buffer(0, step, 1))


def _batches(tiles: Tensor, counts: Tensor, slots: int) -> Iterator[tuple[Tensor, int]]:
    """Tiles for one step each of at most so many slots, and the blocks they need; counts of the pairs they have left,
    descending."""
    blocks_needed = counts.add(LAYERS - 1).div(LAYERS, rounding_mode="floor").clamp_max(BLOCKS).tolist()
    first = 0
    while first < len(tiles):
        blocks = blocks_needed[first]
        last = first + slots // (LAYERS * blocks)
        yield tiles[first:last], blocks
        first = last


def _composite(pairs: Pairs, keep_steps: bool, kept_bytes: int) -> tuple[Tensor, list[_Step]]:
    """Sums of weights times colours [tiles, channels, pixels], and the steps for backward."""
    image = pairs.table.new_zeros(len(pairs.tiles), len(pairs.table) - 8, _PIXELS)
    transmittance = image.new_ones(len(image), _PIXELS)
    most_slots = max(SLOTS * min(torch.get_num_threads(), MOST_THREADS), LAYERS * BLOCKS)
    workspace = _Workspace(image, 3, most_slots)
    room = 2 * _PIXELS * (len(pairs) + 2 * LAYERS * len(image))
    kept = image.new_empty(min(room, kept_bytes // image.element_size()) if keep_steps else 0)
    active, counts = torch.arange(len(image), device=image.device), pairs.counts
    steps, layer = [], 0
    while len(active):
        for tiles, blocks in _batches(active, counts, most_slots):
            slots = pairs.slots(tiles, layer, blocks)
            step = _Step(tiles, slots, pairs.columns(slots, tiles), transmittance[tiles])
            size = slots.numel() * _PIXELS
            if 2 * size <= len(kept):
                alpha, weight = kept[: 2 * size].view(2, *step.shape, _PIXELS)
                kept = kept[2 * size :]
                blended = step.blended = step.blend(pairs.saturates, alpha, weight, workspace.buffer(0, step, 1))
            else:
                blended = workspace.blend(step, pairs.saturates, 1)
            _, weight, passed = blended
            image.index_add_(0, tiles, torch.bmm(step.columns[8:].transpose(0, 1), weight.flatten(1, 2)))
            transmittance.index_copy_(0, tiles, passed[:, -1])
            if keep_steps:
                steps.append(step)
        layer += LAYERS * BLOCKS
        counts = counts - LAYERS * BLOCKS
        unfinished = (counts > 0) & (transmittance[active].amax(-1) > MIN_TRANSMITTANCE)
        active, counts = active[unfinished], counts[unfinished]
    return image, steps


def _backward(pairs: Pairs, steps: list[_Step], v_image: Tensor, N: int, absgrad: bool) -> Tensor:
    """Gradients of N Gaussians [N, 6 + channels (+ 2)], given those of the tiles [tiles, channels, pixels].

    Columns: the second moments of the gradient of log(alpha) about the centre (xx, xy, yy), the gradient of the centre,
    the zeroth moment; the gradients of the colours; the absolute gradients of the centre.
    """
    channels = v_image.shape[1]
    end = sum(step.slots.numel() for step in steps)
    rows = v_image.new_zeros(6 + channels + 2 * absgrad, end + 1)  # the last one is of the pairs that no step holds
    if not steps:
        return rows.new_zeros(N, len(rows))
    basis = _monomials(v_image.dtype, v_image.device)
    buffers = 3 if all(step.blended for step in steps) else 5
    workspace = _Workspace(v_image, buffers, max(step.slots.numel() for step in steps))
    behind = v_image.new_zeros(len(v_image), _PIXELS)
    later = v_image.new_ones(BLOCKS, BLOCKS).triu(1)
    for step in reversed(steps):
        T, L = step.slots.shape
        blocks = L // LAYERS
        alpha, weight, passed = step.blended or workspace.blend(step, pairs.saturates, 3)
        v_pixels = v_image[step.tiles]

        # With g_i the gradient along colour i and B_i that of all behind it blended, dL/dlog(alpha_i) = w_i (g_i - B_i)
        # and B_{i-1} = lerp(B_i, g_i, alpha_i), from back to front: nothing is divided by 1 - alpha. What a block sees
        # behind it is the sum of w g over all later ones, over the transmittance there; nothing more is drawn where
        # that is less than the least.
        g, B, wg = (workspace.buffer(i, step) for i in range(3))
        torch.bmm(step.columns[8:].permute(1, 2, 0), v_pixels, out=g.view(T, L, _PIXELS))
        sums = torch.mul(weight, g, out=wg).sum(1)
        after = torch.matmul(later[:blocks, :blocks], sums) + behind[step.tiles][:, None]
        behind.index_copy_(0, step.tiles, after[:, 0] + sums[:, 0])
        torch.div(after, passed.clamp_min(MIN_TRANSMITTANCE), out=B[:, -1])
        B_, g_, alpha_ = B.unbind(1), g.unbind(1), alpha.unbind(1)
        for i in range(LAYERS - 1, 0, -1):
            torch.lerp(B_[i], g_[i], alpha_[i], out=B_[i - 1])
        v_log = wg.addcmul_(weight, B, value=-1)
        if pairs.saturates:
            v_log.mul_(torch.lt(alpha, MAX_ALPHA, out=g))
        v_log = v_log.view(-1, _PIXELS)
        start = end - T * L
        torch.mm(basis, v_log.T, out=rows[:6, start:end])
        v_color = torch.bmm(v_pixels, weight.flatten(1, 2).transpose(1, 2))
        rows[6 : 6 + channels, start:end].view(channels, T, L).copy_(v_color.transpose(0, 1))
        if absgrad:
            rows[6 + channels :, start:end] = _absolute(step.columns[2:8].flatten(1), v_log, basis[3:], B)
        end = start

    # From moments about the tile's centre to the Gaussian's own.
    xx, xy, yy, x, y, one = rows[:6, :-1]
    cx, cy, a, cross, c, lx, ly = torch.cat([step.columns[:7].flatten(1) for step in steps], 1)
    x_, y_ = torch.addcmul(x, cx, one, value=-1), torch.addcmul(y, cy, one, value=-1)
    xx.addcmul_(cx, x + x_, value=-1)
    xy.addcmul_(cx, y, value=-1).addcmul_(cy, x_, value=-1)
    yy.addcmul_(cy, y + y_, value=-1)
    v_x = (lx * one).addcmul_(a, x, value=2).addcmul_(cross, y)
    v_y = (ly * one).addcmul_(c, y, value=2).addcmul_(cross, x)
    torch.mul(v_x, -math.log(2), out=x)
    torch.mul(v_y, -math.log(2), out=y)

    slots = torch.cat([step.slots.flatten() for step in steps])
    last = len(slots)
    places = slots.new_full((len(pairs) + 1,), last)
    places.scatter_(0, pairs.order.index_select(0, slots), torch.arange(last, device=slots.device))
    sums = embedding_bag(places[:-1], rows.T.contiguous(), pairs.starts, mode="sum")
    return rows.new_zeros(N, len(rows)).index_copy_(0, pairs.ids, sums)


def _absolute(coefficients: Tensor, v_log: Tensor, basis: Tensor, scratch: Tensor) -> Tensor:
    """Sums over pixels [2, M] of |dL/dx| and |dL/dy| of the centres; `basis` holds x, y, 1."""
    a, cross, c, lx, ly, _ = math.log(2) * coefficients
    sums = []
    for slope in ([2 * a, cross, lx], [cross, 2 * c, ly]):
        v = torch.mm(torch.stack(slope).T, basis, out=scratch.view(-1, _PIXELS))
        sums.append(v.mul_(v_log).norm(p=1, dim=-1))
    return torch.stack(sums)


@functools.cache
def _reuse_pages() -> None:
    """Has glibc keep freed memory for the next call: touching fresh pages costs more than the arithmetic in them.

    It keeps twice the size of the largest block that was ever freed, up to 32 MiB; nobody touches this one.
    """
    torch.empty(31 * 2**20, dtype=torch.uint8, device="cpu")


@functools.cache
def _monomials(dtype: torch.dtype, device: torch.device) -> Tensor:
    """x^2, x y, y^2, x, y and 1 at the pixels of a tile about its centre [6, pixels]."""
    sides = (torch.arange(size, dtype=dtype, device=device) - (size - 1) / 2 for size in (TILE_HEIGHT, TILE_WIDTH))
    y, x = (grid.flatten() for grid in torch.meshgrid(*sides, indexing="ij"))
    return torch.stack([x * x, x * y, y * y, x, y, torch.ones_like(x)])
