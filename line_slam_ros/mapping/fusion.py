"""Uncertain lines: how far across they may be off, whether two are one, and their fusion."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from line_slam_ros.config import Mapping
from line_slam_ros.geometry.lie import hat
from line_slam_ros.geometry.lines import closest_point
from line_slam_ros.types import F64, I64

AGREEMENT = 2.5  # standard deviations within which two lines may be one
WIDEST = 2.0  # times the merge distance: however uncertain, lines further apart stay two
BESIDE = 0.5  # share of a short line beside a long one that makes it a piece of it, if it is near
ROUNDING = 1e-6  # m, smallest standard deviation believed


@dataclass(frozen=True, slots=True)
class Landmark:
    """One line of the map."""

    id: int
    pluecker: F64  # (6,) [n, d] in W, |d| = 1
    cov: F64  # (6, 6) of [n, d], rank 4
    ends: F64  # (2, 3) in W, m
    views: int
    sigma: float  # m, across at the worse end


def across_covariance(pluecker: F64, cov: F64, p_W: F64) -> F64:
    """Covariance (..., 3, 3), m^2, of the line's offset from its point p_W (..., 3); zero along the line.

    The moment about p of the disturbed line is dn - p x dd, and the offset of its nearest point d x that:
    J = [d]x [I, -[p]x].
    """
    moment = hat(p_W)
    J = hat(pluecker[..., 3:]) @ np.concatenate([np.broadcast_to(np.eye(3), moment.shape), -moment], axis=-1)
    return J @ cov @ np.swapaxes(J, -1, -2)


def worst_sigma(pluecker: F64, cov: F64, ends: F64) -> F64:
    """Standard deviation (L,), m, across the line in its worst direction at its worse end; ends (L, 2, 3)."""
    across = across_covariance(pluecker[:, None], cov[:, None], ends)
    trace = np.trace(across, axis1=-2, axis2=-1)
    squares = np.sum(across * across, axis=(-2, -1))  # of rank 2: both eigenvalues from trace and norm
    largest = 0.5 * (trace + np.sqrt(np.maximum(2.0 * squares - trace * trace, 0.0)))
    return np.sqrt(np.maximum(largest, 0.0)).max(axis=1, initial=0.0)


def offset(pluecker: F64, p_W: F64) -> F64:
    """Vector (..., 3) from points (..., 3) to their feet on lines (..., 6)."""
    return closest_point(pluecker, p_W) - p_W


def near(line: Landmark, pluecker: F64, ends: F64, rule: Mapping) -> I64:
    """Rows of lines (L, 6), (L, 2, 3) that may be the same as this one, nearest first."""
    distance = np.empty(len(pluecker))
    _near(line.pluecker[3:], line.ends, pluecker, ends, np.cos(np.radians(rule.merge_angle_deg)),
          WIDEST * rule.merge_distance_m, rule.merge_gap_m, distance)
    rows = np.flatnonzero(np.isfinite(distance))
    return rows[np.argsort(distance[rows], kind='stable')]


@njit(cache=True, nogil=True, error_model='numpy')
def _near(d, ends, others, other_ends, least_cosine, furthest, gap, distance):
    """Fills distance (L,): largest distance between the lines where both extents overlap, or infinity when the
    directions differ, the extents are more than gap apart or the distance exceeds furthest."""
    for j in range(len(others)):
        distance[j] = np.inf
        m0, m1, m2, e0, e1, e2 = others[j]
        if abs(d[0] * e0 + d[1] * e1 + d[2] * e2) < least_cosine:
            continue
        s, t = 0.0, 0.0
        length = 0.0
        for c in range(3):
            s += d[c] * (other_ends[j, 0, c] - ends[0, c])
            t += d[c] * (other_ends[j, 1, c] - ends[0, c])
            length += d[c] * (ends[1, c] - ends[0, c])
        begin, end = max(min(s, t), min(length, 0.0)), min(max(s, t), max(length, 0.0))
        if begin - end > gap:
            continue
        worst = 0.0
        for position in (begin, end):
            p0, p1, p2 = (ends[0, 0] + position * d[0], ends[0, 1] + position * d[1], ends[0, 2] + position * d[2])
            q0, q1, q2 = m0 - (p1 * e2 - p2 * e1), m1 - (p2 * e0 - p0 * e2), m2 - (p0 * e1 - p1 * e0)
            worst = max(worst, q0 * q0 + q1 * q1 + q2 * q2)
        if worst <= furthest * furthest:
            distance[j] = np.sqrt(worst)


def agree(a: Landmark, b: Landmark, rule: Mapping) -> bool:
    """Whether two near lines are one within their uncertainty.

    At each end of either, the distance to the other line is below the merge distance or what both covariances explain;
    of a piece that lies mostly beside the longer one, only its own ends count, for its direction says little.
    """
    short, long = sorted((a, b), key=lambda line: float(np.linalg.norm(line.ends[1] - line.ends[0])))
    points, other = short.ends, np.stack([long.pluecker] * 2)
    if _share_beside(short, long) < BESIDE:
        points, other = np.concatenate([points, long.ends]), np.concatenate([other, np.stack([short.pluecker] * 2)])
    apart = offset(other, points)
    distance = np.linalg.norm(apart, axis=-1)
    axis = apart / np.maximum(distance, ROUNDING)[:, None]
    both = across_covariance(a.pluecker, a.cov, points) + across_covariance(b.pluecker, b.cov, points)
    sigma = np.sqrt(np.einsum('ki,kij,kj->k', axis, both, axis))
    return bool(np.all(distance <= np.maximum(rule.merge_distance_m, AGREEMENT * sigma)))


def _share_beside(short: Landmark, long: Landmark) -> float:
    """Share of the short line's length that lies beside the long line's extent."""
    d = long.pluecker[3:]
    (begin, end), (first, last) = np.sort(short.ends @ d), np.sort(long.ends @ d)
    return float((min(end, last) - max(begin, first)) / max(end - begin, ROUNDING))


def fuse(a: Landmark, b: Landmark) -> Landmark:
    """The information-weighted mean of two estimates of one line, over the union of their extents; the lower id.

    Both are written as the offsets across at two points of a common axis, four numbers without a gauge, where the
    mean of independent estimates is linear; the fused line passes the two offset points.
    """
    d = a.pluecker[3:]
    along = np.concatenate([a.ends, b.ends]) @ d
    start = a.ends[0] + (along.min() - a.ends[0] @ d) * d
    points = np.stack([start, start + max(np.ptp(along), ROUNDING) * d])
    across = np.linalg.svd(d[None])[2][1:]  # (2, 3) orthonormal, at right angles to d
    mean_a, cov_a = _offsets(a, points, across)
    mean_b, cov_b = _offsets(b, points, across)
    gain = cov_a @ np.linalg.inv(cov_a + cov_b)
    mean, cov = mean_a + gain @ (mean_b - mean_a), cov_a - gain @ cov_a
    points = points + mean.reshape(2, 2) @ across
    pluecker, J = _line_through(points)
    J = J @ np.kron(np.eye(2), across.T)
    ends = np.concatenate([a.ends, b.ends])
    ends = ends + offset(pluecker, ends)
    along = ends @ pluecker[3:]
    ends = ends[[np.argmin(along), np.argmax(along)]]
    cov = J @ (0.5 * (cov + cov.T)) @ J.T
    sigma = worst_sigma(pluecker[None], cov[None], ends[None])[0]
    return Landmark(min(a.id, b.id), pluecker, cov, ends, a.views + b.views, float(sigma))


def _offsets(line: Landmark, points: F64, across: F64) -> tuple[F64, F64]:
    """Offsets of the line from two points (2, 3) along two axes (2, 3): mean (4,), covariance (4, 4), m.

    The point of the line in the plane across through p: p + d x m / (axis . d) to first order in the angle between
    line and axis, with m = n - p x d.
    """
    D = hat(line.pluecker[3:])
    J = np.concatenate([across @ np.concatenate([D, -D @ hat(p)], axis=1) for p in points])
    mean = (offset(line.pluecker, points) @ across.T).ravel()
    return mean, J @ line.cov @ J.T + ROUNDING**2 * np.eye(4)


def _line_through(points: F64) -> tuple[F64, F64]:
    """[n, d] with |d| = 1 of the line through points (2, 3), and its derivative (6, 6) by both points."""
    p, q = points
    length = np.linalg.norm(q - p)
    d = (q - p) / length
    D = (np.eye(3) - np.outer(d, d)) / length
    P = hat(p)
    return np.concatenate([np.cross(p, d), d]), np.block([[-hat(d) - P @ D, P @ D], [-D, D]])
