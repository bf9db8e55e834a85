"""One line at a time from views with known poses: Levenberg-Marquardt with Cauchy loss, compiled.

Two forms of a line (see geometry/orthonormal.py and geometry/host_line.py), both about a constant origin in W:

    orthonormal  frame = U, numbers = [phi, -]:           n = cos(phi) u1, d = sin(phi) u2
    host         frame = R_WL, numbers = [rho, theta]:    n = -cos(theta) z, d = rho (cos(theta) x + sin(theta) y)

with [x, y, z] the columns of R_WL and the host camera's centre as origin.
"""
from __future__ import annotations

import numpy as np
from numba import njit

from line_slam_ros.factors.line_reprojection import line_reprojection, orthonormal_line
from line_slam_ros.geometry.lie_kernels import retract_rotation

DAMPING, MOST_DAMPING = 1e-4, 1e8  # of the diagonal, at the start and when giving up
CONVERGED = 1e-6  # relative decrease of the cost
BLIND = 1e6  # squared residual of a view in which the line has no image
CHI2_MEDIAN = 1.386  # of chi-square with two degrees of freedom


@njit(cache=True, nogil=True, error_model='numpy')
def refine_lines(rows, host, poses, ends, sigma, count, frame, numbers, origin, loss2, iterations, gate, pluecker, cov,
                 outliers):
    """Fit the lines in rows to all their views, starting from their present form.

    poses (N, K, 3, 4) = [R_WC, p_WC], ends (N, K, 2, 2), sigma (N, K, 2), count (N,): the views; loss2: squared
    Cauchy scale; gate: squared whitened residual of an outlier. Updates frame (N, 3, 3), numbers (N, 2) and fills
    pluecker (N, 6) with |d| = 1, cov (N, 6, 6) from the normal equations, widened when the residuals are larger than
    sigma says, and outliers (N,), the share of views over the gate.
    """
    size = 2 if host else 4
    J, e2, sorted_e2 = np.empty((6, 4)), np.empty(poses.shape[1]), np.empty(poses.shape[1])
    H, g, new_H, new_g = np.empty((4, 4)), np.empty(4), np.empty((4, 4)), np.empty(4)
    new_frame, new_numbers, step = np.empty((3, 3)), np.empty(2), np.empty(4)
    for i in rows:
        views = count[i]
        cost = _normal_equations(host, views, poses[i], ends[i], sigma[i], frame[i], numbers[i], origin[i], loss2, J, H,
                                 g, e2)
        damping = DAMPING
        for _ in range(iterations):
            before = cost
            while damping < MOST_DAMPING:
                _solve(H, damping, g, size, step)
                _move(host, frame[i], numbers[i], step, new_frame, new_numbers)
                cost = _normal_equations(host, views, poses[i], ends[i], sigma[i], new_frame, new_numbers, origin[i],
                                         loss2, J, new_H, new_g, e2)
                if cost <= before:
                    break
                damping *= 10.0
            if damping >= MOST_DAMPING:
                break
            _copy(new_frame, new_numbers, frame[i], numbers[i])
            H, new_H, g, new_g = new_H, H, new_g, g
            damping = max(0.1 * damping, 1e-9)
            if before - cost <= CONVERGED * before:
                break
        _normal_equations(host, views, poses[i], ends[i], sigma[i], frame[i], numbers[i], origin[i], loss2, J, H, g, e2)
        over = 0
        for k in range(views):
            over += e2[k] > gate
        outliers[i] = over / views
        _to_world(host, frame[i], numbers[i], origin[i], J, pluecker[i])
        _covariance(H, J, size, max(1.0, _median(e2[:views], sorted_e2) / CHI2_MEDIAN), cov[i])


@njit(cache=True, nogil=True, error_model='numpy')
def _copy(frame, numbers, to_frame, to_numbers):
    for a in range(3):
        for b in range(3):
            to_frame[a, b] = frame[a, b]
    to_numbers[0], to_numbers[1] = numbers[0], numbers[1]


@njit(cache=True, nogil=True, error_model='numpy')
def _median(values, buffer):
    """Median of values (N,), N > 0, by insertion into the buffer."""
    for k in range(len(values)):
        j = k
        while j > 0 and buffer[j - 1] > values[k]:
            buffer[j] = buffer[j - 1]
            j -= 1
        buffer[j] = values[k]
    return 0.5 * (buffer[len(values) // 2] + buffer[(len(values) - 1) // 2])


@njit(cache=True, nogil=True, error_model='numpy')
def _solve(H, damping, g, size, step):
    """step[:m] = -(H + damping diag H)^-1 g by Cholesky, on the leading m = size rows of H (4, 4), g (4,)."""
    L = np.empty((4, 4))
    for a in range(size):
        for b in range(a + 1):
            s = H[a, b]
            if a == b:
                s += damping * H[a, a] + 1e-12
            for c in range(b):
                s -= L[a, c] * L[b, c]
            L[a, b] = np.sqrt(max(s, 1e-300)) if a == b else s / L[b, b]
    for a in range(size):
        s = -g[a]
        for c in range(a):
            s -= L[a, c] * step[c]
        step[a] = s / L[a, a]
    for a in range(size - 1, -1, -1):
        s = step[a]
        for c in range(a + 1, size):
            s -= L[c, a] * step[c]
        step[a] = s / L[a, a]


@njit(cache=True, nogil=True, error_model='numpy')
def _covariance(H, J, size, factor, cov):
    """cov (6, 6) = factor J H^-1 J' of the leading m = size columns of J (6, 4)."""
    column, x = np.empty(4), np.empty(4)
    for b in range(6):
        for a in range(size):
            column[a] = -J[b, a]
        _solve(H, 1e-9, column, size, x)
        for c in range(6):
            cov[c, b] = 0.0
            for a in range(size):
                cov[c, b] += factor * J[c, a] * x[a]


@njit(cache=True, nogil=True, error_model='numpy')
def _normal_equations(host, views, poses, ends, sigma, frame, numbers, origin, loss2, J, H, g, e2):
    """Leading m rows of H (4, 4), g (4,) of the Cauchy cost 0.5 c^2 log(1 + e^2 / c^2) over the first views, e2 (K,)
    their squared whitened residuals, J (6, 4) the tangent of [n, d]; returns the cost. A view that cannot see the line
    costs like an outlier."""
    size = 2 if host else 4
    n, d, A = np.empty(3), np.empty(3), np.empty((2, 4))
    r, J_pose, J_ext, J_line = np.empty(2), np.empty((2, 6)), np.empty((2, 6)), np.empty((2, 6))
    identity, zero = np.eye(3), np.zeros(3)
    _line(host, frame, numbers, origin, n, d, J)
    for a in range(size):
        g[a] = 0.0
        for b in range(size):
            H[a, b] = 0.0
    cost = 0.0
    for k in range(views):
        if not line_reprojection(poses[k, :, :3], poses[k, :, 3], identity, zero, n, d, ends[k], r, J_pose, J_ext,
                                 J_line):
            e2[k] = BLIND
            cost += 0.5 * loss2 * np.log(1.0 + e2[k] / loss2)
            continue
        for e in range(2):
            r[e] /= sigma[k, e]
            for a in range(size):
                A[e, a] = 0.0
                for b in range(6):
                    A[e, a] += J_line[e, b] * J[b, a]
                A[e, a] /= sigma[k, e]
        e2[k] = r[0] * r[0] + r[1] * r[1]
        weight = 1.0 / (1.0 + e2[k] / loss2)
        cost += 0.5 * loss2 * np.log(1.0 + e2[k] / loss2)
        for a in range(size):
            g[a] += weight * (A[0, a] * r[0] + A[1, a] * r[1])
            for b in range(size):
                H[a, b] += weight * (A[0, a] * A[0, b] + A[1, a] * A[1, b])
    return cost


@njit(cache=True, nogil=True, error_model='numpy')
def _line(host, frame, numbers, origin, n, d, J):
    """World line n (3,), d (3,) of either form and its tangent J (6, :m)."""
    if not host:
        orthonormal_line(frame, numbers[0], origin, n, d, J)
        return
    rho, cosine, sine = numbers[0], np.cos(numbers[1]), np.sin(numbers[1])
    for i in range(3):
        x, y, z = frame[i, 0], frame[i, 1], frame[i, 2]
        n[i], d[i] = -cosine * z, rho * (cosine * x + sine * y)
        J[i, 0], J[3 + i, 0] = 0.0, cosine * x + sine * y
        J[i, 1], J[3 + i, 1] = sine * z, rho * (cosine * y - sine * x)
    n[0] += origin[1] * d[2] - origin[2] * d[1]
    n[1] += origin[2] * d[0] - origin[0] * d[2]
    n[2] += origin[0] * d[1] - origin[1] * d[0]
    for j in range(2):
        J[0, j] += origin[1] * J[5, j] - origin[2] * J[4, j]
        J[1, j] += origin[2] * J[3, j] - origin[0] * J[5, j]
        J[2, j] += origin[0] * J[4, j] - origin[1] * J[3, j]


@njit(cache=True, nogil=True, error_model='numpy')
def _move(host, frame, numbers, step, new_frame, new_numbers):
    """The form's own update: right on U, additive on phi; additive on rho and theta."""
    if host:
        _copy(frame, numbers, new_frame, new_numbers)
        new_numbers[0], new_numbers[1] = numbers[0] + step[0], numbers[1] + step[1]
    else:
        retract_rotation(frame, step[:3], new_frame)
        new_numbers[0], new_numbers[1] = numbers[0] + step[3], 0.0


@njit(cache=True, nogil=True, error_model='numpy')
def _to_world(host, frame, numbers, origin, J, pluecker):
    """pluecker (6,) with |d| = 1 and its tangent J (6, 4): of L / |d| it is (dL - (L / |d|) (d . dd) / |d|) / |d|."""
    n, d = np.empty(3), np.empty(3)
    _line(host, frame, numbers, origin, n, d, J)
    length = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    for i in range(3):
        pluecker[i], pluecker[3 + i] = n[i] / length, d[i] / length
    for j in range(2 if host else 4):
        along = pluecker[3] * J[3, j] + pluecker[4] * J[4, j] + pluecker[5] * J[5, j]
        for i in range(6):
            J[i, j] = (J[i, j] - pluecker[i] * along) / length
