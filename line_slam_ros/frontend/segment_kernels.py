"""Compiled search for straight edges: regions of pixels whose gradients point the same way.

After von Gioi et al., LSD: a line segment detector (2012), without its statistical test: what is found here is
measured on the image before it is believed.
"""
from __future__ import annotations

import numpy as np
from numba import njit

FLAT = 5.2  # grey/px: below, rounding of the grey values alone turns the gradient by more than ALIKE
ALIKE = np.float32(np.cos(np.radians(22.5)))  # of the directions of two gradients on one edge
LEVELS = 512  # more than the largest gradient, grey/px


@njit(cache=True, nogil=True, error_model='numpy')
def gradients(image, direction, strength):
    """Fill direction (H, W, 2) and strength (H, W) grey/px at the corners (x + 0.5, y + 0.5); 0 where flat."""
    h, w = image.shape
    half = np.float32(0.5)
    strength[:] = np.float32(0.0)
    for y in range(1, h - 2):
        row, low = image[y], image[y + 1]
        for x in range(1, w - 2):
            a, b = np.float32(low[x + 1]) - np.float32(row[x]), np.float32(row[x + 1]) - np.float32(low[x])
            gx, gy = half * (a + b), half * (a - b)
            square = gx * gx + gy * gy
            if square > FLAT * FLAT:
                norm = np.sqrt(square)
                strength[y, x] = norm
                direction[y, x, 0], direction[y, x, 1] = gx / norm, gy / norm


@njit(cache=True, nogil=True, error_model='numpy')
def strongest_first(strength):
    """Indices (K,) of the pixels of flat strength (P,) that are not 0, by falling strength in whole steps."""
    first = np.zeros(LEVELS + 1, np.int64)
    for value in strength:
        if value > 0.0:
            first[LEVELS - int(value)] += 1
    order = np.empty(first.sum(), np.int64)
    total = 0
    for level in range(LEVELS + 1):
        first[level], total = total, total + first[level]
    for k in range(len(strength)):
        if strength[k] > 0.0:
            level = LEVELS - int(strength[k])
            order[first[level]] = k
            first[level] += 1
    return order


@njit(cache=True, nogil=True, error_model='numpy')
def grow(seed, width, direction, free, region):
    """Fill region with the free pixels connected to seed whose gradients agree with their mean; they are taken.

    direction (P, 2), free (P,) of the flat image of this width. Returns (count, sum of directions u, v).
    """
    region[0], n, k = seed, 1, 0
    free[seed] = False
    su, sv = direction[seed, 0], direction[seed, 1]
    while k < n:
        for row in (-width, 0, width):
            for column in (-1, 0, 1):
                at = region[k] + row + column
                if free[at]:
                    along = direction[at, 0] * su + direction[at, 1] * sv
                    if along > 0.0 and along * along > ALIKE * ALIKE * (su * su + sv * sv):
                        free[at] = False
                        region[n] = at
                        n += 1
                        su += direction[at, 0]
                        sv += direction[at, 1]
        k += 1
    return n, su, sv


@njit(cache=True, nogil=True, error_model='numpy')
def straight(region, width, strength, su, sv, ends):
    """Fill ends (2, 2) px of the axis of region (N,) pixels, the brighter side (su, sv) along its normal."""
    w = u = v = uu = uv = vv = 0.0
    for at in region:
        s, x, y = strength[at], at % width, at // width
        w += s
        u += s * x
        v += s * y
        uu += s * x * x
        uv += s * x * y
        vv += s * y * y
    u, v = u / w, v / w
    angle = 0.5 * np.arctan2(2.0 * (uv / w - u * v), uu / w - u * u - vv / w + v * v)
    tu, tv = np.cos(angle), np.sin(angle)
    if tv * su - tu * sv > 0.0:  # the normal is (-tv, tu)
        tu, tv = -tu, -tv
    first = last = 0.0
    for at in region:
        along = (at % width - u) * tu + (at // width - v) * tv
        first, last = min(first, along), max(last, along)
    ends[0, 0], ends[0, 1] = u + 0.5 + first * tu, v + 0.5 + first * tv
    ends[1, 0], ends[1, 1] = u + 0.5 + last * tu, v + 0.5 + last * tv


@njit(cache=True, nogil=True, error_model='numpy')
def segments(image, shortest):
    """Ends (M, 2, 2) px of the straight edges of image (H, W) with at least so many px, brighter along (-t_v, t_u)."""
    h, w = image.shape
    strength = np.empty((h, w), np.float32)
    direction = np.empty((h, w, 2), np.float32)
    gradients(image, direction, strength)
    flat, way = strength.reshape(-1), direction.reshape(-1, 2)
    order, free = strongest_first(flat), flat > 0.0
    region, found, m = np.empty(len(order) + 1, np.int64), np.empty((int(len(order) / shortest) + 1, 2, 2)), 0
    for seed in order:
        if free[seed]:
            n, su, sv = grow(seed, w, way, free, region)
            if n >= shortest:
                straight(region[:n], w, flat, su, sv, found[m])
                m += 1
    return found[:m]
