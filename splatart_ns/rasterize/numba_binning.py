"""Which tiles each Gaussian touches, and in what order: the lists that compositing walks."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from splatart_ns.rasterize.numba_runtime import even_bounds, jit, run
from splatart_ns.threads import num_threads

TILE = 8
"""Side of a tile, pixels."""
PIXELS = TILE * TILE

BAND_ROWS = 2
"""Rows of a tile in a band, the least that compositing leaves out: a vector register of pixels at its widest."""

_LOG2_E = math.log2(math.e)
# The exponent's float32 rounding may put a pixel just inside the support: look a little further than the exact ellipse.
_MARGIN = 1e-4


class Bins(NamedTuple):
    """Pairs of a tile and a Gaussian that touches it. G = C N Gaussians, in all cameras; E pairs; S sorted Gaussians.

    A pair's slot counts pairs by Gaussian, so that what belongs to one Gaussian lies together.
    """

    tiles_x: int
    tiles_y: int
    tile_offsets: np.ndarray
    """[C tiles_y tiles_x + 1]: where the pairs of each tile start, front to back."""
    gaussians: np.ndarray
    """[E] Gaussian of each pair."""
    bands: np.ndarray
    """[E] Which bands of the tile it may touch: 16 times the first, plus one past the last."""
    pairs: np.ndarray
    """[E] pair of each slot."""
    order: np.ndarray
    """[S] Gaussians that touch a tile, by camera and then by depth."""
    slot_offsets: np.ndarray
    """[S + 1]: where the slots of each sorted Gaussian start."""
    coefficients: np.ndarray
    """[G, 6] (x, y, f, s, h, k): log2(alpha) = f (dx + s dy)^2 + h dy^2 + k at (dx, dy) from the mean (x, y)."""


@jit
def _extents(begin, end, worker, means, conics, opacities, visible, width, height, coefficients, ellipses, rows):
    """Fills coefficients, ellipses [G, 3] (half extents in x, y; squared radius), rows [G, 2] (first, one past last).

    All in float64: the rest of a needle's conic is a small difference.
    """
    for g in range(begin, end):
        rows[g, 0] = 0
        rows[g, 1] = 0
        opacity = np.float64(opacities[g])
        if not visible[g] or not opacity * 255.0 >= 1.0:
            continue
        x, y = np.float64(means[g, 0]), np.float64(means[g, 1])
        a, b, c = np.float64(conics[g, 0]), np.float64(conics[g, 1]), np.float64(conics[g, 2])
        # A needle's conic can be indefinite by rounding; the bound then makes a long strip of it.
        det = max(a * c - b * b, 1e-12 * a * c)
        radius2 = 2.0 * math.log(255.0 * opacity) + _MARGIN
        half_x, half_y = math.sqrt(radius2 * c / det), math.sqrt(radius2 * a / det)
        # Also false for what is not finite.
        if not (0.0 < det < np.inf and x + half_x > 0.5 and x - half_x < width - 0.5 and abs(y) + half_y < np.inf):
            continue
        first = max(math.ceil(max((y - half_y - (TILE - 0.5)) / TILE, -1.0)), 0)
        last = math.floor(min((y + half_y - 0.5) / TILE, float((height - 1) // TILE)))
        if first > last:
            continue
        rows[g, 0] = first
        rows[g, 1] = last + 1
        ellipses[g, 0] = half_x
        ellipses[g, 1] = half_y
        ellipses[g, 2] = radius2
        coefficients[g, 0] = x
        coefficients[g, 1] = y
        coefficients[g, 2] = -0.5 * _LOG2_E * a
        coefficients[g, 3] = b / a
        coefficients[g, 4] = -0.5 * _LOG2_E * det / a
        coefficients[g, 5] = math.log2(opacity)


@jit
def _depth_order(depths, rows, gaussians_per_camera):
    """Gaussians that have rows [S], by camera, then depth (stable radix sort), and where their rows start [S + 1]."""
    order = np.empty(depths.shape[0], np.int32)
    total = 0
    for start in range(0, depths.shape[0], gaussians_per_camera):
        begin = total
        for g in range(start, start + gaussians_per_camera):
            if rows[g, 1] > rows[g, 0]:
                order[total] = g
                total += 1
        count = total - begin
        items = order[begin:total].copy()
        keys = np.empty(count, np.uint32)
        for i in range(count):
            bits = np.float32(depths[items[i]]).view(np.uint32)
            # Order of floats as order of unsigned integers.
            keys[i] = ~bits if bits >> np.uint32(31) else bits | np.uint32(0x80000000)
        sorted_keys, sorted_items = np.empty_like(keys), np.empty_like(items)
        for shift in (0, 11, 22):
            places = np.zeros(2049, np.int64)
            for i in range(count):
                places[((keys[i] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
            for digit in range(2048):
                places[digit + 1] += places[digit]
            for i in range(count):
                digit = (keys[i] >> np.uint32(shift)) & np.uint32(2047)
                sorted_keys[places[digit]] = keys[i]
                sorted_items[places[digit]] = items[i]
                places[digit] += 1
            keys, sorted_keys = sorted_keys, keys
            items, sorted_items = sorted_items, items
        order[begin:total] = items
    row_offsets = np.zeros(total + 1, np.int64)
    for k in range(total):
        row_offsets[k + 1] = row_offsets[k] + rows[order[k], 1] - rows[order[k], 0]
    return order[:total], row_offsets


@jit
def _spans(begin, end, worker, order, row_offsets, means, conics, ellipses, rows, size, grid, spans, tallies, sizes):
    """Fills the spans [., 2] of tiles (first, one past last) of each sorted Gaussian's rows.

    Counts pairs per tile into tallies [workers, tiles] and per sorted Gaussian into sizes [S].
    """
    width, height = size
    tiles_x, tiles_y, per_camera = grid
    tally = tallies[worker]
    i = row_offsets[begin]
    for k in range(begin, end):
        g = order[k]
        x, y = np.float64(means[g, 0]), np.float64(means[g, 1])
        a, b, c = np.float64(conics[g, 0]), np.float64(conics[g, 1]), np.float64(conics[g, 2])
        det = max(a * c - b * b, 1e-12 * a * c)
        half_x, half_y, radius2 = ellipses[g, 0], ellipses[g, 1], ellipses[g, 2]
        tip = b / c * half_x  # minus the height at which the ellipse reaches furthest right
        count = 0
        for row in range(rows[g, 0], rows[g, 1]):
            low = max(row * TILE + 0.5 - y, -half_y)
            high = min(min(row * TILE + TILE - 0.5, height - 0.5) - y, half_y)
            first, past = 0, 0
            if low <= high:
                # The ellipse a dx^2 + 2 b dx dy + c dy^2 = radius2 is extreme at the tip, or as near as the row lets.
                right = min(max(-tip, low), high)
                left = min(max(tip, low), high)
                x_right = x + (math.sqrt(max(radius2 * a - det * right * right, 0.0)) - b * right) / a
                x_left = x - (math.sqrt(max(radius2 * a - det * left * left, 0.0)) + b * left) / a
                first = max(math.ceil(max((x_left - (TILE - 0.5)) / TILE, -1.0)), 0)
                past = math.floor(min((x_right - 0.5) / TILE, float(tiles_x - 1))) + 1
                if x_left <= width - 0.5 and past > first:
                    count += past - first
                    base = ((g // per_camera) * tiles_y + row) * tiles_x
                    for tile in range(base + first, base + past):
                        tally[tile] += 1
                else:
                    past = first
            spans[i, 0] = first
            spans[i, 1] = past
            i += 1
        sizes[k] = count


@jit
def _offsets(tallies, sizes):
    """Turns tallies into where each worker's pairs of each tile start; returns the prefix sums by tile and Gaussian."""
    tile_offsets = np.empty(tallies.shape[1] + 1, np.int64)
    total = 0
    for tile in range(tallies.shape[1]):
        tile_offsets[tile] = total
        for worker in range(tallies.shape[0]):
            count = tallies[worker, tile]
            tallies[worker, tile] = total
            total += count
    tile_offsets[-1] = total
    slot_offsets = np.zeros(sizes.shape[0] + 1, np.int64)
    for k in range(sizes.shape[0]):
        slot_offsets[k + 1] = slot_offsets[k] + sizes[k]
    return tile_offsets, slot_offsets


@jit
def _fill(begin, end, worker, order, row_offsets, means, ellipses, rows, spans, slot_offsets, grid, places, lists):
    """Lists the pairs by tile."""
    tiles_x, tiles_y, per_camera = grid
    gaussians, bands, pairs = lists
    place = places[worker]
    i = row_offsets[begin]
    for k in range(begin, end):
        g = order[k]
        slot = slot_offsets[k]
        top, bottom = means[g, 1] - ellipses[g, 1] - 0.5, means[g, 1] + ellipses[g, 1] - 0.5
        for row in range(rows[g, 0], rows[g, 1]):
            base = ((g // per_camera) * tiles_y + row) * tiles_x
            first = math.ceil(max(top - row * TILE, 0.0))
            last = math.floor(max(min(bottom - row * TILE, TILE - 1.0), -1.0))
            band = np.uint8(16 * (first // BAND_ROWS) + last // BAND_ROWS + 1)
            for tile in range(base + spans[i, 0], base + spans[i, 1]):
                gaussians[place[tile]] = g
                bands[place[tile]] = band
                pairs[slot] = place[tile]
                place[tile] += 1
                slot += 1
            i += 1


def bin_gaussians(means, conics, opacities, depths, visible, cameras: int, width: int, height: int) -> Bins:
    """Lists the Gaussians that reach alpha >= 1/255 at a pixel centre of a tile's rows, tile by tile, front to back.

    means [G, 2], conics [G, 3], opacities [G], depths [G] float32 and visible [G] bool, camera after camera.
    The result does not depend on the number of threads; Gaussians of the same depth keep their order.
    """
    total = means.shape[0]
    per_camera = total // max(cameras, 1)
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    workers = num_threads()
    coefficients = np.empty((total, 6))
    ellipses = np.empty((total, 3))
    rows = np.empty((total, 2), np.int32)
    bounds = even_bounds(total, workers)
    run(_extents, bounds, means, conics, opacities, visible, width, height, coefficients, ellipses, rows)
    order, row_offsets = _depth_order(depths, rows, max(per_camera, 1))
    bounds = even_bounds(len(order), workers)
    grid = (tiles_x, tiles_y, max(per_camera, 1))
    spans = np.empty((row_offsets[-1], 2), np.int32)
    tallies = np.zeros((workers, cameras * tiles_y * tiles_x), np.int64)
    sizes = np.empty(len(order), np.int64)
    size = (width, height)
    run(_spans, bounds, order, row_offsets, means, conics, ellipses, rows, size, grid, spans, tallies, sizes)
    tile_offsets, slot_offsets = _offsets(tallies, sizes)
    gaussians = np.empty(tile_offsets[-1], np.int32)
    bands = np.empty(tile_offsets[-1], np.uint8)
    pairs = np.empty(tile_offsets[-1], np.int32)
    lists = gaussians, bands, pairs
    run(_fill, bounds, order, row_offsets, means, ellipses, rows, spans, slot_offsets, grid, tallies, lists)
    return Bins(tiles_x, tiles_y, tile_offsets, gaussians, bands, pairs, order, slot_offsets, coefficients)
