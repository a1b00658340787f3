"""Compositing of the pairs of each tile, front to back, and its gradient, back to front.

A tile's 64 pixels lie side by side in one small workspace, at fixed offsets, so that every inner loop runs over them in
vector registers: LLVM vectorises them only where it sees that nothing overlaps and that no index is negative. The loops
leave out the bands of rows that a Gaussian does not reach, a third where it is small. The first four channels of colour
share the loops of the geometry; each further group of four has one loop of its own.
"""

from __future__ import annotations

import math

import numpy as np

from splatart_ns.rasterize.numba_binning import BAND_ROWS, PIXELS, TILE
from splatart_ns.rasterize.numba_runtime import jit

GROUP = 4
"""Channels per loop: their number is padded to a multiple of it."""

_LOG2_ALPHA_MIN = np.float32(math.log2(1 / 255))
_LOG2_ALPHA_MAX = np.float32(math.log2(0.999))
_LN_2 = math.log(2)
_T_MIN = np.float32(1e-4)
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
# Near-minimax fit of 2^f for f in [0, 1], relative error 7.5e-8.
_E0, _E1, _E2 = np.float32(0.9999999250636943), np.float32(0.6931530731907609), np.float32(0.24015361712565741)
_E3, _E4, _E5 = np.float32(0.05582631781272315), np.float32(0.00898934037714072), np.float32(0.0018775765567582148)

# Offsets in the workspace of a tile: the pixels' coordinates, transmittance, weight and alpha of a pair, and two planes
# for what a kernel needs besides; the channels' planes come last.
_X, _Y, _T, _W, _A, _B, _V, _COLOR = (i * PIXELS for i in range(8))


@jit
def _alpha(log2_alpha):
    """2^log2_alpha, cut to 0 below 1/255 and to 0.999."""
    exponent = min(max(log2_alpha, np.float32(-9)), _LOG2_ALPHA_MAX)
    whole = np.floor(exponent)
    f = exponent - whole
    power = ((((_E5 * f + _E4) * f + _E3) * f + _E2) * f + _E1) * f + _E0
    scale = np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)
    return power * scale if log2_alpha >= _LOG2_ALPHA_MIN else _ZERO


@jit
def _at_tile(coefficients, left, top):
    """u0, y0, f, s, h, k, such that log2(alpha) = f (u0 + x + s y)^2 + h (y0 + y)^2 + k in the tile's coordinates x, y.

    For needles u0 is a small difference: it is taken in float64.
    """
    x, y, f, s, h, k = coefficients
    u0 = (left - x) + s * (top - y)
    return np.float32(u0), np.float32(top - y), np.float32(f), np.float32(s), np.float32(h), np.float32(k)


@jit
def _touched(bands):
    """The first pixel of a tile, and one past the last, of a pair's `Bins.bands`."""
    return BAND_ROWS * TILE * np.int64(bands >> 4), BAND_ROWS * TILE * np.int64(bands & 15)


@jit
def _aligned(count):
    """Uninitialised floats from the start of a cache line on, so that vectors of 64 bytes straddle none."""
    floats = np.empty(count + 16, np.float32)
    start = (-floats.ctypes.data % 64) // 4
    return floats[start : start + count]


@jit
def _start_tile(work):
    """Fills in the tile-local pixel coordinates and full transmittance."""
    for p in range(PIXELS):
        work[_X + p] = np.float32(p % TILE)
        work[_Y + p] = np.float32(p // TILE)
        work[_T + p] = _ONE


@jit
def composite(begin, end, worker, bins, colors, render, alphas, used):
    """Renders the tiles begin..end into render [C, H, W, D] and alphas [C, H, W, 1].

    colors are [G, D padded to a multiple of GROUP]. used [tiles] receives how many pairs of each tile
    were used before all its pixels were saturated.
    """
    tiles_x, tiles_y, tile_offsets, gaussians = bins.tiles_x, bins.tiles_y, bins.tile_offsets, bins.gaussians
    coefficients = bins.coefficients
    height, width, channels = render.shape[1], render.shape[2], render.shape[3]
    work = _aligned(_COLOR + colors.shape[1] * PIXELS)
    planes = work[_COLOR:].reshape((-1, PIXELS))
    groups = work[_COLOR:].reshape((-1, GROUP * PIXELS))
    for tile in range(begin, end):
        row, column = (tile // tiles_x) % tiles_y, tile % tiles_x
        left, top = column * TILE + 0.5, row * TILE + 0.5
        _start_tile(work)
        work[_B:] = _ZERO
        pair = tile_offsets[tile]
        while pair < tile_offsets[tile + 1]:
            g = gaussians[pair]
            u0, y0, square, shear, drop, peak = _at_tile(coefficients[g], left, top)
            first, past = _touched(bins.bands[pair])
            c0, c1, c2, c3 = colors[g, 0], colors[g, 1], colors[g, 2], colors[g, 3]
            band = work[first:]
            for p in range(past - first):
                dy = band[_Y + p] + y0
                u = band[_X + p] + (shear * band[_Y + p] + u0)
                alpha = _alpha(square * u * u + (drop * dy * dy + peak))
                t = band[_T + p]
                weight = alpha * t
                rest = t - weight
                # The sign marks saturated pixels, which keep their transmittance.
                alive = rest > _T_MIN
                weight = weight if alive else _ZERO
                band[_T + p] = rest if alive else -abs(t)
                band[_W + p] = weight
                band[_B + p] += weight
                band[_COLOR + p] += weight * c0
                band[_COLOR + PIXELS + p] += weight * c1
                band[_COLOR + 2 * PIXELS + p] += weight * c2
                band[_COLOR + 3 * PIXELS + p] += weight * c3
            for i in range(1, groups.shape[0]):
                d, group = GROUP * i, groups[i, first:]
                c0, c1, c2, c3 = colors[g, d], colors[g, d + 1], colors[g, d + 2], colors[g, d + 3]
                for p in range(past - first):
                    weight = band[_W + p]
                    group[p] += weight * c0
                    group[PIXELS + p] += weight * c1
                    group[2 * PIXELS + p] += weight * c2
                    group[3 * PIXELS + p] += weight * c3
            pair += 1
            if pair & 7 == 0:
                most = -_ONE
                for p in range(PIXELS):
                    most = max(most, work[_T + p])
                if most < _ZERO:
                    break
        used[tile] = pair - tile_offsets[tile]
        camera = tile // (tiles_x * tiles_y)
        wide = min(TILE, width - column * TILE)
        for i in range(min(TILE, height - row * TILE)):
            target = render[camera, row * TILE + i, column * TILE :]
            for d in range(channels):
                plane = planes[d, i * TILE :]
                for j in range(wide):
                    target[j, d] = plane[j]
            for j in range(wide):
                alphas[camera, row * TILE + i, column * TILE + j, 0] = work[_B + i * TILE + j]


@jit
def composite_neighbours(begin, end, worker, bins, means, conics, colors, visible, images):
    """Renders the tiles begin..end into images [C, H, W, 4], colours and accumulation, of a camera and of others near
    it: to first order in what their means [C, G, 2], conics [C, G, 3] and colours [C, G, 3] differ by from the first's.

    With s the difference of ln(alpha), a weight w = alpha t differs by w s + alpha dt, and dt then by minus that. That
    supports end elsewhere is left out. Only the first camera's Gaussians are in the bins; where one is not visible
    [C, G] to another camera, it stays there as it is.
    """
    tiles_x, tile_offsets, gaussians, coefficients = bins.tiles_x, bins.tile_offsets, bins.gaussians, bins.coefficients
    cameras, height, width = images.shape[0], images.shape[1], images.shape[2]
    work = _aligned(_COLOR + 4 * PIXELS)
    seen = work[_COLOR:]
    planes = _aligned(cameras * 4 * PIXELS).reshape((cameras, 4 * PIXELS))
    for tile in range(begin, end):
        row, column = tile // tiles_x, tile % tiles_x
        left, top = column * TILE + 0.5, row * TILE + 0.5
        _start_tile(work)
        seen[:] = _ZERO
        planes[:] = _ZERO
        pair = tile_offsets[tile]
        while pair < tile_offsets[tile + 1]:
            g = gaussians[pair]
            u0, y0, square, shear, drop, peak = _at_tile(coefficients[g], left, top)
            first, past = _touched(bins.bands[pair])
            x0 = np.float32(left - means[0, g, 0])
            c0, c1, c2 = colors[0, g, 0], colors[0, g, 1], colors[0, g, 2]
            band = work[first:]
            for p in range(past - first):
                dy = band[_Y + p] + y0
                u = band[_X + p] + (shear * band[_Y + p] + u0)
                alpha = _alpha(square * u * u + (drop * dy * dy + peak))
                t = band[_T + p]
                weight = alpha * t
                rest = t - weight
                alive = rest > _T_MIN
                weight = weight if alive else _ZERO
                band[_T + p] = rest if alive else -abs(t)
                band[_W + p] = weight
                band[_A + p] = alpha if alive else _ZERO
                band[_B + p] = band[_X + p] + x0
                band[_V + p] = dy
                band[_COLOR + p] += weight * c0
                band[_COLOR + PIXELS + p] += weight * c1
                band[_COLOR + 2 * PIXELS + p] += weight * c2
                band[_COLOR + 3 * PIXELS + p] += weight
            a, b, c = conics[0, g, 0], conics[0, g, 1], conics[0, g, 2]
            for k in range(1, cameras):
                if not visible[k, g]:
                    continue
                plane = planes[k, first:]
                x, y = means[k, g, 0] - means[0, g, 0], means[k, g, 1] - means[0, g, 1]
                sx, sy, sxy = a * x + b * y, b * x + c * y, b - conics[k, g, 1]
                sxx, syy = _HALF * (a - conics[k, g, 0]), _HALF * (c - conics[k, g, 2])
                v0, v1, v2 = colors[k, g, 0] - c0, colors[k, g, 1] - c1, colors[k, g, 2] - c2
                for p in range(past - first):
                    dx, dy, weight = band[_B + p], band[_V + p], band[_W + p]
                    t = plane[3 * PIXELS + p]
                    s = dx * (sx + sxx * dx + sxy * dy) + dy * (sy + syy * dy)
                    v = weight * s + band[_A + p] * t
                    plane[3 * PIXELS + p] = t - v
                    plane[p] += v * c0 + weight * v0
                    plane[PIXELS + p] += v * c1 + weight * v1
                    plane[2 * PIXELS + p] += v * c2 + weight * v2
            pair += 1
            if pair & 7 == 0:
                most = -_ONE
                for p in range(PIXELS):
                    most = max(most, work[_T + p])
                if most < _ZERO:
                    break
        planes[0] = seen
        for k in range(1, cameras):  # what differs becomes what is seen
            plane = planes[k]
            for p in range(3 * PIXELS):
                plane[p] += seen[p]
            for p in range(3 * PIXELS, 4 * PIXELS):
                plane[p] = seen[p] - plane[p]
        wide = min(TILE, width - column * TILE)
        for k in range(cameras):
            for i in range(min(TILE, height - row * TILE)):
                target = images[k, row * TILE + i, column * TILE :]
                for d in range(4):
                    plane = planes[k, d * PIXELS + i * TILE :]
                    for j in range(wide):
                        target[j, d] = plane[j]


@jit
def composite_backward(begin, end, worker, bins, used, colors, v_render, v_alphas, wants, drawn, moments, v_colors):
    """Gradients of the tiles begin..end's pairs.

    used [tiles]: of `composite`.
    wants: whether to fill moments, its columns for absgrad, and v_colors [E, padded D].
    drawn [E] receives which pairs come before all pixels are saturated; the others' gradients are not filled in.
    moments [E, 6 or 8], with v the gradient of a pixel's ln(alpha) and u = dx + s dy, are the sums over the tile of v
    times 1, u, dy, u^2, u dy, dy^2, and the absolute gradients of the mean's x and y.
    """
    tiles_x, tiles_y, tile_offsets, gaussians = bins.tiles_x, bins.tiles_y, bins.tile_offsets, bins.gaussians
    coefficients = bins.coefficients
    want_moments, want_abs, want_colors = wants
    height, width, channels = v_render.shape[1], v_render.shape[2], v_render.shape[3]
    work = _aligned(_COLOR + colors.shape[1] * PIXELS)
    planes = work[_COLOR:].reshape((-1, PIXELS))
    groups = work[_COLOR:].reshape((-1, GROUP * PIXELS))
    saved = _aligned(1024 * 2 * PIXELS).reshape((-1, 2 * PIXELS))
    for tile in range(begin, end):
        row, column = (tile // tiles_x) % tiles_y, tile % tiles_x
        left, top = column * TILE + 0.5, row * TILE + 0.5
        start, count = tile_offsets[tile], used[tile]
        drawn[start : start + count] = True
        drawn[start + count : tile_offsets[tile + 1]] = False
        if count == 0:
            continue
        _start_tile(work)
        if count > saved.shape[0]:
            saved = _aligned(2 * count * 2 * PIXELS).reshape((-1, 2 * PIXELS))
        for k in range(count):
            g = gaussians[start + k]
            u0, y0, square, shear, drop, peak = _at_tile(coefficients[g], left, top)
            first, past = _touched(bins.bands[start + k])
            band = work[first:]
            for p in range(past - first):
                dy = band[_Y + p] + y0
                u = band[_X + p] + (shear * band[_Y + p] + u0)
                log2_alpha = square * u * u + (drop * dy * dy + peak)
                alpha = _alpha(log2_alpha)
                t = band[_T + p]
                weight = alpha * t
                rest = t - weight
                alive = rest > _T_MIN
                band[_T + p] = rest if alive else -abs(t)
                # The sign marks alphas that were cut to 0.999.
                alpha = -alpha if log2_alpha > _LOG2_ALPHA_MAX else alpha
                band[_A + p] = alpha if alive else _ZERO
                band[_W + p] = weight if alive else _ZERO
            save = saved[k, first:]
            for p in range(past - first):
                save[p] = band[_W + p]
                save[PIXELS + p] = band[_A + p]
        camera = tile // (tiles_x * tiles_y)
        work[_COLOR:] = _ZERO
        # The transmittance is no longer needed; in its place comes the gradient of alpha, 0 beyond the image's edge.
        for p in range(PIXELS):
            work[_T + p] = _ZERO
            work[_B + p] = _ZERO
        wide = min(TILE, width - column * TILE)
        for i in range(min(TILE, height - row * TILE)):
            source = v_render[camera, row * TILE + i, column * TILE :]
            for d in range(channels):
                plane = planes[d, i * TILE :]
                for j in range(wide):
                    plane[j] = source[j, d]
            for j in range(wide):
                work[_T + i * TILE + j] = v_alphas[camera, row * TILE + i, column * TILE + j, 0]
        # work[_B] holds what lies behind the pair, composited and dotted with the image gradient.
        for k in range(count - 1, -1, -1):
            pair = start + k
            g = gaussians[pair]
            u0, y0, square, shear, drop, peak = _at_tile(coefficients[g], left, top)
            first, past = _touched(bins.bands[pair])
            band, save = work[first:], saved[k, first:]
            for p in range(past - first):
                band[_V + p] = band[_T + p]
            for i in range(1, groups.shape[0]):
                d, group = GROUP * i, groups[i, first:]
                c0, c1, c2, c3 = colors[g, d], colors[g, d + 1], colors[g, d + 2], colors[g, d + 3]
                v0, v1, v2, v3 = _ZERO, _ZERO, _ZERO, _ZERO
                for p in range(past - first):
                    weight = save[p]
                    g0, g1, g2, g3 = group[p], group[PIXELS + p], group[2 * PIXELS + p], group[3 * PIXELS + p]
                    band[_V + p] += c0 * g0 + c1 * g1 + c2 * g2 + c3 * g3
                    v0 += weight * g0
                    v1 += weight * g1
                    v2 += weight * g2
                    v3 += weight * g3
                if want_colors:
                    v_colors[pair, d] = v0
                    v_colors[pair, d + 1] = v1
                    v_colors[pair, d + 2] = v2
                    v_colors[pair, d + 3] = v3
            c0, c1, c2, c3 = colors[g, 0], colors[g, 1], colors[g, 2], colors[g, 3]
            m, mu, my, muu, muy, myy = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
            v0, v1, v2, v3 = _ZERO, _ZERO, _ZERO, _ZERO
            for p in range(past - first):
                weight, alpha = save[p], save[PIXELS + p]
                g0, g1 = band[_COLOR + p], band[_COLOR + PIXELS + p]
                g2, g3 = band[_COLOR + 2 * PIXELS + p], band[_COLOR + 3 * PIXELS + p]
                v0 += weight * g0
                v1 += weight * g1
                v2 += weight * g2
                v3 += weight * g3
                difference = band[_V + p] + c0 * g0 + c1 * g1 + c2 * g2 + c3 * g3 - band[_B + p]
                band[_B + p] += abs(alpha) * difference
                v = weight * difference if alpha > _ZERO else _ZERO
                band[_V + p] = v
                dy = band[_Y + p] + y0
                u = band[_X + p] + (shear * band[_Y + p] + u0)
                vu, vy = v * u, v * dy
                m += v
                mu += vu
                my += vy
                muu += vu * u
                muy += vu * dy
                myy += vy * dy
            if want_moments:
                moments[pair, 0] = m
                moments[pair, 1] = mu
                moments[pair, 2] = my
                moments[pair, 3] = muu
                moments[pair, 4] = muy
                moments[pair, 5] = myy
            if want_colors:
                v_colors[pair, 0] = v0
                v_colors[pair, 1] = v1
                v_colors[pair, 2] = v2
                v_colors[pair, 3] = v3
            if want_moments and want_abs:
                ax, ay = _ZERO, _ZERO
                for p in range(past - first):
                    v = band[_V + p]
                    dy = band[_Y + p] + y0
                    slope_x = square * (band[_X + p] + (shear * band[_Y + p] + u0))
                    ax += abs(v * slope_x)
                    ay += abs(v * (shear * slope_x + drop * dy))
                moments[pair, 6] = ax
                moments[pair, 7] = ay


@jit
def gather_gradients(
    begin, end, worker, bins, drawn, moments, pair_colors, wants, v_means, v_conics, v_opacities, v_colors, absgrad
):
    """Sums the pairs of the sorted Gaussians begin..end into gradients [G, .]."""
    order, slot_offsets, pairs, coefficients = bins.order, bins.slot_offsets, bins.pairs, bins.coefficients
    want_moments, want_abs, want_colors = wants
    for k in range(begin, end):
        g = order[k]
        m, mu, my, muu, muy, myy, ax, ay = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for slot in range(slot_offsets[k], slot_offsets[k + 1]):
            pair = pairs[slot]
            if not drawn[pair]:
                continue
            if want_moments:
                m += moments[pair, 0]
                mu += moments[pair, 1]
                my += moments[pair, 2]
                muu += moments[pair, 3]
                muy += moments[pair, 4]
                myy += moments[pair, 5]
                if want_abs:
                    ax += moments[pair, 6]
                    ay += moments[pair, 7]
            if want_colors:
                for d in range(v_colors.shape[1]):
                    v_colors[g, d] += pair_colors[pair, d]
        if want_moments:
            _, _, f, s, h, peak = coefficients[g]
            # log2(alpha) carries log2(e) times the exponent -q / 2, of which the conic's entries are half a derivative.
            v_means[g, 0] = -2 * _LN_2 * f * mu
            v_means[g, 1] = -2 * _LN_2 * (s * f * mu + h * my)
            v_conics[g, 0] = -0.5 * (muu - 2 * s * muy + s * s * myy)
            v_conics[g, 1] = -(muy - s * myy)
            v_conics[g, 2] = -0.5 * myy
            v_opacities[g, 0] = m * 2.0**-peak
            if want_abs:
                absgrad[g, 0] = 2 * _LN_2 * ax
                absgrad[g, 1] = 2 * _LN_2 * ay
