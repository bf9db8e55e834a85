"""Compiled comparison of segments with each other: which lie on the same edge, which continue one another."""
from __future__ import annotations

import numpy as np

from line_slam_ros.kernel_cache import kernel


@kernel
def beside(u, v, tu, tv, other, tolerance):
    """(first, last) px of other (2, 2) along the line from (u, v) in direction (tu, tv); (0, -1) if it is off by more
    than tolerance px."""
    a, b = other[0, 0] - u, other[0, 1] - v
    c, d = other[1, 0] - u, other[1, 1] - v
    if abs(a * tv - b * tu) > tolerance or abs(c * tv - d * tu) > tolerance:
        return 0.0, -1.0
    return a * tu + b * tv, c * tu + d * tv


@kernel
def duplicates(ends, tolerance, of, doubled):
    """Mark in doubled (M,) every segment (2, 2) that lies, for a third of the shorter, on an earlier unmarked one.

    Only the first ``of`` segments count as earlier ones.
    """
    doubled[:] = False
    for i in range(min(of, len(ends))):
        if doubled[i]:
            continue
        u, v, du, dv = ends[i, 0, 0], ends[i, 0, 1], ends[i, 1, 0] - ends[i, 0, 0], ends[i, 1, 1] - ends[i, 0, 1]
        length = np.hypot(du, dv) + 1e-12
        for j in range(i + 1, len(ends)):
            first, last = beside(u, v, du / length, dv / length, ends[j], tolerance)
            if last > first and min(last, length) - max(first, 0.0) > 0.33 * min(last - first, length):
                doubled[j] = True


@kernel
def join(ends, tolerance, gap, joined):
    """Lengthen segments by later collinear ones across at most gap px; mark these in joined (M,)."""
    for i in range(len(ends)):
        if joined[i]:
            continue
        u, v, du, dv = ends[i, 0, 0], ends[i, 0, 1], ends[i, 1, 0] - ends[i, 0, 0], ends[i, 1, 1] - ends[i, 0, 1]
        length = np.hypot(du, dv) + 1e-12
        for j in range(i + 1, len(ends)):
            if joined[j]:
                continue
            first, last = beside(u, v, du / length, dv / length, ends[j], tolerance)
            if not last > first or first > length + gap or last < -gap:
                continue
            low, high = min(first, 0.0) / length, max(last, length) / length
            ends[i, 0, 0], ends[i, 0, 1], ends[i, 1, 0], ends[i, 1, 1] = \
                u + low * du, v + low * dv, u + high * du, v + high * dv
            joined[j] = True
            u, v, du, dv = ends[i, 0, 0], ends[i, 0, 1], ends[i, 1, 0] - ends[i, 0, 0], ends[i, 1, 1] - ends[i, 0, 1]
            length = np.hypot(du, dv) + 1e-12
