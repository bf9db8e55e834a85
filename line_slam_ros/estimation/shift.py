"""How far corners and segments moved between two images.

Along itself a segment slides freely, so only the distances of its two ends across it count. Their root sum of squares
compares with the length of a corner's shift: the same noise, and the same median where motion comes from all sides.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.kernel_cache import kernel
from line_slam_ros.types import F64, I64, Observations

FEW_CORNERS = 15  # shared by two images; with fewer, segments join in to judge the motion


def shared(a: I64, b: I64) -> tuple[I64, I64]:
    """Rows (N,), (N,) of the ids that both have; the ids of each rise."""
    i, j = np.empty((2, min(len(a), len(b))), np.int64)
    count = _shared(a, b, i, j)
    return i[:count], j[:count]


@kernel
def _shared(a, b, i, j):
    """Fill i and j with the rows of rising a and b where they are equal; how many there are."""
    count, q = 0, 0
    for p in range(len(a)):
        while q < len(b) and b[q] < a[p]:
            q += 1
        if q < len(b) and b[q] == a[p]:
            i[count], j[count] = p, q
            count += 1
    return count


def matches(a: Observations, b: Observations) -> tuple[F64, F64]:
    """Bearings (N, 2), (N, 2) of the corners both frames saw."""
    i, j = shared(a.points.ids, b.points.ids)
    return a.points.x[i], b.points.x[j]


def corner_shifts(then: F64, now: F64) -> F64:
    """Distances (N,) between bearings then and now (N, 2)."""
    return np.hypot(*(now - then).T)


def segment_shifts(then: F64, now: F64, sigma_then: F64, sigma_now: F64) -> tuple[F64, F64]:
    """Shifts (M,) of segments with ends then and now (M, 2, 2), and the standard deviation (M,) of one sighting.

    The ends then are held against the lines through those now. sigma (M, 2): of each end across its segment, in the
    same units; beyond its ends a line is less certain.
    """
    along = now[:, 1] - now[:, 0]
    length2 = np.sum(along**2, axis=1)[:, None]
    offset = then - now[:, :1]
    at = np.einsum('mej,mj->me', offset, along) / length2  # 0 and 1 at the ends now
    distance2 = (offset[..., 0] * along[:, 1:] - offset[..., 1] * along[:, :1])**2 / length2
    variance = sigma_then**2 + ((1.0 - at) * sigma_now[:, :1])**2 + (at * sigma_now[:, 1:])**2
    return np.sqrt(distance2.sum(axis=1)), 0.5 * np.sqrt(variance.sum(axis=1))
