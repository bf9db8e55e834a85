"""Grey values across segments: the compiled inner loops of edge_kernels.py.

Pixels are those of an undistorted canvas. No such image is made: ``lens`` (H, W, 2) tells where each LENS_STEP-th pixel
of the canvas lies in the image as received (NaN where the lens does not see). SAMPLES profiles are cut at a time, one
in each column of a table, and each loop does one thing to all of them (reading, or computing): processors like that.
Numbers of the samples lie one after the other in a single array, so that compilers see that they do not overlap.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.kernel_cache import kernel

LENS_STEP = 4  # px, of the table of the lens; between, it is linear to 0.01 px
BORDER = 4.0  # px of the received image that are not trusted
SAMPLES = 32  # profiles across a segment
U, V, STEP_U, STEP_V, SEEN = (SAMPLES * k for k in range(5))  # where in places: of the received image, its step per
# pixel across the segment, and 1 or 0 for whether the camera sees all of the profile
A, B, NEAR, FAR = (SAMPLES * k for k in (5, 6, 7, 11))  # the rest is work space
PLACES = SAMPLES * 15


@kernel
def place(lens, shape, u, v, du, dv, nu, nv, half, first, count, places, index):
    """Where samples (u, v) + k (du, dv), k < count, of the canvas lie in the received image of this shape.

    places (PLACES,) <- at columns first + k: u, v and the step that (nu, nv) becomes; 1 where half such steps both ways
    stay inside, else 0 and a harmless place. The lens is taken as linear around each sample: what lies a pixel from
    there, as measured edges do, is out of place by some 0.001 px, 10 px from there by 0.1 px. index (SAMPLES,): work
    space.
    """
    (height, width), columns, flat = shape, np.int32(lens.shape[1]), lens.reshape(-1)
    one, zero, unit = np.float32(1.0), np.float32(0.0), np.float32(1.0 / LENS_STEP)
    low, high_u, high_v = np.float32(BORDER), np.float32(width - 1.0 - BORDER), np.float32(height - 1.0 - BORDER)
    nu, nv, reach = np.float32(nu) * unit, np.float32(nv) * unit, np.float32(half)
    last_a, last_b, below = lens.shape[1] - 1.0, lens.shape[0] - 1.0, np.uintp(2 * lens.shape[1])
    for k in range(count):
        i = first + k
        a, b = (u + k * du) * (1.0 / LENS_STEP), (v + k * dv) * (1.0 / LENS_STEP)
        inside = (a >= 0.0) & (b >= 0.0) & (a < last_a) & (b < last_b)
        a, b = a if inside else 0.0, b if inside else 0.0
        c, r = np.int32(a), np.int32(b)
        places[A + i], places[B + i], places[SEEN + i] = np.float32(a - c), np.float32(b - r), one if inside else zero
        index[i] = np.int32(2) * (r * columns + c)
    for i in range(first, first + count):
        here = np.uintp(index[i])
        for k in range(4):  # u and v of a pixel of the table, and of the next
            places[NEAR + SAMPLES * k + i] = flat[here + np.uintp(k)]
            places[FAR + SAMPLES * k + i] = flat[here + below + np.uintp(k)]
    for i in range(first, first + count):
        a, b = places[A + i], places[B + i]
        u0, v0, u1, v1 = places[NEAR + i], places[NEAR + SAMPLES + i], places[NEAR + 2 * SAMPLES + i], \
            places[NEAR + 3 * SAMPLES + i]
        u2, v2, u3, v3 = places[FAR + i], places[FAR + SAMPLES + i], places[FAR + 2 * SAMPLES + i], \
            places[FAR + 3 * SAMPLES + i]
        left_u, left_v = u0 + b * (u2 - u0), v0 + b * (v2 - v0)
        along_u, along_v = u1 + b * (u3 - u1) - left_u, v1 + b * (v3 - v1) - left_v
        step_u = nu * along_u + nv * ((one - a) * (u2 - u0) + a * (u3 - u1))
        step_v = nu * along_v + nv * ((one - a) * (v2 - v0) + a * (v3 - v1))
        x, y, reach_u, reach_v = left_u + a * along_u, left_v + a * along_v, reach * abs(step_u), reach * abs(step_v)
        good = (x - reach_u >= low) & (y - reach_v >= low) & (x + reach_u < high_u) & (y + reach_v < high_v) \
            & (places[SEEN + i] > zero)
        places[U + i], places[V + i] = x if good else low, y if good else low
        places[STEP_U + i], places[STEP_V + i] = step_u if good else zero, step_v if good else zero
        places[SEEN + i] = one if good else zero


@kernel(fastmath=True)
def sample(image, places, half, values, index, greys):
    """Fill values (2 half + 1, SAMPLES) with bilinear grey of image (H, W) at places + k steps, |k| <= half.

    places: as filled by place(); index (SAMPLES,), greys (2 SAMPLES,): work space.
    """
    width, flat, one = np.int32(image.shape[1]), image.reshape(-1), np.uintp(1)
    below, byte, shift = np.uintp(image.shape[1]), np.uint16(255), np.uint16(8)
    for k in range(2 * half + 1):
        far = np.float32(k - half)
        for i in range(SAMPLES):
            u, v = places[U + i] + far * places[STEP_U + i], places[V + i] + far * places[STEP_V + i]
            c, r = np.int32(u), np.int32(v)
            index[i] = r * width + c
            places[A + i], places[B + i] = u - np.float32(c), v - np.float32(r)
        for i in range(SAMPLES):
            here = np.uintp(index[i])
            low = here + below  # compilers make one read of each two
            greys[i] = np.uint16(flat[here]) | np.uint16(flat[here + one]) << shift
            greys[SAMPLES + i] = np.uint16(flat[low]) | np.uint16(flat[low + one]) << shift
        for i in range(SAMPLES):
            tops, lows, right = greys[i], greys[SAMPLES + i], places[A + i]
            a, b = np.float32(np.int32(tops & byte)), np.float32(np.int32(tops >> shift))
            c, d = np.float32(np.int32(lows & byte)), np.float32(np.int32(lows >> shift))
            top, low = a + right * (b - a), c + right * (d - c)
            values[k, i] = top + places[B + i] * (low - top)
