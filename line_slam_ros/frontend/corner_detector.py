"""New corners, spread over the image."""
from __future__ import annotations

import cv2
import numpy as np

from line_slam_ros.kernel_cache import inner, kernel
from line_slam_ros.types import F32, F64, U8

WINDOW = 2  # px, half side of the window of the structure tensor, on the half-size image
MARGIN = 8  # px of the half-size image without corners
SETTLE = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 10, 0.02)


def new_corners(image: U8, half_size: U8, tracked: F64, count: int, min_distance: float, cell: float,
                contrast: float) -> F64:
    """Up to count sub-pixel corners (N, 2) px of image (H, W), min_distance px from each other and from tracked.

    Found on half_size (H/2, W/2) as local maxima of the smaller eigenvalue of the structure tensor (Shi and
    Tomasi, 1994) above contrast^2; cells (side cell px) that hold fewer corners go first.
    """
    score = np.zeros(half_size.shape, np.float32)
    corner_score(half_size, contrast * contrast, score)
    found = spread(score, np.ascontiguousarray(tracked), count, min_distance, cell)
    if not len(found):
        return found
    refined = cv2.cornerSubPix(image, found.astype(np.float32).reshape(-1, 1, 2), (4, 4), (-1, -1), SETTLE)
    return refined.reshape(-1, 2).astype(np.float64)


@kernel(fastmath=True)
def corner_score(image, floor, score):
    """Fill score (H, W) with the mean smaller eigenvalue (grey / px)^2 where it exceeds floor, 0 elsewhere."""
    h, w = image.shape
    size = 2 * WINDOW + 1
    rows = np.zeros((size, 3, w), np.float32)  # products of gradients of the newest rows
    total = np.zeros((3, w), np.float32)  # their sums down the window
    norm = np.float32(1.0 / (4.0 * size * size))
    for y in range(1, h - 1):
        old = rows[y % size]
        up, row, low = image[y - 1], image[y], image[y + 1]
        for x in range(1, w - 1):
            gx, gy = np.float32(row[x + 1]) - row[x - 1], np.float32(low[x]) - up[x]
            xx, xy, yy = gx * gx, gx * gy, gy * gy
            total[0, x] += xx - old[0, x]
            total[1, x] += xy - old[1, x]
            total[2, x] += yy - old[2, x]
            old[0, x], old[1, x], old[2, x] = xx, xy, yy
        centre = y - WINDOW
        if centre < MARGIN or centre >= h - MARGIN:
            continue
        for x in range(MARGIN, w - MARGIN):
            a = b = c = np.float32(0.0)
            for k in range(x - WINDOW, x + WINDOW + 1):
                a += total[0, k]
                b += total[1, k]
                c += total[2, k]
            smaller = np.float32(0.5) * norm * (a + c - np.sqrt((a - c) * (a - c) + np.float32(4.0) * b * b))
            score[centre, x] = smaller if smaller > floor else np.float32(0.0)


def spread(score: F32, tracked: F64, count: int, min_distance: float, cell: float) -> F64:
    """Corners (N, 2) in full-size px: local maxima of score, the emptiest cells first, min_distance apart."""
    h, w = score.shape
    columns = int(2 * w / cell) + 1
    held = np.zeros((int(2 * h / cell) + 1) * columns, np.int64)  # corners by cell
    near = np.ones((h, w), np.bool_)  # may a corner be put here?
    at, value = np.empty((h * w // 4, 2), np.int64), np.empty(h * w // 4)
    n = candidates(score, tracked, min_distance, cell, columns, held, near, at, value)
    best_first = at[np.argsort(-value[:n], kind='stable')]
    return choose(best_first, count, min_distance, cell, columns, held, near)


@kernel
def candidates(score, tracked, min_distance, cell, columns, held, near, at, value):
    """Fill at (N, 2) and value (N,) with the local maxima of score (H, W) far enough from tracked (M, 2), which are put
    into held and near; returns how many there are."""
    h, w = score.shape
    for i in range(len(tracked)):
        if 0.0 <= tracked[i, 0] < 2 * w and 0.0 <= tracked[i, 1] < 2 * h:
            held[int(tracked[i, 1] / cell) * columns + int(tracked[i, 0] / cell)] += 1
            block(near, 0.5 * tracked[i, 0], 0.5 * tracked[i, 1], 0.5 * min_distance)
    n, zero, top = 0, np.float32(0.0), np.empty(w, np.bool_)
    for y in range(MARGIN, h - MARGIN):
        up, row, low, free = score[y - 1], score[y], score[y + 1], near[y]
        for x in range(MARGIN, w - MARGIN):  # without a branch, which would be mispredicted
            s = row[x]
            top[x] = (s > zero) & free[x] & (s > row[x - 1]) & (s >= row[x + 1]) & (s > up[x]) & (s >= low[x])
        for x in range(MARGIN, w - MARGIN):
            if top[x]:
                at[n, 0], at[n, 1], value[n] = x, y, row[x]
                n += 1
    return n


@kernel
def choose(at, count, min_distance, cell, columns, held, near):
    """Up to count corners (N, 2) in full-size px of those at (M, 2), best first: their rank in their cell decides."""
    n, most = len(at), 0
    rank = np.empty(n, np.int64)
    for k in range(n):
        home = int(2 * at[k, 1] / cell) * columns + int(2 * at[k, 0] / cell)
        rank[k] = held[home]
        held[home] += 1
        most = max(most, rank[k])
    first = np.zeros(most + 2, np.int64)
    for k in range(n):
        first[rank[k] + 1] += 1
    for r in range(1, len(first)):  # of rank r, by counting
        first[r] += first[r - 1]
    by_rank = np.empty(n, np.int64)
    for k in range(n):
        by_rank[first[rank[k]]] = k
        first[rank[k]] += 1
    chosen, m = np.empty((min(count, n), 2)), 0
    for k in by_rank:
        if m == len(chosen):
            break
        x, y = at[k, 0], at[k, 1]
        if near[y, x]:
            chosen[m, 0], chosen[m, 1] = 2.0 * x, 2.0 * y
            block(near, float(x), float(y), 0.5 * min_distance)
            m += 1
    return chosen[:m]


@inner
def block(near, u, v, radius):
    """Clear the disc of radius around (u, v) in near (H, W)."""
    h, w = near.shape
    for y in range(max(int(v - radius), 0), min(int(v + radius) + 2, h)):
        for x in range(max(int(u - radius), 0), min(int(u + radius) + 2, w)):
            if (x - u) ** 2 + (y - v) ** 2 < radius * radius:
                near[y, x] = False
