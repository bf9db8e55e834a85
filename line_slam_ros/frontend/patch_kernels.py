"""Compiled alignment (inverse compositional Lucas-Kanade) of square patches, blind to gain and offset of the light.

A patch of SIZE x SIZE pixels is sampled around (u, v); the residual of every pixel is

    e = I(W(x)) - (1 + gain) T(x) - offset

and the template's own gradient gives the Jacobian, so that the normal matrix is inverted once per template
(Baker and Matthews, Lucas-Kanade 20 years on, 2004, inverse compositional algorithm). Gain and offset are eliminated:
the Jacobian images are made orthogonal to T and to 1, and their products with T vanish, so that the right-hand side is
their product with the image itself.

A template is kept with a ring for its gradient, (SIZE + 2, LANES + 2). Rows of work space are LANES wide, one more than
SIZE, which processors like; the last column is 0.
"""
from __future__ import annotations

import numpy as np
from numba import njit

RADIUS = 7  # px
SIZE = 2 * RADIUS + 1
LANES = 16
STRAIGHT = 0.02  # largest entry of a map minus identity for which a patch is cut along rows: 0.14 px at its rim
STIFFNESS = 50.0  # a weak belief that the shape does not change
ONE = np.float32(1.0)
HALF = np.float32(0.5)
AREA = SIZE * LANES
DOWN, RIGHT = ((np.mgrid[:SIZE, :LANES] - RADIUS) / RADIUS).astype(np.float32).reshape(2, AREA)  # in units of RADIUS
INSIDE = (RIGHT <= 1.0).astype(np.float32)


@njit(cache=True, nogil=True, error_model='numpy', fastmath=True)
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


@njit(cache=True, nogil=True, error_model='numpy', fastmath=True)
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


@njit(cache=True, nogil=True, error_model='numpy', fastmath=True)
def dot(a, b):
    """Sum of products of two flat images (AREA,)."""
    total = np.float32(0.0)
    for k in range(AREA):
        total += a[k] * b[k]
    return total


@njit(cache=True, nogil=True, error_model='numpy', fastmath=True)
def gradient(patch, J):
    """Fill J[:3] (3, AREA) with the grey of a patch and its derivatives by u and v."""
    for y in range(SIZE):
        up, row, low = patch[y], patch[y + 1], patch[y + 2]
        grey, by_u, by_v = J[0, y * LANES:], J[1, y * LANES:], J[2, y * LANES:]
        for x in range(LANES):
            grey[x] = row[x + 1]
            by_u[x] = HALF * (row[x + 2] - row[x])
            by_v[x] = HALF * (low[x + 1] - up[x + 1])


@njit(cache=True, nogil=True, error_model='numpy', fastmath=True)
def steepest(patch, J, along):
    """Fill J (1 + P, AREA) of a patch: its grey without mean, then the images of P parameters.

    P = 2: u, v; P = 6: and the affine uu, uv, vu, vv (per RADIUS); all made orthogonal to the grey and to 1.
    along (1 + P,): products with the grey before that. Returns the patch's mean.
    """
    gradient(patch, J)
    for p in range(3, len(J)):
        image, by, weight = J[p], J[1 + (p - 3) // 2], RIGHT if p % 2 else DOWN
        for k in range(AREA):
            image[k] = by[k] * weight[k]
    base, grey = dot(J[0], INSIDE) / np.float32(SIZE * SIZE), J[0]
    for k in range(AREA):
        grey[k] = (grey[k] - base) * INSIDE[k]
    along[0] = dot(grey, grey) + 1e-3
    for p in range(1, len(J)):
        image = J[p]
        mean = dot(image, INSIDE) / np.float32(SIZE * SIZE)
        along[p] = dot(grey, image)
        share = np.float32(along[p] / along[0])
        for k in range(AREA):
            image[k] = (image[k] - mean - share * grey[k]) * INSIDE[k]
    return base


@njit(cache=True, nogil=True, error_model='numpy', fastmath=True)
def products(image, u, v, J):
    """(inside, products of J (3, AREA) with the grey around (u, v))."""
    h, w = image.shape
    c, r = int(np.floor(u)) - RADIUS, int(np.floor(v)) - RADIUS
    s0 = s1 = s2 = np.float32(0.0)
    if not (c >= 1 and r >= 1 and c + LANES + 1 < w and r + LANES + 1 < h):
        return False, s0, s1, s2
    a, b = np.float32(u - np.floor(u)), np.float32(v - np.floor(v))
    for y in range(SIZE):
        top, low = image[r + y, c:c + LANES + 1], image[r + y + 1, c:c + LANES + 1]
        j0, j1, j2 = J[0, y * LANES:], J[1, y * LANES:], J[2, y * LANES:]
        for x in range(LANES):
            grey = (ONE - b) * ((ONE - a) * top[x] + a * top[x + 1]) + b * ((ONE - a) * low[x] + a * low[x + 1])
            s0 += j0[x] * grey
            s1 += j1[x] * grey
            s2 += j2[x] * grey
    return True, s0, s1, s2


@njit(cache=True, nogil=True, error_model='numpy')
def slide(previous, current, u0, v0, M, u, v, steps, patch, J):
    """Translate (u, v) in current until it shows what previous shows at (u0, v0) + M (x, y).

    patch (SIZE + 2, LANES + 2), J (3, AREA): work space. Returns (ok, u, v).
    """
    turned = max(abs(M[0, 0] - 1.0), abs(M[0, 1]), abs(M[1, 0]), abs(M[1, 1] - 1.0)) > STRAIGHT
    if not (warp(previous, u0, v0, M, RADIUS + 1, np.float32(0.0), patch) if turned else
            cut(previous, u0, v0, patch)):
        return False, u, v
    along = np.empty(3)
    steepest(patch, J, along)
    hxx, hxy, hyy = np.float64(dot(J[1], J[1])), np.float64(dot(J[1], J[2])), np.float64(dot(J[2], J[2]))
    determinant, n = hxx * hyy - hxy * hxy, SIZE * SIZE
    if determinant < 1e-6 * n * n or hxx + hyy < n * 0.2:
        return False, u, v
    for _ in range(steps):
        inside, bt, bx, by = products(current, u, v, J)
        if not inside:
            return False, u, v
        du, dv = (hyy * bx - hxy * by) / determinant, (hxx * by - hxy * bx) / determinant
        gain = min(max((bt - along[1] * du - along[2] * dv) / along[0], 0.5), 2.0)
        du, dv = du / gain, dv / gain
        u, v = u - du, v - dv
        if du * du + dv * dv < 4e-4:
            break
    return True, u, v


@njit(cache=True, nogil=True, error_model='numpy')
def follow(previous, current, start, maps, uv, lowest, steps, ok):
    """Move guesses uv (N, 2), in place, by translation of patches, from the coarsest pyramid level to lowest.

    What is at uv + x in current is at start + maps x in previous, maps (N, 2, 2). Only rows with ok (N,) are looked at;
    it becomes False where level 0 has no answer (a coarse one may be left out).
    """
    patch, J = np.zeros((SIZE + 2, LANES + 2), np.float32), np.empty((3, AREA), np.float32)
    for i in range(len(start)):
        if not ok[i]:
            continue
        u, v = uv[i]
        for level in range(len(previous) - 1, lowest - 1, -1):
            scale = 0.5 ** level
            good, a, b = slide(previous[level], current[level], start[i, 0] * scale, start[i, 1] * scale, maps[i],
                               u * scale, v * scale, steps, patch, J)
            if good:
                u, v = a / scale, b / scale
            elif level == 0:
                ok[i] = False
        uv[i, 0], uv[i, 1] = u, v


@njit(cache=True, nogil=True, error_model='numpy')
def learn(image, uv, templates, inverses, ok):
    """Remember the patches at uv (N, 2) of the rows with ok (N,), which becomes False where it is not possible.

    templates (N, SIZE + 2, LANES + 2), inverses (N, 6, 6) of the normal matrix.
    """
    J, H, along = np.empty((7, AREA), np.float32), np.empty((6, 6)), np.empty(7)
    for i in range(len(uv)):
        if not ok[i]:
            continue
        templates[i, :, LANES + 1] = 0.0
        ok[i] = cut(image, uv[i, 0], uv[i, 1], templates[i])
        if not ok[i]:
            continue
        steepest(templates[i], J, along)
        for p in range(6):
            for q in range(p + 1):
                H[p, q] = H[q, p] = dot(J[1 + p], J[1 + q])
            H[p, p] += STIFFNESS if p > 1 else 1e-3
        ok[i] = H[0, 0] * H[1, 1] - H[0, 1] ** 2 >= 1e-3 * SIZE**4
        if ok[i]:
            inverses[i] = np.linalg.inv(H)


@njit(cache=True, nogil=True, error_model='numpy')
def improve(uv, A, d):
    """Compose the map x -> uv + A x, in place, with the inverse of x -> x + D x + d; False if that is degenerate.

    d (6,): u, v, then D per RADIUS by rows.
    """
    d00, d01, d10, d11 = 1.0 + d[2] / RADIUS, d[3] / RADIUS, d[4] / RADIUS, 1.0 + d[5] / RADIUS
    determinant = d00 * d11 - d01 * d10
    if not determinant > 0.25:
        return False
    i00, i01, i10, i11 = d11 / determinant, -d01 / determinant, -d10 / determinant, d00 / determinant
    a00, a01, a10, a11 = A[0, 0], A[0, 1], A[1, 0], A[1, 1]
    A[0, 0], A[0, 1] = a00 * i00 + a01 * i10, a00 * i01 + a01 * i11
    A[1, 0], A[1, 1] = a10 * i00 + a11 * i10, a10 * i01 + a11 * i11
    uv[0] -= A[0, 0] * d[0] + A[0, 1] * d[1]
    uv[1] -= A[1, 0] * d[0] + A[1, 1] * d[1]
    return True


@njit(cache=True, nogil=True, error_model='numpy')
def align(image, templates, inverses, uv, shapes, steps, score):
    """Align remembered patches with image by an affine warp.

    templates and inverses as learned; guesses uv (N, 2) and shapes (N, 2, 2) are improved in place.
    score (N,): correlation of the aligned patches, 0 when they left the image.
    """
    square, J = np.zeros((SIZE, LANES), np.float32), np.empty((7, AREA), np.float32)
    moved, along, right, d, n = square.reshape(-1), np.empty(7), np.empty(6), np.empty(6), SIZE * SIZE
    for i in range(len(uv)):
        base = steepest(templates[i], J, along)
        settled = False
        for step in range(steps + 1):
            score[i] = 0.0
            if not warp(image, uv[i, 0], uv[i, 1], shapes[i], RADIUS, base, square):
                break
            product, mean = dot(J[0], moved), dot(moved, INSIDE) / n
            score[i] = product / np.sqrt(max((dot(moved, moved) - n * mean * mean) * along[0], 1.0))
            if settled or step == steps:
                break
            gain = np.float64(product)
            for p in range(6):
                right[p] = dot(J[1 + p], moved)
            for p in range(6):
                d[p] = 0.0
                for q in range(6):
                    d[p] += inverses[i, p, q] * right[q]
                gain -= along[1 + p] * d[p]
            d /= min(max(gain / along[0], 0.5), 2.0)
            if not improve(uv[i], shapes[i], d):
                score[i] = 0.0
                break
            settled = d[0] * d[0] + d[1] * d[1] < 4e-4
