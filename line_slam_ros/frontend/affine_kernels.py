"""Compiled alignment of learned patches with an image by an affine warp (see patch_kernels.py).

Of the template only the grey T and its two derivatives are kept: the Jacobian images are these times the coordinates,
and two numbers each correct their products with the image for not being orthogonal:

    template (3, AREA)   grey without mean, its derivatives by u and v
    moments (2, 7)       products of the 7 images (grey, then 6 of the Jacobian) with the grey, and their means
    inverse (6, 6)       of the normal matrix
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.frontend.patch_kernels import (
    AREA,
    DOWN,
    INSIDE,
    LANES,
    RADIUS,
    RIGHT,
    SETTLED,
    SIZE,
    cut,
    dot,
    gradient,
)
from line_slam_ros.geometry.small_systems import solve_positive
from line_slam_ros.kernel_cache import inner, kernel

STIFFNESS = 50.0  # a weak belief that the shape does not change
STEPS = 5  # iterations at most
FARTHEST = 32  # px, reach of a warped patch


@inner(fastmath=True)
def steepest(patch, J, moments):
    """Fill J (7, AREA) of a patch: its grey without mean, then the images of the parameters.

    These are u, v and the affine uu, uv, vu, vv (per RADIUS), made orthogonal to the grey and to 1.
    moments (2, 7): products with the grey before that, and means.
    """
    gradient(patch, J)
    for p in range(3, 7):
        image, by, weight = J[p], J[1 + (p - 3) // 2], RIGHT if p % 2 else DOWN
        for k in range(AREA):
            image[k] = by[k] * weight[k]
    area, grey = np.float32(SIZE * SIZE), J[0]
    for p in range(7):
        moments[1, p] = dot(J[p], INSIDE) / area
    base = np.float32(moments[1, 0])
    for k in range(AREA):
        grey[k] = (grey[k] - base) * INSIDE[k]
    moments[0, 0] = dot(grey, grey) + 1e-3
    for p in range(1, 7):
        image, mean = J[p], np.float32(moments[1, p])
        moments[0, p] = dot(grey, image)
        share = np.float32(moments[0, p] / moments[0, 0])
        for k in range(AREA):
            image[k] = (image[k] - mean - share * grey[k]) * INSIDE[k]


@kernel
def learn(image, uv, slots, templates, moments, inverses, ok):
    """Remember the patches at uv (N, 2) of the rows with ok (N,), which becomes False where it is not possible.

    Fills rows slots (N,) of templates, moments and inverses, see the module.
    """
    J, patch = np.empty((7, AREA), np.float32), np.zeros((SIZE + 2, LANES + 2), np.float32)
    H, identity = np.empty((6, 6)), np.zeros((6, 6))
    for p in range(6):
        identity[p, p] = 1.0
    for i in range(len(uv)):
        if not ok[i]:
            continue
        ok[i] = cut(image, uv[i, 0], uv[i, 1], patch)
        if not ok[i]:
            continue
        slot = slots[i]
        gradient(patch, templates[slot])
        steepest(patch, J, moments[slot])
        for k in range(AREA):  # by elements: assigning whole arrays compiles seconds of error messages
            templates[slot, 0, k] = J[0, k]
            templates[slot, 1, k] *= INSIDE[k]
            templates[slot, 2, k] *= INSIDE[k]
        for p in range(6):
            for q in range(p + 1):
                H[p, q] = H[q, p] = dot(J[1 + p], J[1 + q])
            H[p, p] += STIFFNESS if p > 1 else 1e-3
        ok[i] = H[0, 0] * H[1, 1] - H[0, 1] ** 2 >= 1e-3 * SIZE**4
        if ok[i]:
            solve_positive(H, identity, inverses[slot])


@inner
def inside(shape, u, v, A):
    """Does a patch at (u, v) + A (x, y) lie in the image, and not too far apart?"""
    reach_u = RADIUS * (abs(A[0, 0]) + abs(A[0, 1]))
    reach_v = (RADIUS + 1) * abs(A[1, 0]) + RADIUS * abs(A[1, 1])
    return u - reach_u >= 1.0 and v - reach_v >= 1.0 and u + reach_u < shape[1] - 2.0 \
        and v + reach_v < shape[0] - 2.0 and reach_u < FARTHEST and reach_v < FARTHEST


@inner
def workspace():
    """Buffers of align(): the warped patch and what bend() needs, right-hand side, step."""
    return (np.empty(3 * AREA, np.float32), np.empty(AREA, np.int32), np.empty(2 * AREA, np.uint16),
            np.empty(7), np.empty(6))


@inner(fastmath=True)
def bend(image, u, v, A, base, moved, index, greys):
    """Fill moved[:AREA] with grey of image (H, W) minus base at (u, v) + A (x, y), last column 0. It must be inside().

    moved (3 AREA,), index (AREA,), greys (2 AREA,): the rest is work space; each loop only reads or only computes.
    """
    flat, one, below = image.reshape(-1), np.uintp(1), np.uintp(image.shape[1])
    first_u, first_v = int(u) - FARTHEST, int(v) - FARTHEST  # small numbers from there on: exact enough in 32 bits
    at_u, at_v, width = np.float32(u - first_u), np.float32(v - first_v), np.int32(image.shape[1])
    corner = first_v * image.shape[1] + first_u
    a00, a01 = np.float32(A[0, 0] * RADIUS), np.float32(A[0, 1] * RADIUS)
    a10, a11 = np.float32(A[1, 0] * RADIUS), np.float32(A[1, 1] * RADIUS)
    byte, shift = np.uint16(255), np.uint16(8)
    for k in range(AREA):
        x, y = at_u + a00 * RIGHT[k] + a01 * DOWN[k], at_v + a10 * RIGHT[k] + a11 * DOWN[k]
        c, r = np.int32(x), np.int32(y)
        index[k] = r * width + c
        moved[AREA + k], moved[2 * AREA + k] = x - np.float32(c), y - np.float32(r)
    for k in range(AREA):
        here = np.uintp(index[k] + corner)
        low = here + below  # compilers make one read of each two
        greys[k] = np.uint16(flat[here]) | np.uint16(flat[here + one]) << shift
        greys[AREA + k] = np.uint16(flat[low]) | np.uint16(flat[low + one]) << shift
    for k in range(AREA):
        tops, lows, right = greys[k], greys[AREA + k], moved[AREA + k]
        a, b = np.float32(np.int32(tops & byte)), np.float32(np.int32(tops >> shift))
        c, d = np.float32(np.int32(lows & byte)), np.float32(np.int32(lows >> shift))
        top, low = a + right * (b - a), c + right * (d - c)
        moved[k] = (top + moved[2 * AREA + k] * (low - top) - base) * INSIDE[k]


@inner(fastmath=True)
def projections(template, moved, right):
    """Fill right (7,) with products of the grey and of the 6 Jacobian images with moved; (sum, squares) of moved."""
    zero = np.float32(0.0)
    grey, by_u, by_v = template[0], template[1], template[2]
    g = p = px = py = q = qx = qy = total = squares = zero
    for k in range(AREA):
        m, x, y = moved[k], RIGHT[k], DOWN[k]
        a, b = by_u[k] * m, by_v[k] * m
        g += grey[k] * m
        total += m
        squares += m * m
        p += a
        px += a * x
        py += a * y
        q += b
        qx += b * x
        qy += b * y
    right[0], right[1], right[2], right[3], right[4], right[5], right[6] = g, p, q, px, py, qx, qy
    return total, squares


@inner
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


@inner
def align(image, template, moments, inverse, uv, A, work):
    """Align a learned patch with the image by an affine warp: the guesses uv (2,) and A (2, 2) are improved in place.

    Returns their correlation, 0 when the patch left the image. work: workspace().
    """
    moved, index, greys, right, d = work
    n, base, energy, score = SIZE * SIZE, np.float32(moments[1, 0]), moments[0, 0], 0.0
    for _ in range(STEPS):
        if not inside(image.shape, uv[0], uv[1], A):
            return 0.0
        bend(image, uv[0], uv[1], A, base, moved, index, greys)
        total, squares = projections(template, moved, right)
        score = right[0] / np.sqrt(max((squares - total * total / n) * energy, 1.0))
        gain = right[0]
        for p in range(1, 7):
            right[p] -= moments[1, p] * total + moments[0, p] / energy * right[0]
        for p in range(6):
            d[p] = 0.0
            for q in range(6):
                d[p] += inverse[p, q] * right[1 + q]
            gain -= moments[0, 1 + p] * d[p]
        gain = min(max(gain / energy, 0.5), 2.0)
        for p in range(6):
            d[p] /= gain
        if not improve(uv, A, d):
            return 0.0
        if d[0] * d[0] + d[1] * d[1] < SETTLED:
            break
    return score
