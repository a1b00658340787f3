"""The kernel of `stages.stereo`: PatchMatch over the depths and slopes of one image's surface (numba).

Of Bleyer, Rhemann and Rother, "PatchMatch Stereo" (2011), for several unrectified views: every cell keeps the plane
whose patch looks most alike in the others, tries its neighbours' planes, and small changes of its own.
"""

from __future__ import annotations

import math

import numpy as np

from splatart_ns.rasterize.numba_runtime import jit

REACH, SKIP = 4, 2
"""A patch's pixels: every `SKIP`-th up to `REACH` from its centre."""
PATCH = (2 * REACH // SKIP + 1) ** 2
BEST = 3
"""So many of the other views are taken to see a place; the rest may have it hidden."""
HIDDEN = 65535
"""Stands for the brightness of a pixel that does not show the object."""
_NOISE = 9.0
"""Variance of a pixel's brightness (0..765) that is noise: a patch without more texture says nothing."""
_LEAST_SHARE = 0.6
"""Share of a patch's pixels that must show the object in both images."""
_LEAST_AREA, _MOST_AREA = 0.15, 6.0
"""Of a patch, in another view: less is seen too aslant to be compared, more is too coarse here."""
_OBLIQUE = 0.15
"""Least cosine between a plane's normal and the ray."""
_STARTS, _CHANGES = 6, 3
"""Random planes a cell starts from, and changes of its best that it tries in a pass."""


@jit
def _affine_unlikeness(bright, patch, column, row, cu, cv, ru, rv):
    """1 - NCC of a patch with an image's pixels about (row, column), where (dx, dy) from the patch's centre lies at
    row + ru dx + rv dy, column + cu dx + cv dy; 1 where too few pixels are seen in both."""
    height, width = bright.shape
    count, k = 0, 0
    sa, sb, saa, sbb, sab = 0.0, 0.0, 0.0, 0.0, 0.0
    for dy in range(-REACH, REACH + 1, SKIP):
        for dx in range(-REACH, REACH + 1, SKIP):
            here = patch[k]
            k += 1
            c, r = column + cu * dx + cv * dy, row + ru * dx + rv * dy
            if here == HIDDEN or not (0 <= c < width - 1 and 0 <= r < height - 1):
                continue
            i, j = int(r), int(c)
            b00, b01, b10, b11 = bright[i, j], bright[i, j + 1], bright[i + 1, j], bright[i + 1, j + 1]
            if b00 != HIDDEN and b01 != HIDDEN and b10 != HIDDEN and b11 != HIDDEN:
                fr, fc = r - i, c - j
                there = (1 - fr) * ((1 - fc) * b00 + fc * b01) + fr * ((1 - fc) * b10 + fc * b11)
                count += 1
                sa += here
                sb += there
                saa += here * here
                sbb += there * there
                sab += here * there
    if count < _LEAST_SHARE * PATCH:
        return 1.0
    saa, sbb, sab = saa - sa * sa / count, sbb - sb * sb / count, sab - sa * sb / count
    return 1 - sab / math.sqrt((saa + _NOISE * count) * (sbb + _NOISE * count))


@jit
def _unlikeness(bright, view, ray0, ray1, depth, n0, n1, n2, K, others, R, t, patch, least):
    """1 - NCC of a patch, the mean over the `BEST` other views; 1 for a view that cannot tell.

    The plane through the ray's point at `depth` maps the patch to another view; near its centre that is affine.
    """
    fx, fy = K[view, 0], K[view, 1]
    facing = n0 * ray0 + n1 * ray1 + n2
    # The surface's point, and how it moves with the pixel.
    x0, x1, x2 = depth * ray0, depth * ray1, depth
    u2, v2 = -depth * n0 / (fx * facing), -depth * n1 / (fy * facing)
    u0, u1 = depth / fx + ray0 * u2, ray1 * u2
    v0, v1 = ray0 * v2, depth / fy + ray1 * v2
    for k in range(BEST):
        least[k] = 1.0
    for s in range(others.shape[1]):
        other = others[view, s]
        A, b = R[view, s], t[view, s]
        y0 = A[0, 0] * x0 + A[0, 1] * x1 + A[0, 2] * x2 + b[0]
        y1 = A[1, 0] * x0 + A[1, 1] * x1 + A[1, 2] * x2 + b[1]
        y2 = A[2, 0] * x0 + A[2, 1] * x1 + A[2, 2] * x2 + b[2]
        if y2 < 1e-3:
            continue
        du0 = A[0, 0] * u0 + A[0, 1] * u1 + A[0, 2] * u2
        du1 = A[1, 0] * u0 + A[1, 1] * u1 + A[1, 2] * u2
        du2 = A[2, 0] * u0 + A[2, 1] * u1 + A[2, 2] * u2
        dv0 = A[0, 0] * v0 + A[0, 1] * v1 + A[0, 2] * v2
        dv1 = A[1, 0] * v0 + A[1, 1] * v1 + A[1, 2] * v2
        dv2 = A[2, 0] * v0 + A[2, 1] * v1 + A[2, 2] * v2
        gx, gy = K[other, 0] / y2, K[other, 1] / y2
        column, row = gx * y0 + K[other, 2] - 0.5, gy * y1 + K[other, 3] - 0.5
        cu, cv = gx * (du0 - y0 / y2 * du2), gx * (dv0 - y0 / y2 * dv2)
        ru, rv = gy * (du1 - y1 / y2 * du2), gy * (dv1 - y1 / y2 * dv2)
        area = cu * rv - cv * ru
        if not (_LEAST_AREA < area < _MOST_AREA):
            continue
        unlike = _affine_unlikeness(bright[other], patch, column, row, cu, cv, ru, rv)
        place = BEST
        while place > 0 and least[place - 1] > unlike:
            if place < BEST:
                least[place] = least[place - 1]
            place -= 1
        if place < BEST:
            least[place] = unlike
    total = 0.0
    for k in range(BEST):
        total += least[k]
    return total / BEST


@jit
def _read_patch(bright, y, x, patch):
    """A patch's pixels about (y, x) of one image; `HIDDEN` beyond its edges."""
    height, width = bright.shape
    k = 0
    for dy in range(-REACH, REACH + 1, SKIP):
        for dx in range(-REACH, REACH + 1, SKIP):
            r, c = y + dy, x + dx
            patch[k] = bright[r, c] if 0 <= r < height and 0 <= c < width else HIDDEN
            k += 1


@jit
def match(begin, end, worker, bright, K, others, R, t, near, far, stride, passes, depth, normal, unlike):
    """Fill depth, normal and unlikeness of the cells of the views from `begin` to `end`.

    Args:
        begin, end: The views, of those that `near` has.
        worker: Unused.
        bright: Images [V, H, W] uint16: the sum of red, green and blue where they show the object, else `HIDDEN`.
        K: fx, fy, cx, cy of each view [V, 4].
        others: The views that each is compared with [V, S].
        R, t: From each view's camera to theirs [V, S, 3, 3], [V, S, 3].
        near, far: Depths between which a cell's surface lies [V, h, w]; none where near is not less.
        stride: Pixels from cell to cell; a cell's patch is centred at its middle pixel.
        passes: How often every cell tries its neighbours' planes and changes of its own.
        depth, normal, unlike: The results [V, h, w], [V, h, w, 3] in the camera's frame, [V, h, w]; 2 where none.
    """
    rows, columns = near.shape[1:]
    height, width = bright.shape[1:]
    patch, least = np.zeros(PATCH, np.float32), np.zeros(BEST)
    for view in range(begin, end):
        np.random.seed(view)  # whatever thread it falls to
        fx, fy, cx, cy = K[view, 0], K[view, 1], K[view, 2], K[view, 3]
        for step in range(passes + 1):
            back = -1 if step % 2 == 1 else 1
            for a in range(rows):
                for b in range(columns):
                    i, j = (a, b) if back > 0 else (rows - 1 - a, columns - 1 - b)
                    y, x = i * stride + stride // 2, j * stride + stride // 2
                    low, high = near[view, i, j], far[view, i, j]
                    if low >= high or y >= height or x >= width or bright[view, y, x] == HIDDEN:
                        continue
                    _read_patch(bright[view], y, x, patch)
                    ray0, ray1 = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
                    length = math.sqrt(ray0 * ray0 + ray1 * ray1 + 1)
                    z, lowest = depth[view, i, j], unlike[view, i, j]
                    n0, n1, n2 = normal[view, i, j, 0], normal[view, i, j, 1], normal[view, i, j, 2]
                    for trial in range(_STARTS if step == 0 else 3 + _CHANGES):
                        if step == 0 or trial == 2:
                            d = low + (high - low) * np.random.random()
                            m0, m1, m2 = np.random.normal(), np.random.normal(), np.random.normal()
                            if m0 * ray0 + m1 * ray1 + m2 > 0:
                                m0, m1, m2 = -m0, -m1, -m2
                        elif trial < 2:
                            p, q = (i - back, j) if trial == 0 else (i, j - back)
                            if p < 0 or q < 0 or p >= rows or q >= columns or unlike[view, p, q] > 1.5:
                                continue
                            m0, m1, m2 = normal[view, p, q, 0], normal[view, p, q, 1], normal[view, p, q, 2]
                            facing = m0 * ray0 + m1 * ray1 + m2
                            if facing > -_OBLIQUE * length:
                                continue
                            there0, there1 = ray0 + (q - j) * stride / fx, ray1 + (p - i) * stride / fy
                            d = depth[view, p, q] * (m0 * there0 + m1 * there1 + m2) / facing
                        else:
                            size = 0.5 ** (step + trial - 3)
                            d = z + 0.5 * size * (high - low) * (2 * np.random.random() - 1)
                            m0 = n0 + 0.7 * size * np.random.normal()
                            m1 = n1 + 0.7 * size * np.random.normal()
                            m2 = n2 + 0.7 * size * np.random.normal()
                        norm = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
                        if not (low <= d <= high) or m0 * ray0 + m1 * ray1 + m2 > -_OBLIQUE * length * norm:
                            continue
                        m0, m1, m2 = m0 / norm, m1 / norm, m2 / norm
                        value = _unlikeness(bright, view, ray0, ray1, d, m0, m1, m2, K, others, R, t, patch, least)
                        if value < lowest:
                            lowest, z, n0, n1, n2 = value, d, m0, m1, m2
                    depth[view, i, j], unlike[view, i, j] = z, lowest
                    normal[view, i, j, 0], normal[view, i, j, 1], normal[view, i, j, 2] = n0, n1, n2
