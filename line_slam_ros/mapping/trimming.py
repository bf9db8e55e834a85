"""Where a 3D line begins and ends: every view's feet on it, then a robust vote over the views. Compiled.

Foot of an observed end (u, v) on the line (n, d)_C, third form of the trimming rule: the plane through the optical
centre and the image line through the end and at right angles to the projected line,

    pi = (u, v, 1) x (n0, n1, 0),    X_C = pi x n / (pi . d)

so the image of X is the exact orthogonal foot of the observed end on the projected line.

The vote. Detection noise scatters ends on both sides of the true one; clipping (image border, occlusion, broken
segments, tracking) only ever shortens. So, along the outward direction, the true end is where the outermost cluster
of views lies, however few of the views reach it: from the outermost position that a share of the views and at least
two confirm, the weighted median of the views that agree with it within their noise. With full views this is the
median of nearly all, with clipped ones that of those that reach the end; one bad frame cannot move it.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.kernel_cache import inner, kernel

NEAREST = 0.05  # m, feet closer to the image plane are not used
STEEPEST = 0.09  # sine of 5 degrees, smallest angle between a ray and the line for a usable foot
SPREAD = 3.5  # half width of a cluster of views, standard deviations


@kernel
def trim(rows, pluecker, poses, ends, count, furthest, share, noise, trimmed, parallax):
    """End points of the lines in rows (R,) from their views.

    pluecker (L, 6) in W with |d| = 1; poses (L, K, 3, 4), ends (L, K, 2, 2), count (L,): the views; furthest: range
    gate, m; share: part of the views that must confirm an end; noise: smallest standard deviation of an observed end
    along the line, rad. Fills trimmed (R, 2, 3): the two ends in W, the first at the smaller p . d, NaN without usable
    views; parallax (R,): angle about the line between the extreme cameras, rad.
    """
    capacity = poses.shape[1]
    low, high, tol_low, tol_high = np.empty(capacity), np.empty(capacity), np.empty(capacity), np.empty(capacity)
    across, order = np.empty(2 * capacity), np.empty(2 * capacity, np.int64)
    foot = np.empty(3)
    for r in range(len(rows)):
        i = rows[r]
        n, d = pluecker[i, :3], pluecker[i, 3:]
        lows, highs, residuals = 0, 0, 0
        for k in range(count[i]):
            first, second = 0, 1
            if _runs_backwards(n, d, poses[i, k], ends[i, k]):
                first, second = 1, 0
            if _foot(n, d, poses[i, k], ends[i, k, first], furthest, foot):
                low[lows], tol_low[lows] = -foot[0], foot[1]
                across[residuals] = abs(foot[2])
                lows, residuals = lows + 1, residuals + 1
            if _foot(n, d, poses[i, k], ends[i, k, second], furthest, foot):
                high[highs], tol_high[highs] = foot[0], foot[1]
                across[residuals] = abs(foot[2])
                highs, residuals = highs + 1, residuals + 1
        sigma = noise
        if residuals > 0:  # a landmark whose segments scatter across the line scatters along it, too
            _sort(across[:residuals], order)
            sigma = max(noise, 1.4826 * across[order[residuals // 2]])  # of a normal distribution, from the median
        begin = -_outermost(low[:lows], tol_low[:lows], SPREAD * sigma, share, order)
        end = _outermost(high[:highs], tol_high[:highs], SPREAD * sigma, share, order)
        for c in range(3):
            nearest = d[c - 2] * n[c - 1] - d[c - 1] * n[c - 2]  # to the world's origin: d x n
            trimmed[r, 0, c], trimmed[r, 1, c] = nearest + begin * d[c], nearest + end * d[c]
        parallax[r] = _parallax(n, d, poses[i, : count[i]])


@inner
def _line_in_camera(n, d, pose):
    """(n0, n1, n2, d0, d1, d2) in C and p_WC . d."""
    m0 = n[0] - (pose[1, 3] * d[2] - pose[2, 3] * d[1])
    m1 = n[1] - (pose[2, 3] * d[0] - pose[0, 3] * d[2])
    m2 = n[2] - (pose[0, 3] * d[1] - pose[1, 3] * d[0])
    return (pose[0, 0] * m0 + pose[1, 0] * m1 + pose[2, 0] * m2,
            pose[0, 1] * m0 + pose[1, 1] * m1 + pose[2, 1] * m2,
            pose[0, 2] * m0 + pose[1, 2] * m1 + pose[2, 2] * m2,
            pose[0, 0] * d[0] + pose[1, 0] * d[1] + pose[2, 0] * d[2],
            pose[0, 1] * d[0] + pose[1, 1] * d[1] + pose[2, 1] * d[2],
            pose[0, 2] * d[0] + pose[1, 2] * d[1] + pose[2, 2] * d[2],
            pose[0, 3] * d[0] + pose[1, 3] * d[1] + pose[2, 3] * d[2])


@inner
def _runs_backwards(n, d, pose, ends):
    """Whether the observed segment points against the image of d, whatever the order of its ends."""
    _, _, _, d0, d1, d2, _ = _line_in_camera(n, d, pose)
    u, v = 0.5 * (ends[0, 0] + ends[1, 0]), 0.5 * (ends[0, 1] + ends[1, 1])
    return (ends[1, 0] - ends[0, 0]) * (d0 - u * d2) + (ends[1, 1] - ends[0, 1]) * (d1 - v * d2) < 0.0


@inner
def _foot(n, d, pose, end, furthest, out):
    """out = [position along the line (m), its change per rad of the ray (m), distance across in the image].

    False when the foot is behind or on the camera, beyond furthest, or seen at too flat an angle to the line.
    """
    n0, n1, n2, d0, d1, d2, offset = _line_in_camera(n, d, pose)
    a, b, c = -n1, n0, end[0] * n1 - end[1] * n0  # pi
    along = a * d0 + b * d1 + c * d2
    x, y, z = (b * n2 - c * n1) / along, (c * n0 - a * n2) / along, (a * n1 - b * n0) / along
    distance, reach = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2), np.sqrt(x * x + y * y + z * z)
    out[0] = offset + x * d0 + y * d1 + z * d2
    out[1] = reach * reach / distance
    out[2] = (n0 * end[0] + n1 * end[1] + n2) / np.sqrt(n0 * n0 + n1 * n1)
    return z > NEAREST and reach < furthest and distance > STEEPEST * reach


@inner
def _sort(values, order):
    """order[:N] = rows of values (N,) from smallest to largest, by insertion."""
    for k in range(len(values)):
        j = k
        while j > 0 and values[order[j - 1]] > values[k]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = k


@inner
def _outermost(positions, scales, sigma, share, order):
    """The vote of the module's docstring: positions (N,) grow outwards, sigma * scales are their half widths."""
    count = len(positions)
    if count == 0:
        return np.nan
    _sort(positions, order)
    confirming = min(max(2, int(np.ceil(share * count))), count)
    reference = positions[order[count - confirming]]
    total = 0.0
    for k in range(count):
        if abs(positions[k] - reference) <= sigma * scales[k]:
            total += 1.0 / scales[k]
    before, passed, previous = 0.0, -1.0, reference  # weighted median, linear between the centres of the weights
    for m in range(count):
        k = order[m]
        if abs(positions[k] - reference) > sigma * scales[k]:
            continue
        centre = before + 0.5 / scales[k]
        if centre >= 0.5 * total:
            if passed < 0.0:
                return positions[k]
            return previous + (positions[k] - previous) * (0.5 * total - passed) / (centre - passed)
        before, passed, previous = before + 1.0 / scales[k], centre, positions[k]
    return previous


@inner
def _parallax(n, d, poses):
    """Range of the angles (rad) about the line at which the cameras (K, 3, 4) stand; 0 without cameras."""
    lowest, highest = 0.0, 0.0
    u = np.empty(3)
    e, f = np.zeros(3), np.zeros(3)
    for k in range(len(poses)):
        along = poses[k, 0, 3] * d[0] + poses[k, 1, 3] * d[1] + poses[k, 2, 3] * d[2]
        u[0] = poses[k, 0, 3] - (d[1] * n[2] - d[2] * n[1]) - along * d[0]
        u[1] = poses[k, 1, 3] - (d[2] * n[0] - d[0] * n[2]) - along * d[1]
        u[2] = poses[k, 2, 3] - (d[0] * n[1] - d[1] * n[0]) - along * d[2]
        if k == 0:
            e[0], e[1], e[2] = u
            f[0], f[1], f[2] = d[1] * u[2] - d[2] * u[1], d[2] * u[0] - d[0] * u[2], d[0] * u[1] - d[1] * u[0]
        angle = np.arctan2(u[0] * f[0] + u[1] * f[1] + u[2] * f[2], u[0] * e[0] + u[1] * e[1] + u[2] * e[2])
        lowest, highest = min(lowest, angle), max(highest, angle)
    return highest - lowest
