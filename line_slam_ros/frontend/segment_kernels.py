"""Compiled search for straight edges: regions of pixels whose gradients point the same way.

After von Gioi et al., LSD: a line segment detector (2012), without its statistical test: what is found here is
measured on the image before it is believed. So whole steps of the gradient's strength and 1/256 turns of its direction
are enough.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.kernel_cache import inner, kernel

FLAT = np.float32(5.2)  # grey/px: below, rounding of the grey values alone turns the gradient by more than ALIKE
ALIKE = np.float32(16.0)  # 1/256 turns between the gradients of one edge and their mean: 22.5 degrees
TURN = np.float32(256.0 / (2.0 * np.pi))  # 1/256 turns per rad
STRONGEST = 255


def buffers(height, width):
    """Work space of segments() for images of this size: strength, angle, crests; places in order, of a region.

    A place is y << 16 | x.
    """
    return (np.zeros((height, width), np.uint8), np.zeros((height, width), np.uint8),
            np.zeros((height, width), np.uint8), np.empty(height * width, np.int32),
            np.empty(height * width, np.int32))


@inner(fastmath=True)
def gradients(image, strength, angle):
    """Fill strength (H, W), grey/px, and angle (H, W), 1/256 turns but 1 for 0, at (x + 0.5, y + 0.5); 0 where flat.

    The arctangent is good to 0.3 degrees. The rim of both images is left as it is: 0.
    """
    h, w = image.shape
    half, one, zero, top = np.float32(0.5), np.float32(1.0), np.float32(0.0), np.float32(STRONGEST)
    quarter, pi, tiny = np.float32(0.5 * np.pi), np.float32(np.pi), np.float32(1e-6)
    for y in range(1, h - 2):
        row, low, here, way = image[y, 1:], image[y + 1, 1:], strength[y, 1:], angle[y, 1:]
        for x in range(w - 3):
            a, b = np.float32(low[x + 1]) - np.float32(row[x]), np.float32(row[x + 1]) - np.float32(low[x])
            gu, gv = half * (a + b), half * (a - b)
            norm, u, v = np.sqrt(gu * gu + gv * gv), abs(gu), abs(gv)
            t = min(u, v) / (max(u, v) + tiny)
            turn = t * (np.float32(0.97239411) - np.float32(0.19194795) * t * t)
            turn = quarter - turn if v > u else turn
            turn = pi - turn if gu < zero else turn
            turn = pi + pi - turn if gv < zero else turn
            edge = one if norm > FLAT else zero
            here[x] = np.uint8(np.int32(edge * min(norm, top)))
            way[x] = np.uint8(np.int32(edge * max(turn * TURN, one)) & 255)


@inner(fastmath=True)
def crests(strength, angle, crest):
    """Fill crest (H, W) with angle where strength is largest across the edge, by rows or columns, and 0 elsewhere."""
    h, w = strength.shape
    for y in range(1, h - 1):
        up, row, low, way, out = strength[y - 1, 1:], strength[y], strength[y + 1, 1:], angle[y, 1:], crest[y, 1:]
        for x in range(w - 2):
            upright = (np.uint8(way[x] + np.uint8(32)) & np.uint8(64)) > np.uint8(0)  # the gradient, not the edge
            before, after = up[x] if upright else row[x], low[x] if upright else row[x + 2]
            out[x] = way[x] if (row[x + 1] >= before) & (row[x + 1] > after) else np.uint8(0)


@inner
def strongest_first(strength, crest, found, order):
    """Fill order (P,) with y << 16 | x of the pixels where crest (H, W) is not 0, by falling strength; returns P.

    found (P,): work space.
    """
    h, w = strength.shape
    first, p, total, low = np.zeros(STRONGEST + 1, np.int64), 0, 0, np.int32(0xFFFF)
    for y in range(h):
        row = crest[y]
        for x in range(w):  # without a branch, which would be mispredicted
            found[p] = y << 16 | x
            p += row[x] != 0
    for at in found[:p]:
        first[strength[at >> 16, at & low]] += 1
    for level in range(STRONGEST, -1, -1):
        first[level], total = total, total + first[level]
    for at in found[:p]:
        value = strength[at >> 16, at & low]
        order[first[value]] = at
        first[value] += 1
    return p


@inner
def grow(x, y, angle, region):
    """Fill region (N,) with the places connected to (x, y) whose gradients agree with their mean; angle <- 0 there.

    Returns N and the mean direction, rad.
    """
    seed, n, k, total = np.int32(angle[y, x]), 1, 0, np.float32(0.0)
    mean = total  # beyond the seed's
    region[0] = y << 16 | x
    angle[y, x] = 0
    while k < n:
        x, y = region[k] & 0xFFFF, region[k] >> 16
        for v in range(y - 1, y + 2):
            row = angle[np.uintp(v)]
            for u in range(x - 1, x + 2):
                value = np.int32(row[np.uintp(u)])
                if value:
                    beyond = np.float32(((value - seed + 128) & 255) - 128)
                    if abs(beyond - mean) < ALIKE:
                        row[np.uintp(u)] = 0
                        region[n] = v << 16 | u
                        n += 1
                        total += beyond
                        mean = total / np.float32(n)
        k += 1
    return n, (np.float32(seed) + mean) / TURN


@inner
def straight(region, strength, direction, ends):
    """Fill ends (2, 2) px of the axis of region (N,), the brighter side (direction, rad) along its normal."""
    w = u = v = uu = uv = vv = 0.0
    x0, y0 = region[0] & 0xFFFF, region[0] >> 16
    for at in region:
        s, x, y = strength[at >> 16, at & 0xFFFF], (at & 0xFFFF) - x0, (at >> 16) - y0
        w += s
        u += s * x
        v += s * y
        uu += s * x * x
        uv += s * x * y
        vv += s * y * y
    u, v = u / w, v / w
    axis = 0.5 * np.arctan2(2.0 * (uv / w - u * v), uu / w - u * u - vv / w + v * v)
    tu, tv = np.cos(axis), np.sin(axis)
    if tv * np.cos(direction) - tu * np.sin(direction) > 0.0:  # the normal is (-tv, tu)
        tu, tv = -tu, -tv
    u, v, first, last = u + x0, v + y0, 0.0, 0.0
    for at in region:
        along = ((at & 0xFFFF) - u) * tu + ((at >> 16) - v) * tv
        first, last = min(first, along), max(last, along)
    ends[0, 0], ends[0, 1] = u + 0.5 + first * tu, v + 0.5 + first * tv
    ends[1, 0], ends[1, 1] = u + 0.5 + last * tu, v + 0.5 + last * tv


@kernel
def segments(image, shortest, work):
    """Ends (M, 2, 2) px of the straight edges of image (H, W) with at least so many px, brighter along (-t_v, t_u).

    work: buffers() of this size.
    """
    strength, angle, crest, order, region = work
    gradients(image, strength, angle)
    crests(strength, angle, crest)
    p, m, fewest = strongest_first(strength, crest, region, order), 0, np.sqrt(0.5) * shortest
    found = np.empty((int(p / fewest) + 1, 2, 2))
    for k in range(p):
        x, y = order[k] & 0xFFFF, order[k] >> 16
        if crest[y, x]:
            n, direction = grow(x, y, crest, region)
            if n >= fewest:
                straight(region[:n], strength, direction, found[m])
                m += 1
    return found[:m]
