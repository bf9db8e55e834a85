"""Grey values across segments: the compiled inner loops of edge_kernels.py.

Pixels are those of an undistorted canvas. No such image is made: ``lens`` (H, W, 2) tells where each LENS_STEP-th pixel
of the canvas lies in the image as received (NaN where the lens does not see). SAMPLES profiles are cut at a time, one
in each column of a table: processors like to work on whole rows of it.
"""
from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from line_slam_ros.types import U8

LENS_STEP = 4  # px, of the table of the lens; between, it is linear to 0.01 px
BORDER = 4.0  # px of the received image that are not trusted
SAMPLES = 32  # profiles across a segment
PLACE = 4  # rows of a table of places: u, v of the received image and the step there of one pixel across


def neighbours(image: U8) -> NDArray[np.uint16]:
    """View (H W - 1,) of image (H, W), row by row: a pixel and, in the high byte, the next. One read instead of two."""
    return np.ndarray((image.size - 1,), np.dtype('<u2'), image, strides=(1,))


@njit(cache=True, nogil=True, error_model='numpy')
def place(lens, shape, u, v, du, dv, nu, nv, half, first, end, at, seen):
    """Where samples (u, v) + k (du, dv) of the canvas lie in the received image of this shape; columns first + k < end.

    at (PLACE, SAMPLES) <- u, v and the step that (nu, nv) becomes; seen (SAMPLES,) <- 1 where half such steps both ways
    stay inside, else 0 and a harmless place. The lens is taken as linear around each sample: what lies a pixel from
    there, as measured edges do, is out of place by some 0.001 px, 10 px from there by 0.1 px.
    """
    height, width = shape
    one, unit = np.float32(1.0), np.float32(1.0 / LENS_STEP)
    low, high_u, high_v = np.float32(BORDER), np.float32(width - 1.0 - BORDER), np.float32(height - 1.0 - BORDER)
    nu, nv, reach = np.float32(nu) * unit, np.float32(nv) * unit, np.float32(half)
    last_a, last_b = lens.shape[1] - 1.0, lens.shape[0] - 1.0
    for i in range(first, end):
        at[0, i], at[1, i], at[2, i], at[3, i], seen[i] = low, low, 0.0, 0.0, 0.0
        k = i - first
        a, b = (u + k * du) * (1.0 / LENS_STEP), (v + k * dv) * (1.0 / LENS_STEP)
        if not (a >= 0.0 and b >= 0.0 and a < last_a and b < last_b):
            continue
        c, r = np.uintp(int(a)), np.uintp(int(b))
        a, b = np.float32(a - int(a)), np.float32(b - int(b))
        here, below = lens[r], lens[r + np.uintp(1)]
        right = c + np.uintp(1)
        u0, v0 = here[c, 0], here[c, 1]
        u1, v1 = here[right, 0], here[right, 1]
        u2, v2 = below[c, 0], below[c, 1]
        u3, v3 = below[right, 0], below[right, 1]
        left_u, left_v = u0 + b * (u2 - u0), v0 + b * (v2 - v0)
        along_u, along_v = u1 + b * (u3 - u1) - left_u, v1 + b * (v3 - v1) - left_v
        step_u = nu * along_u + nv * ((one - a) * (u2 - u0) + a * (u3 - u1))
        step_v = nu * along_v + nv * ((one - a) * (v2 - v0) + a * (v3 - v1))
        x, y, reach_u, reach_v = left_u + a * along_u, left_v + a * along_v, reach * abs(step_u), reach * abs(step_v)
        if x - reach_u >= low and y - reach_v >= low and x + reach_u < high_u and y + reach_v < high_v:
            at[0, i], at[1, i], at[2, i], at[3, i], seen[i] = x, y, step_u, step_v, 1.0


@njit(cache=True, nogil=True, error_model='numpy', fastmath=True)
def sample(pairs, width, at, half, values):
    """Fill values (2 half + 1, SAMPLES) with bilinear grey at places at (PLACE, SAMPLES) + k steps, |k| <= half.

    pairs: neighbours() of the image of this width.
    """
    index, below, width = np.empty(SAMPLES, np.int32), np.uintp(width), np.int32(width)
    right, down = np.empty(SAMPLES, np.float32), np.empty(SAMPLES, np.float32)
    tops, lows = np.empty(SAMPLES, np.uint16), np.empty(SAMPLES, np.uint16)
    byte, shift = np.uint16(255), np.uint16(8)
    for k in range(2 * half + 1):
        far, row = np.float32(k - half), values[k]
        for i in range(SAMPLES):
            u, v = at[0, i] + far * at[2, i], at[1, i] + far * at[3, i]
            c, r = np.int32(u), np.int32(v)
            index[i] = r * width + c
            right[i], down[i] = u - np.float32(c), v - np.float32(r)
        for i in range(SAMPLES):
            k0 = np.uintp(index[i])
            tops[i], lows[i] = pairs[k0], pairs[k0 + below]
        for i in range(SAMPLES):
            a, b = np.float32(np.int32(tops[i] & byte)), np.float32(np.int32(tops[i] >> shift))
            c, d = np.float32(np.int32(lows[i] & byte)), np.float32(np.int32(lows[i] >> shift))
            top, low = a + right[i] * (b - a), c + right[i] * (d - c)
            row[i] = top + down[i] * (low - top)
