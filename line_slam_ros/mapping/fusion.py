"""Uncertain lines: how far across they may be off, whether two are one, and their fusion. Compiled.

The foot of a point p on the line (n, d) with |d| = 1 lies at p + d x m, m = n - p x d. Along an axis e this offset is

    w . m    with derivative [w, p x w] by (n, d),    w = e x d

to first order in the angle between axis and line; every variance below is of such offsets.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.config import Mapping
from line_slam_ros.geometry.small_systems import solve_positive
from line_slam_ros.kernel_cache import inner, kernel
from line_slam_ros.types import F64

AGREEMENT = 2.5  # standard deviations within which two lines may be one
WIDEST = 2.0  # times the merge distance: however uncertain, lines further apart stay two
BESIDE = 0.5  # share of a short line beside a long one that makes it a piece of it, if it is near
ROUNDING = 1e-6  # m, smallest standard deviation believed


def nearness(rule: Mapping) -> tuple[float, float, float, float]:
    """What twin() asks of lines: least cosine between directions, largest distance, largest gap, distance that is
    merged in any case (m)."""
    return (float(np.cos(np.radians(rule.merge_angle_deg))), WIDEST * rule.merge_distance_m, rule.merge_gap_m,
            rule.merge_distance_m)


def worst_sigma(pluecker: F64, cov: F64, ends: F64) -> F64:
    """Standard deviation (L,), m, across the line in its worst direction at its worse end; ends (L, 2, 3)."""
    sigma = np.empty(len(pluecker))
    _worst_sigmas(*map(np.ascontiguousarray, (pluecker, cov, ends)), sigma)
    return sigma


@kernel
def offsets(pluecker, cov, points, axes, mean, across):
    """Offsets of the line from points (K, 3) along axes (A, 3): mean (K A,) and covariance across (K A, K A), m."""
    size = len(points) * len(axes)
    J, half = np.empty((size, 6)), np.empty(6)
    n, d, moment = pluecker[:3], pluecker[3:], np.empty(3)
    for k in range(len(points)):
        _cross(points[k], d, moment)
        for a in range(len(axes)):
            i = k * len(axes) + a
            _cross(axes[a], d, J[i, :3])
            _cross(points[k], J[i, :3], J[i, 3:])
            mean[i] = 0.0
            for c in range(3):
                mean[i] += J[i, c] * (n[c] - moment[c])
    for i in range(size):
        for c in range(6):
            half[c] = 0.0
            for r in range(6):
                half[c] += J[i, r] * cov[r, c]
        for j in range(i + 1):
            across[i, j] = 0.0
            for c in range(6):
                across[i, j] += half[c] * J[j, c]
            across[j, i] = across[i, j]


@kernel
def _worst_sigmas(pluecker, cov, ends, sigma):
    for i in range(len(pluecker)):
        sigma[i] = _worst_sigma(pluecker[i], cov[i], ends[i])


@inner
def _worst_sigma(pluecker, cov, ends):
    axes, mean, across = np.empty((2, 3)), np.empty(2), np.empty((2, 2))
    _axes_across(pluecker[3:], axes)
    worst = 0.0
    for k in range(2):
        offsets(pluecker, cov, ends[k:k + 1], axes, mean, across)
        difference = across[0, 0] - across[1, 1]
        difference = np.sqrt(difference * difference + 4.0 * (across[0, 1] * across[0, 1]))
        worst = np.maximum(worst, 0.5 * (across[0, 0] + across[1, 1] + difference))  # the larger one; NaN stays NaN
    return np.sqrt(worst)


@inner
def twin(pluecker, cov, ends, others, other_cov, other_ends, rows, gone, nearness):
    """Row of the nearest of the other lines (L, 6), (L, 6, 6), (L, 2, 3) that is the same line as this one, -1 if none
    is, and how far away it is, m. Only rows (K,) that are not gone (L,) are looked at, nearness as
    nearness() gives it."""
    best, nearest = -1, np.inf
    d0, d1, d2 = pluecker[3:]
    for row in rows:
        cosine = abs(d0 * others[row, 3] + d1 * others[row, 4] + d2 * others[row, 5])
        if gone[row] or cosine < nearness[0]:
            continue
        distance = _distance(pluecker[3:], ends, others[row], other_ends[row], nearness)
        if distance < nearest and _agree(pluecker, cov, ends, others[row], other_cov[row], other_ends[row],
                                         nearness[3]):
            best, nearest = row, distance
    return best, nearest


@inner
def within(low, high, reach, ends, rows):
    """How many of the segments (L, 2, 3) have boxes nearer than reach to the one from low to high (3,), along every
    axis; fills rows with them."""
    count = 0
    for i in range(len(ends)):
        touches = True
        for c in range(3):  # no branches: this is for all of the map
            a, b = ends[i, 0, c], ends[i, 1, c]
            least, most = low[c] - reach, high[c] + reach
            touches &= ((a <= most) | (b <= most)) & ((a >= least) | (b >= least))
        rows[count] = i
        count += touches
    return count


@inner
def _distance(d, ends, other, other_ends, nearness):
    """Largest distance between two lines where both extents overlap, or infinity when the extents are more than a gap
    apart or the distance is too large."""
    m0, m1, m2, e0, e1, e2 = other
    s, t, length = 0.0, 0.0, 0.0
    for c in range(3):
        s += d[c] * (other_ends[0, c] - ends[0, c])
        t += d[c] * (other_ends[1, c] - ends[0, c])
        length += d[c] * (ends[1, c] - ends[0, c])
    begin, end = max(min(s, t), min(length, 0.0)), min(max(s, t), max(length, 0.0))
    if begin - end > nearness[2]:
        return np.inf
    worst = 0.0
    for position in (begin, end):
        p0, p1, p2 = (ends[0, 0] + position * d[0], ends[0, 1] + position * d[1], ends[0, 2] + position * d[2])
        q0, q1, q2 = m0 - (p1 * e2 - p2 * e1), m1 - (p2 * e0 - p0 * e2), m2 - (p0 * e1 - p1 * e0)
        worst = max(worst, q0 * q0 + q1 * q1 + q2 * q2)
    return np.sqrt(worst) if worst <= nearness[1] * nearness[1] else np.inf


@inner
def _agree(a, a_cov, a_ends, b, b_cov, b_ends, merge_distance):
    """Whether two near lines are one within their uncertainty.

    At each end of either, the distance to the other line is below the merge distance or what both covariances explain;
    of a piece that lies mostly beside the longer one, only its own ends count, for its direction says little.
    """
    if _length(b_ends) < _length(a_ends):
        a, a_cov, a_ends, b, b_cov, b_ends = b, b_cov, b_ends, a, a_cov, a_ends
    foot, axis, mean, variance = np.empty(3), np.empty((1, 3)), np.empty(1), np.empty((1, 1))
    for k in range(2 if _share_beside(b[3:], a_ends, b_ends) >= BESIDE else 4):
        p, other = (a_ends[k:k + 1], b) if k < 2 else (b_ends[k - 2:k - 1], a)
        _foot(other, p[0], foot)
        distance, total = 0.0, 0.0
        for c in range(3):
            axis[0, c] = foot[c] - p[0, c]
            distance += axis[0, c] * axis[0, c]
        distance = np.sqrt(distance)
        for c in range(3):
            axis[0, c] /= max(distance, ROUNDING)
        offsets(a, a_cov, p, axis, mean, variance)
        total += variance[0, 0]
        offsets(b, b_cov, p, axis, mean, variance)
        total += variance[0, 0]
        if not distance <= max(merge_distance, AGREEMENT * np.sqrt(total)):
            return False
    return True


@inner
def _share_beside(d, short, long):
    """Share of the short segment's length that lies beside the long one's extent along d."""
    begin, end, first, last = _along(short[0], d), _along(short[1], d), _along(long[0], d), _along(long[1], d)
    begin, end, first, last = min(begin, end), max(begin, end), min(first, last), max(first, last)
    return (min(end, last) - max(begin, first)) / max(end - begin, ROUNDING)


@inner
def fuse(a, a_cov, a_ends, b, b_cov, b_ends, pluecker, cov, ends):
    """The information-weighted mean of two estimates of one line, over the union of their extents.

    Both are written as the offsets across at two points of a common axis, four numbers without a gauge, where the
    mean of independent estimates is linear; the fused line passes the two offset points. Fills pluecker (6,),
    cov (6, 6) and ends (2, 3), all other arrays; returns the standard deviation across at the worse end, m.
    """
    axes, points = np.empty((2, 3)), np.empty((2, 3))
    _axes_across(a[3:], axes)
    _extent(a[3:], a_ends, b_ends, points)
    mean, mean_b = np.empty(4), np.empty(4)
    across, sum_, gain = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4))
    offsets(a, a_cov, points, axes, mean, across)
    offsets(b, b_cov, points, axes, mean_b, sum_)
    for i in range(4):
        across[i, i] += ROUNDING**2
        sum_[i, i] += ROUNDING**2
        mean_b[i] -= mean[i]
        for j in range(4):
            sum_[i, j] += across[i, j]
    solve_positive(sum_, across, gain)  # transposed
    fused = np.empty((4, 4))
    for i in range(4):
        for j in range(4):
            mean[i] += gain[j, i] * mean_b[j]
            fused[i, j] = across[i, j]
            for k in range(4):
                fused[i, j] -= gain[k, i] * across[k, j]
    for k in range(2):
        for c in range(3):
            points[k, c] += mean[2 * k] * axes[0, c] + mean[2 * k + 1] * axes[1, c]
    _line_through(points, axes, fused, pluecker, cov)
    _extent(pluecker[3:], a_ends, b_ends, points)
    for k in range(2):
        _foot(pluecker, points[k], ends[k])
    return _worst_sigma(pluecker, cov, ends)


@inner
def _extent(d, a_ends, b_ends, points):
    """points (2, 3): where the union of two segments begins and ends along d, on the axis through the first's end."""
    origin = _along(a_ends[0], d)
    low = high = origin
    for ends in (a_ends, b_ends):
        for k in range(2):
            along = _along(ends[k], d)
            low, high = min(low, along), max(high, along)
    low, high = low - origin, high - origin
    for c in range(3):
        points[0, c] = a_ends[0, c] + low * d[c]
        points[1, c] = points[0, c] + max(high - low, ROUNDING) * d[c]


@inner
def _line_through(points, axes, across, pluecker, cov):
    """The line through points (2, 3) whose offsets along axes (2, 3) have covariance across (4, 4), and its own."""
    p, d = points[0], pluecker[3:]
    length = _length(points)
    for c in range(3):
        d[c] = (points[1, c] - p[c]) / length
    _cross(p, d, pluecker[:3])
    J, turn, moved = np.empty((6, 4)), np.empty((2, 3)), np.empty(3)
    for a in range(2):  # of the direction by the second point, and by the first with the other sign
        share = _along(axes[a], d)
        for c in range(3):
            turn[0, c] = (axes[a, c] - share * d[c]) / length
        _cross(p, turn[0], turn[1])
        _cross(axes[a], d, moved)
        for c in range(3):
            J[c, a], J[3 + c, a] = moved[c] - turn[1, c], -turn[0, c]
            J[c, 2 + a], J[3 + c, 2 + a] = turn[1, c], turn[0, c]
    for r in range(6):
        for c in range(r + 1):
            total = 0.0
            for i in range(4):
                for j in range(4):
                    total += J[r, i] * across[i, j] * J[c, j]
            cov[r, c] = cov[c, r] = total


@inner
def _axes_across(d, axes):
    """axes (2, 3): unit vectors at right angles to the unit vector d and to each other."""
    least = 0 if abs(d[0]) <= min(abs(d[1]), abs(d[2])) else 1 if abs(d[1]) <= abs(d[2]) else 2
    scale = 1.0 / np.sqrt(1.0 - d[least] * d[least])
    for c in range(3):
        axes[0, c] = ((1.0 if c == least else 0.0) - d[least] * d[c]) * scale
    _cross(d, axes[0], axes[1])


@inner
def _foot(pluecker, p, foot):
    """The point of the line [n, d], |d| = 1, that is nearest to p: d x n + (d . p) d."""
    d = pluecker[3:]
    share = _along(p, d)
    _cross(d, pluecker[:3], foot)
    for c in range(3):
        foot[c] += share * d[c]


@inner
def _length(ends):
    x, y, z = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1], ends[1, 2] - ends[0, 2]
    return np.sqrt(x * x + y * y + z * z)


@inner
def _along(p, d):
    return p[0] * d[0] + p[1] * d[1] + p[2] * d[2]


@inner
def _cross(a, b, out):
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
