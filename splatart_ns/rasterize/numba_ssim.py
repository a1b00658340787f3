"""Structural similarity of float32 images on the CPU, and its gradient, compiled by numba.

Images are taken as [H, 3 W]: the filters pass along rows in steps of three, and every inner loop runs over a block of
one row. Filters have eleven taps; those of smaller images are filled up with zeros.
"""

from __future__ import annotations

import numpy as np

from splatart_ns.rasterize.numba_runtime import even_bounds, jit, run
from splatart_ns.threads import num_threads

_TAPS = 11
_BLOCK = 240
_HALO = 3 * (_TAPS - 1)
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
_ONE, _TWO = np.float32(1), np.float32(2)


@jit
def _filter_row(weights, row, result, size):
    """result[j] = sum over t of weights[t] row[j + 3 t]."""
    w0, w1, w2, w3, w4, w5 = weights[0], weights[1], weights[2], weights[3], weights[4], weights[5]
    w6, w7, w8, w9, w10 = weights[6], weights[7], weights[8], weights[9], weights[10]
    for j in range(size):
        low = w0 * row[j] + w1 * row[j + 3] + w2 * row[j + 6] + w3 * row[j + 9] + w4 * row[j + 12] + w5 * row[j + 15]
        high = w6 * row[j + 18] + w7 * row[j + 21] + w8 * row[j + 24] + w9 * row[j + 27] + w10 * row[j + 30]
        result[j] = low + high


@jit
def _similarity(begin, end, worker, image, target, down, across, sums, slopes):
    """Sums of the similarities [rows] of the rows begin..end, and their derivatives by three moments.

    slopes [3, rows, columns] are the derivatives by the filtered image, its square, and its product with the target.
    """
    columns = slopes.shape[2]
    filtered_down = np.zeros((5, _BLOCK + _HALO), np.float32)
    moments = np.empty((5, _BLOCK), np.float32)
    for i in range(begin, end):
        total = 0.0
        for start in range(0, columns, _BLOCK):
            size = min(_BLOCK, columns - start)
            halo = min(size + _HALO, image.shape[1] - start)
            x_, y_, xx_, yy_, xy_ = filtered_down
            filtered_down[:] = 0
            for t in range(_TAPS):
                w = down[t]
                if w == 0:
                    continue
                x_row, y_row = image[i + t, start : start + halo], target[i + t, start : start + halo]
                for j in range(halo):
                    x, y = x_row[j], y_row[j]
                    wx, wy = w * x, w * y
                    x_[j] += wx
                    y_[j] += wy
                    xx_[j] += wx * x
                    yy_[j] += wy * y
                    xy_[j] += wx * y
            for k in range(5):
                _filter_row(across, filtered_down[k], moments[k], size)
            x_, y_, xx_, yy_, xy_ = moments
            by_x = slopes[0, i, start : start + size]
            by_xx = slopes[1, i, start : start + size]
            by_xy = slopes[2, i, start : start + size]
            block_sum = np.float32(0)
            for j in range(size):
                x, y = x_[j], y_[j]
                level = x * x + y * y + _C1
                spread = (xx_[j] - x * x) + (yy_[j] - y * y) + _C2
                alike = _TWO * x * y + _C1
                joint = _TWO * (xy_[j] - x * y) + _C2
                scale = _ONE / (level * spread)
                s = alike * joint * scale
                slope_xx = -s * level * scale
                slope_xy = _TWO * alike * scale
                block_sum += s
                by_xx[j] = slope_xx
                by_xy[j] = slope_xy
                by_x[j] = _TWO * (y * joint - x * s * spread) * scale - _TWO * x * slope_xx - y * slope_xy
            total += block_sum
        sums[i] = total


@jit
def _gradient(begin, end, worker, image, target, down, across, slopes, similarity_factor, l1_factor, gradient):
    """Gradient of similarity_factor sum(similarities) + l1_factor sum(|image - target|), rows begin..end."""
    rows, columns = slopes.shape[1], slopes.shape[2]
    reversed_across = across[::-1].copy()
    filtered_down = np.zeros((3, _BLOCK + _HALO), np.float32)
    filtered = np.empty((3, _BLOCK), np.float32)
    for i in range(begin, end):
        for start in range(0, gradient.shape[1], _BLOCK):
            size = min(_BLOCK, gradient.shape[1] - start)
            # Column start + j takes from the slopes' columns start + j - HALO .. start + j.
            first = max(start - _HALO, 0)
            count = min(start + size, columns) - first
            filtered_down[:] = 0
            for k in range(3):
                row = filtered_down[k, first - start + _HALO :]
                for t in range(_TAPS):
                    if down[t] != 0 and 0 <= i - t < rows and count > 0:
                        w = down[t]
                        slope = slopes[k, i - t, first : first + count]
                        for j in range(count):
                            row[j] += w * slope[j]
                _filter_row(reversed_across, filtered_down[k], filtered[k], size)
            by_x, by_xx, by_xy = filtered
            x_row, y_row = image[i, start : start + size], target[i, start : start + size]
            out = gradient[i, start : start + size]
            for j in range(size):
                x, y = x_row[j], y_row[j]
                v = by_x[j] + _TWO * x * by_xx[j] + y * by_xy[j]
                sign = np.float32(x > y) - np.float32(x < y)
                out[j] = similarity_factor * v + l1_factor * sign


def ssim_and_gradient(
    image: np.ndarray,
    target: np.ndarray,
    windows: tuple[np.ndarray, np.ndarray],
    factors: tuple[float, float] | None,
) -> tuple[float, np.ndarray | None]:
    """Mean similarity of images [H, W, 3], and with `factors` (a, b) the gradient of a ssim + b mean(|image - target|).

    windows: the taps down and across, as many as the image allows.
    """
    height, width, _ = image.shape
    x, y = image.reshape(height, -1), target.reshape(height, -1)
    down, across = (np.pad(w.astype(np.float32), (0, _TAPS - len(w))) for w in windows)
    rows, columns = height - len(windows[0]) + 1, 3 * (width - len(windows[1]) + 1)
    sums = np.empty(rows)
    slopes = np.empty((3, rows, columns), np.float32)
    run(_similarity, even_bounds(rows, num_threads()), x, y, down, across, sums, slopes)
    value = float(sums.sum() / (rows * columns))
    if factors is None:
        return value, None
    scales = np.float32(factors[0] / (rows * columns)), np.float32(factors[1] / x.size)
    gradient = np.empty_like(x)
    run(_gradient, even_bounds(height, num_threads()), x, y, down, across, slopes, *scales, gradient)
    return value, gradient.reshape(image.shape)
