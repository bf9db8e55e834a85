"""Lines from views with known poses: Levenberg-Marquardt in any form and loss, compiled.

With the poses given the normal equations fall apart into a small block per line, so nothing needs eliminating: each
line is solved on its own (fit_line), or all together with one damping and one verdict on the total cost (fit_lines
with joint), as a general solver would.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.factors.line_reprojection import line_reprojection
from line_slam_ros.factors.robust import CAUCHY, robust
from line_slam_ros.geometry.line_forms import VALUES, freedom, move_line, unit_world_line, world_line
from line_slam_ros.kernel_cache import inner, kernel

DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-12, 1e8  # of the diagonal: at the start, at least, when giving up
CONVERGED = 1e-6  # relative decrease of the cost
BLIND = 1e6  # squared residual of a view in which the line has no image
CHI2_MEDIAN = 1.386  # of chi-square with two degrees of freedom


@kernel
def fit_lines(form, loss, c2, joint, first, last, poses, ends, sigma, values, origin, iterations, tolerance, cost,
              steps):
    """Fit line i to its views first[i] <= k < last[i].

    form, loss: of types.py; c2: squared scale of the loss; poses (M, 3, 4) = [R_WC, p_WC], ends (M, 2, 2), sigma
    (M, 2) normalised: the views; values (L, VALUES), origin (L, 3): see geometry/line_forms.py. Takes at most that many
    steps (those that would raise the cost are not taken, but tried again with more damping), fewer when one of them
    lowers the cost by less than tolerance of it. Updates values and fills cost (L,), half the sum of the losses, and
    steps (L,), how many were taken.
    """
    if joint:
        _fit_jointly(form, loss, c2, first, last, poses, ends, sigma, values, origin, iterations, tolerance, cost,
                     steps)
        return
    e2 = np.empty(len(poses))
    for i in range(len(first)):
        own = slice(first[i], last[i])
        cost[i], steps[i] = fit_line(form, loss, c2, poses[own], ends[own], sigma[own], values[i], origin[i],
                                     iterations, tolerance, e2[own])


@inner
def fit_line(form, loss, c2, poses, ends, sigma, values, origin, iterations, tolerance, e2):
    """One line; returns its cost and the number of steps taken. e2 (K,) is scratch."""
    size = freedom(form)
    H, g, new_H, new_g = np.empty((4, 4)), np.empty(4), np.empty((4, 4)), np.empty(4)
    moved, step = np.empty(VALUES), np.empty(4)
    cost, damping, taken = normal_equations(form, loss, c2, poses, ends, sigma, values, origin, H, g, e2), DAMPING, 0
    while taken < iterations and damping < MOST_DAMPING:
        _solve(H, damping, g, size, step)
        move_line(form, values, step, moved)
        new_cost = normal_equations(form, loss, c2, poses, ends, sigma, moved, origin, new_H, new_g, e2)
        if not new_cost <= cost:
            damping *= 10.0
            continue
        gain, cost, damping = cost - new_cost, new_cost, max(0.1 * damping, LEAST_DAMPING)
        values[:], taken = moved, taken + 1
        H, new_H, g, new_g = new_H, H, new_g, g
        if gain < tolerance * cost:
            break
    return cost, taken


@inner
def _fit_jointly(form, loss, c2, first, last, poses, ends, sigma, values, origin, iterations, tolerance, cost, steps):
    """All lines with one damping; a step is taken by all or by none."""
    size, lines = freedom(form), len(first)
    H, g, step = np.empty((2, lines, 4, 4)), np.empty((2, lines, 4)), np.empty(4)
    moved, new_cost, e2 = np.empty_like(values), np.empty(lines), np.empty(len(poses))
    for i in range(lines):
        own = slice(first[i], last[i])
        cost[i] = normal_equations(form, loss, c2, poses[own], ends[own], sigma[own], values[i], origin[i], H[0, i],
                                   g[0, i], e2[own])
    at, damping, taken = 0, DAMPING, 0
    while taken < iterations and damping < MOST_DAMPING:
        for i in range(lines):
            own = slice(first[i], last[i])
            _solve(H[at, i], damping, g[at, i], size, step)
            move_line(form, values[i], step, moved[i])
            new_cost[i] = normal_equations(form, loss, c2, poses[own], ends[own], sigma[own], moved[i], origin[i],
                                           H[1 - at, i], g[1 - at, i], e2[own])
        gain = cost.sum() - new_cost.sum()
        if not gain >= 0.0:
            damping *= 10.0
            continue
        values[:], cost[:] = moved, new_cost
        at, damping, taken = 1 - at, max(0.1 * damping, LEAST_DAMPING), taken + 1
        if gain < tolerance * cost.sum():
            break
    steps[:] = taken


@kernel
def refine_lines(rows, form, poses, ends, sigma, count, values, origin, c2, iterations, gate, pluecker, cov, outliers):
    """Fit the lines in rows of a table to all their views, with Cauchy loss, starting from their present values.

    poses (N, K, 3, 4), ends (N, K, 2, 2), sigma (N, K, 2), count (N,): the views; gate: squared whitened residual of
    an outlier. Updates values (N, VALUES) and fills pluecker (N, 6) with |d| = 1, cov (N, 6, 6) from the normal
    equations, widened when the residuals are larger than sigma says, and outliers (N,), the share of views over the
    gate.
    """
    J, H, g = np.empty((6, 4)), np.empty((4, 4)), np.empty(4)
    e2, sorted_e2 = np.empty(poses.shape[1]), np.empty(poses.shape[1])
    for i in rows:
        views = slice(0, count[i])
        fit_line(form, CAUCHY, c2, poses[i, views], ends[i, views], sigma[i, views], values[i], origin[i], iterations,
                 CONVERGED, e2[views])
        normal_equations(form, CAUCHY, c2, poses[i, views], ends[i, views], sigma[i, views], values[i], origin[i], H,
                         g, e2[views])
        outliers[i] = np.sum(e2[views] > gate) / count[i]
        unit_world_line(form, values[i], origin[i], pluecker[i], J)
        _covariance(H, J, freedom(form), max(1.0, _median(e2[views], sorted_e2) / CHI2_MEDIAN), cov[i])


@kernel
def normal_equations(form, loss, c2, poses, ends, sigma, values, origin, H, g, e2):
    """Of one line from K views: leading rows of H (4, 4), g (4,) and e2 (K,), the squared whitened residuals.

    Returns the cost 0.5 sum rho(e2). A view that cannot see the line costs like an outlier and has no slope.
    """
    size = freedom(form)
    n, d, J, A = np.empty(3), np.empty(3), np.empty((6, 4)), np.empty((2, 4))
    r, J_pose, J_ext, J_line = np.empty(2), np.empty((2, 6)), np.empty((2, 6)), np.empty((2, 6))
    identity, zero = np.eye(3), np.zeros(3)
    world_line(form, values, origin, n, d, J)
    H[:], g[:] = 0.0, 0.0
    cost = 0.0
    for k in range(len(poses)):
        if not line_reprojection(poses[k, :, :3], poses[k, :, 3], identity, zero, n, d, ends[k], r, J_pose, J_ext,
                                 J_line):
            e2[k] = BLIND
            cost += robust(loss, BLIND, c2)[0]
            continue
        for e in range(2):
            r[e] /= sigma[k, e]
            for a in range(size):
                A[e, a] = 0.0
                for b in range(6):
                    A[e, a] += J_line[e, b] * J[b, a]
                A[e, a] /= sigma[k, e]
        e2[k] = r[0] * r[0] + r[1] * r[1]
        rho, weight = robust(loss, e2[k], c2)
        cost += rho
        for a in range(size):
            g[a] += weight * (A[0, a] * r[0] + A[1, a] * r[1])
            for b in range(size):
                H[a, b] += weight * (A[0, a] * A[0, b] + A[1, a] * A[1, b])
    return 0.5 * cost


@inner
def _median(values, buffer):
    """Median of values (N,), N > 0, by insertion into the buffer."""
    for k in range(len(values)):
        j = k
        while j > 0 and buffer[j - 1] > values[k]:
            buffer[j] = buffer[j - 1]
            j -= 1
        buffer[j] = values[k]
    return 0.5 * (buffer[len(values) // 2] + buffer[(len(values) - 1) // 2])


@inner
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


@inner
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
