"""Compiled alignment (inverse compositional Lucas-Kanade) of square patches, blind to gain and offset of the light.

A patch of SIZE x SIZE pixels is sampled around (u, v); the residual of every pixel is

    e = I(W(x)) - (1 + gain) T(x) - offset

and the template's own gradient gives the Jacobian, so that the normal matrix is inverted once per template
(Baker and Matthews, Lucas-Kanade 20 years on, 2004, inverse compositional algorithm). Gain and offset are eliminated:
the Jacobian images are made orthogonal to T and to 1, and their products with T vanish, so that the right-hand side is
their product with the image itself.

Rows of work space are LANES wide, one more than SIZE, which processors like; the last column is 0.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.kernel_cache import inner, kernel

RADIUS = 7  # px
SIZE = 2 * RADIUS + 1
LANES = 16
STRAIGHT = 0.02  # largest entry of a map minus identity for which a patch is cut along rows: 0.14 px at its rim
SLIDES = 10  # iterations at most
SETTLED = 4e-4  # px^2, step after which there is no other
ONE = np.float32(1.0)
HALF = np.float32(0.5)
AREA = SIZE * LANES
DOWN, RIGHT = ((np.mgrid[:SIZE, :LANES] - RADIUS) / RADIUS).astype(np.float32).reshape(2, AREA)  # in units of RADIUS
INSIDE = (RIGHT <= 1.0).astype(np.float32)


@kernel(fastmath=True)
def cut(image, u, v, patch):
    """Fill patch (SIZE + 2, LANES + 2) with bilinear grey around (u, v); False when it leaves the image."""
    h, w = image.shape
    c, r = int(np.floor(u)) - RADIUS - 1, int(np.floor(v)) - RADIUS - 1
    if not (c >= 0 and r >= 0 and c + SIZE + 2 < w and r + SIZE + 2 < h):
        return False
    a, b = np.float32(u - np.floor(u)), np.float32(v - np.floor(v))
    for y in range(SIZE + 2):
        top, low = image[r + y, c:c + SIZE + 3], image[r + y + 1, c:c + SIZE + 3]
        for x in range(SIZE + 2):
            patch[y, x] = (ONE - b) * ((ONE - a) * top[x] + a * top[x + 1]) \
                + b * ((ONE - a) * low[x] + a * low[x + 1])
    return True


@inner(fastmath=True)
def warp(image, u, v, A, radius, base, moved):
    """Fill moved (2 radius + 1, 2 radius + 1 and more) with grey minus base at (u, v) + A (x, y).

    False when it leaves the image. Positions are counted in 2^-16 px: exact enough, and quicker than floats.
    """
    h, w = image.shape
    reach_u, reach_v = radius * (abs(A[0, 0]) + abs(A[0, 1])), radius * (abs(A[1, 0]) + abs(A[1, 1]))
    if not (u - reach_u >= 1.0 and v - reach_v >= 1.0 and u + reach_u < w - 2.0 and v + reach_v < h - 2.0):
        return False
    flat, right, below, unit = image.reshape(-1), np.uintp(1), np.uintp(w), np.float32(2.0**-16)
    step_u, step_v = int(np.rint(A[0, 0] * 2.0**16)), int(np.rint(A[1, 0] * 2.0**16))
    for y in range(2 * radius + 1):
        cu = int((u - A[0, 0] * radius + A[0, 1] * (y - radius)) * 2.0**16)
        cv = int((v - A[1, 0] * radius + A[1, 1] * (y - radius)) * 2.0**16)
        for x in range(2 * radius + 1):
            k = np.uintp((cv >> 16) * w + (cu >> 16))
            a, b = np.float32(cu & 0xFFFF) * unit, np.float32(cv & 0xFFFF) * unit
            top, low = np.float32(flat[k]), np.float32(flat[k + below])
            top += a * (np.float32(flat[k + right]) - top)
            low += a * (np.float32(flat[k + below + right]) - low)
            moved[y, x] = top + b * (low - top) - base
            cu += step_u
            cv += step_v
    return True


@kernel(fastmath=True)
def dot(a, b):
    """Sum of products of two flat images (AREA,)."""
    total = np.float32(0.0)
    for k in range(AREA):
        total += a[k] * b[k]
    return total


@kernel(fastmath=True)
def gradient(patch, J):
    """Fill J[:3] (3, AREA) with the grey of a patch and its derivatives by u and v."""
    for y in range(SIZE):
        up, row, low = patch[y], patch[y + 1], patch[y + 2]
        grey, by_u, by_v = J[0, y * LANES:], J[1, y * LANES:], J[2, y * LANES:]
        for x in range(LANES):
            grey[x] = row[x + 1]
            by_u[x] = HALF * (row[x + 2] - row[x])
            by_v[x] = HALF * (low[x + 1] - up[x + 1])


@inner(fastmath=True)
def prepare(patch, J, sums):
    """Fill J (3, AREA) with the grey of a patch, less that of its middle, and its derivatives; 0 in the last column.

    sums (9,): of grey, by u, by v, and of the products of these with the grey, by u, by v: gg, gu, gv, uu, uv, vv.
    """
    middle, zero = patch[RADIUS + 1, RADIUS + 1], np.float32(0.0)
    g = u = v = gg = gu = gv = uu = uv = vv = zero
    for y in range(SIZE):
        for x in range(LANES):
            k = y * LANES + x
            J[0, k] = (patch[y + 1, x + 1] - middle) * INSIDE[x]
            J[1, k] = HALF * (patch[y + 1, x + 2] - patch[y + 1, x]) * INSIDE[x]
            J[2, k] = HALF * (patch[y + 2, x + 1] - patch[y, x + 1]) * INSIDE[x]
    for k in range(AREA):  # not row by row: sums across are dear
        a, b, c = J[0, k], J[1, k], J[2, k]
        g += a
        u += b
        v += c
        gg += a * a
        gu += a * b
        gv += a * c
        uu += b * b
        uv += b * c
        vv += c * c
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7], sums[8] = g, u, v, gg, gu, gv, uu, uv, vv


@inner(fastmath=True)
def products(image, c, r, a, b, base, J):
    """Products of J (3, AREA) with the grey, less base, around (c + a, r + b), and the sum of that grey."""
    s0 = s1 = s2 = total = np.float32(0.0)
    left, above = ONE - a, ONE - b
    for y in range(SIZE):
        top, low = image[r - RADIUS + y, c - RADIUS:], image[r - RADIUS + y + 1, c - RADIUS:]
        j0, j1, j2 = J[0, y * LANES:], J[1, y * LANES:], J[2, y * LANES:]
        for x in range(LANES):
            grey = above * (left * top[x] + a * top[x + 1]) + b * (left * low[x] + a * low[x + 1]) - base
            s0 += j0[x] * grey
            s1 += j1[x] * grey
            s2 += j2[x] * grey
            total += grey * INSIDE[x]
    return s0, s1, s2, total


@inner
def slide(previous, current, u0, v0, M, u, v, settled, patch, J):
    """Translate (u, v) in current until it shows what previous shows at (u0, v0) + M (x, y).

    settled: px^2, a smaller step is the last. patch (SIZE + 2, LANES + 2), J (3, AREA): work space. Returns (ok, u, v).
    """
    turned = max(abs(M[0, 0] - 1.0), abs(M[0, 1]), abs(M[1, 0]), abs(M[1, 1] - 1.0)) > STRAIGHT
    if not (warp(previous, u0, v0, M, RADIUS + 1, np.float32(0.0), patch) if turned else
            cut(previous, u0, v0, patch)):
        return False, u, v
    (h, w), n, sums = current.shape, SIZE * SIZE, np.empty(9)
    prepare(patch, J, sums)
    middle = patch[RADIUS + 1, RADIUS + 1]
    base, energy = sums[0] / n, sums[3] - sums[0] * sums[0] / n + 1e-3
    along_u, along_v = sums[4] - base * sums[1], sums[5] - base * sums[2]
    hxx = sums[6] - sums[1] * sums[1] / n - along_u * along_u / energy
    hxy = sums[7] - sums[1] * sums[2] / n - along_u * along_v / energy
    hyy = sums[8] - sums[2] * sums[2] / n - along_v * along_v / energy
    determinant = hxx * hyy - hxy * hxy
    if determinant < 1e-6 * n * n or hxx + hyy < n * 0.2:
        return False, u, v
    for _ in range(SLIDES):
        if not (u >= RADIUS + 1.0 and v >= RADIUS + 1.0 and u + RADIUS + 3.0 < w and v + RADIUS + 3.0 < h):
            return False, u, v
        c, r = int(u), int(v)
        s0, s1, s2, total = products(current, c, r, np.float32(u - c), np.float32(v - r), middle, J)
        bt = s0 - base * total
        bx, by = s1 - sums[1] / n * total - along_u / energy * bt, s2 - sums[2] / n * total - along_v / energy * bt
        du, dv = (hyy * bx - hxy * by) / determinant, (hxx * by - hxy * bx) / determinant
        gain = min(max((bt - along_u * du - along_v * dv) / energy, 0.5), 2.0)
        du, dv = du / gain, dv / gain
        u, v = u - du, v - dv
        if du * du + dv * dv < settled:
            break
    return True, u, v


@inner
def descend(previous, newest, start, M, uv, lowest, settled, patch, J):
    """Improve a guess uv (2,), in place, by translation, from the coarsest pyramid level to lowest; False: not found.

    What is at uv + x in the newest image is at start + M x in the previous one. Only level 0 has to have an answer.
    settled: px^2 of a level, see slide().
    """
    good = True
    for level in range(len(previous) - 1 if lowest > 0 else 0, lowest - 1, -1):
        scale = 0.5**level
        good, u, v = slide(previous[level], newest[level], start[0] * scale, start[1] * scale, M, uv[0] * scale,
                           uv[1] * scale, settled, patch, J)
        if good:
            uv[0], uv[1] = u / scale, v / scale
    return good or lowest > 0
