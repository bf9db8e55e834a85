"""Compiled binomial filters: what cv2.GaussianBlur (3 x 3) and cv2.pyrDown give, to the bit, in half the time."""
from __future__ import annotations

import numpy as np

from line_slam_ros.kernel_cache import kernel


@kernel
def smooth(image, row, out):
    """Fill out (H, W) with image (H, W), 2 x 2 and more, under the weights 1 2 1; beyond its rim it is mirrored.

    row (W + 4,) uint16: work space.
    """
    (h, w), two, half, shift = image.shape, np.uint16(2), np.uint16(8), np.uint16(4)
    for y in range(h):
        up, middle, low, to = image[abs(y - 1)], image[y], image[y + 1 if y + 1 < h else h - 2], out[y]
        for x in range(w):
            row[x + 1] = np.uint16(up[x]) + np.uint16(low[x]) + two * np.uint16(middle[x])
        row[0], row[w + 1] = row[2], row[w - 1]
        for x in range(w):
            to[x] = np.uint8(np.uint16(row[x] + row[x + 2] + two * row[x + 1] + half) >> shift)


@kernel
def halve(image, row, out):
    """Fill out ((H + 1) / 2, (W + 1) / 2) with every second pixel of image (H, W), 3 x 3 and more, under the weights
    1 4 6 4 1; beyond its rim it is mirrored. row (W + 4,) uint16: work space."""
    (h, w), four, six, half, shift = image.shape, np.uint16(4), np.uint16(6), np.uint16(128), np.uint16(8)
    for k in range(len(out)):
        y, to = 2 * k, out[k]
        last = 2 * (h - 1)
        far, up, middle = image[abs(y - 2)], image[abs(y - 1)], image[y]
        low, end = image[min(y + 1, last - y - 1)], image[min(y + 2, last - y - 2)]
        for x in range(w):
            row[x + 2] = np.uint16(far[x]) + np.uint16(end[x]) + four * (np.uint16(up[x]) + np.uint16(low[x])) \
                + six * np.uint16(middle[x])
        row[0], row[1], row[w + 2], row[w + 3] = row[4], row[3], row[w], row[w - 1]
        for j in range(out.shape[1]):
            x = 2 * j
            to[j] = np.uint8(np.uint16(row[x] + row[x + 4] + four * (row[x + 1] + row[x + 3]) + six * row[x + 2] + half)
                             >> shift)
