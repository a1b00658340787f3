"""Alpha compositing of 2D Gaussians in plain torch: any device with float64, any float type, any number of channels.

The image is cut into tiles of 8x8 pixels, and every tile walks its own Gaussians from front to back, `LAYERS` at a
time and many tiles at once. Over a tile the logarithm of a Gaussian's alpha is a quadratic polynomial of the pixel,
so one matrix product with the six monomials gives all exponents, and another one takes all gradients of the geometry
back as the six moments of the gradient image. Backward recomputes what forward composed: that is cheaper than
touching fresh memory.

Compositing follows gsplat: alpha is at most 0.999, alphas below 1/255 are skipped, and a pixel stops before the
Gaussian that would take its transmittance to 1e-4 or less. Unlike gsplat 1.4.0, whose Gaussians end at three
standard deviations, a Gaussian ends exactly where its alpha falls below 1/255.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad, threshold_

TILE = 8
LAYERS = 24
TILES_PER_STEP = 512
MAX_ALPHA = 0.999
MIN_ALPHA = 1 / 255
MIN_TRANSMITTANCE = 1e-4
_PIXELS = TILE * TILE
_FAR_BELOW = -1e4  # exponent of the empty slots: exp2 gives exactly 0


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
        keep_steps = any(ctx.needs_input_grad[:4])
        views, images = [], []
        for view in zip(means2d, conics, opacities, colors, depths, visible, strict=True):
            *geometry, color, depth, mask = view
            pairs = _Pairs.find(*geometry, depth, mask, width, height)
            tiles, steps = _composite(pairs, _with_ones(color), keep_steps)
            images.append(_untile(tiles, width, height))
            views.append((pairs, steps))
        ctx.save_for_backward(means2d, conics, opacities, colors)
        ctx.views, ctx.absgrad = views, absgrad
        image = torch.stack(images)
        return image[..., :-1].contiguous(), image[..., -1:].contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx, v_image, v_alpha):
        means2d, _, opacities, colors = ctx.saved_tensors
        D = colors.shape[-1]
        gradients = []
        for c, (pairs, steps) in enumerate(ctx.views):
            v_tiles = _tile(torch.cat([v_image[c], v_alpha[c]], -1))
            gradients.append(_backward(pairs, steps, _with_ones(colors[c]), v_tiles, ctx.absgrad))
        moments = torch.stack(gradients)
        v_colors = moments[..., 6 : 6 + D]
        v_conics = moments[..., :3] * moments.new_tensor([-0.5, -1.0, -0.5])
        v_log = moments[..., 5]
        v_opacities = (v_log / opacities).where(v_log != 0, 0.0)  # what is not drawn may have any opacity, even 0
        if ctx.absgrad:
            means2d.absgrad = moments[..., 7 + D :]
        return moments[..., 3:5], v_conics, v_opacities, v_colors, None, None, None, None, None


@dataclass
class _Pairs:
    """The M (tile, Gaussian) pairs of one view, tile after tile, near to far within a tile."""

    gaussians: Tensor
    """Index of the Gaussian [M + 1]; the last pair stands for an empty slot and draws nothing."""
    centers: Tensor
    """The Gaussian's centre relative to the tile's [2, M], pixels."""
    coefficients: Tensor
    """log2(alpha) over the tile as a polynomial [6, M + 1], in the order of `_monomials`."""
    starts: Tensor
    """First pair of every tile, and M [tiles + 1]."""
    saturates: bool
    """Whether some opacity exceeds MAX_ALPHA."""

    @staticmethod
    def find(means2d, conics, opacities, depths, visible, width, height) -> _Pairs:
        columns, rows = -(-width // TILE), -(-height // TILE)
        ids = (visible & (opacities >= MIN_ALPHA)).nonzero()[:, 0]
        ids = ids.index_select(0, _stable_argsort(depths.index_select(0, ids)))

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
        index, row = _expand(*_span(my - half, my + half, rows))
        tip, slope_, x, low, width2, ratio = (
            v.to(means2d).index_select(0, index) for v in (tip, slope, mx, my - 0.5, reach / a, rest / a)
        )
        low = row * TILE - low
        high = low + (TILE - 1)
        left, right = (
            x - slope_ * y + side * (width2 - ratio * y * y).clamp_min(0).sqrt()
            for side, y in ((-1, tip.clamp(low, high)), (1, tip.neg().clamp(low, high)))
        )
        entry, column = _expand(*_span(left, right, columns))

        # Ranks are in depth order, so sorting (tile, rank) sorts each tile near to far.
        bits = len(ids).bit_length()
        keys = _sort(((row * columns << bits) + index).index_select(0, entry) + (column << bits))
        tile, rank = keys >> bits, keys & ((1 << bits) - 1)
        counts = torch.bincount(tile, minlength=rows * columns)

        # log2(alpha) over the tile, expanded about the tile's centre from the factored form, which keeps its digits.
        scale = -0.5 * math.log2(math.e)
        a, cross, c, slope, rest, level, mx, my = (
            v.to(means2d).index_select(0, rank)
            for v in (scale * a, 2 * scale * b, scale * c, slope, scale * rest, opacity.log2(), mx, my)
        )
        row = tile // columns
        x = mx - ((tile - row * columns) * TILE + TILE // 2)
        y = my - (row * TILE + TILE // 2)
        u = x + slope * y
        au, ry = a * u, rest * y
        coefficients = torch.stack([a, cross, c, -2 * au, -cross * u - 2 * ry, au * u + ry * y + level])
        empty = coefficients.new_tensor([0, 0, 0, 0, 0, _FAR_BELOW])
        return _Pairs(
            gaussians=torch.cat([ids.index_select(0, rank), ids[:1]]),
            centers=torch.stack([x, y]),
            coefficients=torch.cat([coefficients, empty[:, None]], 1),
            starts=pad(counts.cumsum(0), (1, 0)),
            saturates=bool((opacity > MAX_ALPHA).any()),
        )

    def __len__(self) -> int:
        return self.centers.shape[1]

    def slots(self, tiles: Tensor, layer: int) -> Tensor:
        """Pairs in the next LAYERS layers of some tiles [T * LAYERS], M where a tile has no more."""
        first, end = self.starts[tiles] + layer, self.starts[tiles + 1]
        index = first[:, None] + torch.arange(LAYERS, device=tiles.device)
        return index.where(index < end[:, None], len(self)).flatten()


@dataclass
class _Step:
    """What backward needs of one step of the forward pass."""

    tiles: Tensor
    """Indices of the tiles [T]."""
    slots: Tensor
    """Their pairs [T * LAYERS]."""
    transmittance: Tensor
    """Transmittance in front of the step [T, 64]."""
    stops: bool
    """Whether some pixel reaches its last Gaussian in this step."""


class _Workspace:
    """Buffers for the largest step, shared by all steps: touching fresh memory costs more than the arithmetic in it.

    They are one allocation because glibc then keeps its pages from call to call; several would be given back.
    """

    def __init__(self, pairs: _Pairs, tiles: int, buffers: int) -> None:
        self.basis = _monomials(pairs.coefficients)
        self.memory = self.basis.new_empty(buffers + 1, tiles * (LAYERS + 1) * _PIXELS)

    def layer(self, buffer: int, tiles: int, layers: int = LAYERS) -> Tensor:
        """View of a buffer [T, layers, 64]."""
        return self.memory[buffer, : tiles * layers * _PIXELS].view(tiles, layers, _PIXELS)

    def blend(self, pairs: _Pairs, slots: Tensor, incoming: Tensor, stops: bool | None):
        """Alphas and weights [T, LAYERS, 64], the transmittance behind [T, 64], and whether some pixel stops here."""
        tiles = len(incoming)
        alpha, weight = self.layer(0, tiles), self.layer(1, tiles)
        T = self.layer(-1, tiles, LAYERS + 1)
        torch.mm(pairs.coefficients.index_select(1, slots).T, self.basis, out=alpha.view(-1, _PIXELS))
        threshold_(alpha.exp2_(), MIN_ALPHA, 0.0)
        if pairs.saturates:
            alpha.clamp_max_(MAX_ALPHA)
        T[:, 0] = incoming
        layers = T.unbind(1)
        for layer, a in enumerate(alpha.unbind(1)):
            torch.addcmul(layers[layer], layers[layer], a, value=-1, out=layers[layer + 1])
        torch.mul(alpha, T[:, :-1], out=weight)
        outgoing = layers[-1].clone()
        if stops is None:
            stops = bool(outgoing.amin() <= MIN_TRANSMITTANCE)
        if stops:
            drawn = T[:, 1:].gt_(MIN_TRANSMITTANCE)
            weight.mul_(drawn)
            alpha.mul_(drawn)
        return alpha, weight, outgoing, stops


def _composite(pairs: _Pairs, colors: Tensor, keep_steps: bool) -> tuple[Tensor, list[_Step]]:
    """Sums of weights times colours [tiles, channels, 64], and the steps for backward."""
    counts = pairs.starts.diff()
    image = colors.new_zeros(len(counts), colors.shape[-1], _PIXELS)
    transmittance = colors.new_ones(len(counts), _PIXELS)
    active = counts.nonzero()[:, 0]
    workspace = _Workspace(pairs, min(len(active), TILES_PER_STEP), 2)
    steps, layer = [], 0
    while len(active):
        for tiles in active.split(TILES_PER_STEP):
            slots = pairs.slots(tiles, layer)
            incoming = transmittance[tiles]
            _, weight, outgoing, stops = workspace.blend(pairs, slots, incoming, None)
            color = colors.index_select(0, pairs.gaussians.index_select(0, slots)).view(len(tiles), LAYERS, -1)
            image.index_add_(0, tiles, torch.bmm(color.transpose(1, 2), weight))
            transmittance[tiles] = outgoing
            if keep_steps:
                steps.append(_Step(tiles, slots, incoming, stops))
        layer += LAYERS
        unfinished = (counts[active] > layer) & (transmittance[active].amax(-1) > MIN_TRANSMITTANCE)
        active = active[unfinished]
    return image, steps


def _backward(pairs: _Pairs, steps: list[_Step], colors: Tensor, v_image: Tensor, absgrad: bool) -> Tensor:
    """Gradients of the Gaussians [N, 6 + channels (+ 2)].

    Columns: the second moments of the gradient of log(alpha) about the centre (xx, xy, yy), the gradient of the centre,
    the zeroth moment; the gradients of the colours; the absolute gradients of the centre.
    """
    channels = colors.shape[-1]
    rows = colors.new_zeros(len(pairs) + 1, 6 + channels + 2 * absgrad)
    workspace = _Workspace(pairs, max((len(s.tiles) for s in steps), default=0), 4)
    moment_basis = pad(workspace.basis.T, (0, 10)).contiguous()  # 16 columns are twice as fast as 6
    behind = colors.new_zeros(len(v_image), _PIXELS)
    for step in reversed(steps):
        count = len(step.tiles)
        alpha, weight, _, _ = workspace.blend(pairs, step.slots, step.transmittance, step.stops)
        color = colors.index_select(0, pairs.gaussians.index_select(0, step.slots)).view(count, LAYERS, channels)
        v_pixels = v_image[step.tiles]

        # With g_i the gradient along colour i and B_i that of all behind it blended, dL/dlog(alpha_i) = w_i (g_i - B_i)
        # and B_{i-1} = lerp(B_i, g_i, alpha_i), from back to front: nothing is divided by 1 - alpha.
        g = torch.bmm(color, v_pixels, out=workspace.layer(2, count))
        B = workspace.layer(3, count)
        B[:, -1] = behind[step.tiles]
        B_, g_, alpha_ = B.unbind(1), g.unbind(1), alpha.unbind(1)
        for i in range(LAYERS - 1, 0, -1):
            torch.lerp(B_[i], g_[i], alpha_[i], out=B_[i - 1])
        behind[step.tiles] = torch.lerp(B_[0], g_[0], alpha_[0])
        v_color = torch.bmm(weight, v_pixels.transpose(1, 2)).view(-1, channels)
        v_log = g.sub_(B).mul_(weight)
        if pairs.saturates:
            v_log.mul_(alpha.lt_(MAX_ALPHA))
        v_log = v_log.view(-1, _PIXELS)
        parts = [torch.mm(v_log, moment_basis)[:, :6], v_color]
        if absgrad:
            parts += _absolute(pairs.coefficients.index_select(1, step.slots), v_log, workspace.basis[3:], B)
        rows.index_copy_(0, step.slots, torch.cat(parts, -1))

    # From moments about the tile's centre to the Gaussian's own.
    xx, xy, yy, x, y, one = rows[:-1, :6].T.contiguous()
    cx, cy = pairs.centers
    a, cross, c, lx, ly, _ = math.log(2) * pairs.coefficients[:, :-1]
    x_, y_ = x - cx * one, y - cy * one
    rows[:-1, :5] = torch.stack(
        [
            xx - cx * (x + x_),
            xy - cx * y - cy * x_,
            yy - cy * (y + y_),
            -(2 * a * x + cross * y + lx * one),
            -(cross * x + 2 * c * y + ly * one),
        ]
    ).T
    return colors.new_zeros(len(colors), rows.shape[1]).index_add_(0, pairs.gaussians[: len(pairs)], rows[:-1])


def _absolute(coefficients: Tensor, v_log: Tensor, basis: Tensor, scratch: Tensor) -> list[Tensor]:
    """Sums over pixels [M, 1] of |dL/dx| and |dL/dy| of the centres; `basis` holds x, y, 1."""
    a, cross, c, lx, ly, _ = math.log(2) * coefficients
    sums = []
    for slope in ([2 * a, cross, lx], [cross, 2 * c, ly]):
        v = torch.mm(torch.stack(slope).T, basis, out=scratch.view(-1, _PIXELS))
        sums.append(v.mul_(v_log).norm(p=1, dim=-1, keepdim=True))
    return sums


def _span(low: Tensor, high: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """First tile of `count` with a pixel centre in [low, high], and the number of such tiles (0 when none)."""
    first = ((low - (TILE - 0.5)) / TILE).ceil().clamp(0, count)
    last = ((high - 0.5) / TILE).floor().clamp(-1, count - 1)
    return first.long(), (last - first + 1).clamp_min(0).long()


def _expand(first: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """For ranges first .. first + count - 1: the index of the range, and the value, of every element."""
    ends = counts.cumsum(0)
    index = torch.repeat_interleave(counts)
    offset = first - ends + counts
    return index, torch.arange(len(index), device=index.device) + offset.index_select(0, index)


def _stable_argsort(values: Tensor) -> Tensor:
    if values.dtype != torch.float32:
        return values.argsort(stable=True)
    # Sorting (value, index) as one integer is several times faster on a CPU. The bits of a float order like the float,
    # the negative ones backwards.
    bits = (values + 0.0).view(torch.int32)
    bits = bits ^ (bits >> 31 & 0x7FFFFFFF)
    return _sort((bits.long() << 32) + torch.arange(len(bits), device=bits.device)) & 0xFFFFFFFF


def _sort(keys: Tensor) -> Tensor:
    """Sorted keys; numpy is faster than torch on a CPU."""
    if keys.device.type != "cpu":
        return keys.sort().values
    keys.numpy().sort()
    return keys


def _monomials(like: Tensor) -> Tensor:
    """x^2, x y, y^2, x, y and 1 at the pixels of a tile about its centre [6, 64]."""
    offsets = torch.arange(TILE, dtype=like.dtype, device=like.device) - (TILE - 1) / 2
    y, x = (grid.flatten() for grid in torch.meshgrid(offsets, offsets, indexing="ij"))
    return torch.stack([x * x, x * y, y * y, x, y, torch.ones_like(x)])


def _with_ones(colors: Tensor) -> Tensor:
    """Colours with one channel more, which composites to alpha."""
    return pad(colors, (0, 1), value=1.0)


def _untile(tiles: Tensor, width: int, height: int) -> Tensor:
    """Tiles [tiles, channels, 64] as an image [H, W, channels]."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    image = tiles.view(rows, columns, -1, TILE, TILE).permute(0, 3, 1, 4, 2)
    return image.reshape(rows * TILE, columns * TILE, -1)[:height, :width]


def _tile(image: Tensor) -> Tensor:
    """The inverse of `_untile`, zero outside the image."""
    height, width, channels = image.shape
    image = pad(image, (0, 0, 0, -width % TILE, 0, -height % TILE))
    rows, columns = image.shape[0] // TILE, image.shape[1] // TILE
    tiles = image.view(rows, TILE, columns, TILE, channels).permute(0, 2, 4, 1, 3)
    return tiles.reshape(rows * columns, channels, _PIXELS)
