"""Points and lines in the normal equations, compiled: linearise, eliminate by Schur complement, step back, cost.

A landmark's block E (slots, d, 6) holds its Hessian with the poses, A (d, d) its own (inverted once
eliminated), a (d,) its gradient; d is 3 for points, 4 for lines. Everything is written into the
caller's buffers.
"""
import numpy as np
from numba import njit

from line_slam_ros.estimation.window import STATE
from line_slam_ros.factors.line_reprojection import line_reprojection, line_residual
from line_slam_ros.factors.point_reprojection import inverse_depth_point, point_reprojection, point_residual
from line_slam_ros.factors.robust import CAUCHY, robust
from line_slam_ros.geometry.line_forms import move_line, world_line

BEHIND = 100.0  # cost of a point behind its camera, squared standard deviations (a rejected step, not a gradient)


@njit(cache=True, nogil=True, error_model='numpy')
def _weigh(r, sigma, c2, J_pose, scale):
    """Whiten r (2,) by sigma (2,) and weigh it robustly, J_pose (2, 6) alike; scale (2,) is what to multiply by."""
    _, w = robust(CAUCHY, (r[0] / sigma[0]) ** 2 + (r[1] / sigma[1]) ** 2, c2)
    for k in range(2):
        scale[k] = np.sqrt(w) / sigma[k]
        r[k] *= scale[k]
        for j in range(6):
            J_pose[k, j] *= scale[k]


@njit(cache=True, nogil=True, error_model='numpy')
def _invert_spd(A, d, L):
    """A (d, d) -> its inverse in place by Cholesky, L is scratch. False when A is not positive definite."""
    for j in range(d):
        s = A[j, j]
        for k in range(j):
            s -= L[j, k] * L[j, k]
        if not s > 0.0:
            return False
        L[j, j] = np.sqrt(s)
        for i in range(j + 1, d):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = s / L[j, j]
    for c in range(d):  # L^-1 in the upper part of A by columns, then A = L^-T L^-1
        for i in range(c, d):
            s = 1.0 if i == c else 0.0
            for k in range(c, i):
                s -= L[i, k] * A[c, k]
            A[c, i] = s / L[i, i]
    for i in range(d):
        for j in range(i, d):
            s = 0.0
            for k in range(j, d):
                s += A[i, k] * A[j, k]
            L[i, j] = s
    for i in range(d):
        for j in range(i, d):
            A[i, j] = L[i, j]
            A[j, i] = L[i, j]
    return True


@njit(cache=True, nogil=True, error_model='numpy')
def _add_observation(slot, d, r, J_pose, J_land, H, g, E, A, a):
    """One whitened residual into the state system (H, g) and into its landmark's (E: state-landmark, A, a)."""
    o = STATE * slot
    for i in range(6):
        for j in range(6):
            H[o + i, o + j] += J_pose[0, i] * J_pose[0, j] + J_pose[1, i] * J_pose[1, j]
        g[o + i] += J_pose[0, i] * r[0] + J_pose[1, i] * r[1]
        for j in range(d):
            E[slot, j, i] = J_pose[0, i] * J_land[0, j] + J_pose[1, i] * J_land[1, j]
    for i in range(d):
        for j in range(d):
            A[i, j] += J_land[0, i] * J_land[0, j] + J_land[1, i] * J_land[1, j]
        a[i] += J_land[0, i] * r[0] + J_land[1, i] * r[1]


@njit(cache=True, nogil=True, error_model='numpy')
def _eliminate(n, seen, d, damping, H, g, E, A, a, Y, L):
    """Schur complement of one landmark: A becomes its inverse; H -= E' A^-1 E (on and above the
    block diagonal only, see mirror), g -= E' A^-1 a. False when A is singular."""
    for i in range(d):
        A[i, i] *= 1.0 + damping
    if not _invert_spd(A, d, L):
        return False
    for f in range(n):
        if seen[f]:
            for i in range(6):
                s = 0.0
                for j in range(d):
                    y = 0.0
                    for m in range(d):
                        y += E[f, m, i] * A[m, j]
                    Y[i, j] = y
                    s += y * a[j]
                g[STATE * f + i] -= s
            for h in range(f, n):
                if seen[h]:
                    for i in range(6):
                        row = H[STATE * f + i]
                        for m in range(d):
                            y = Y[i, m]
                            for j in range(6):
                                row[STATE * h + j] -= y * E[h, m, j]
    return True


@njit(cache=True, nogil=True, error_model='numpy')
def mirror(n, H):
    """Copy the pose blocks above the diagonal to below it."""
    for f in range(n):
        for h in range(f + 1, n):
            for i in range(6):
                for j in range(6):
                    H[STATE * h + j, STATE * f + i] = H[STATE * f + i, STATE * h + j]


@njit(cache=True, nogil=True, error_model='numpy')
def add_points(n, R, p, R0, p0, R_BC, p_BC, use, seen, z, sigma, abr, R_WA, p_WA, c2, rho0, w_rho, damping,
               H, g, E, A, a):
    """Linearise and eliminate the points of rows with use[i]; residuals at (R, p), Jacobians at the first estimates.

    A weak prior of weight w_rho (m) pulls the inverse depth of unobservable points to rho0 (1/m).
    Fills E (M, n, 3, 6), A (M, 3, 3) (inverses) and a (M, 3) for the back substitution.
    """
    r, q, J_pose, J_ext, J_p = np.empty(2), np.empty(2), np.empty((2, 6)), np.empty((2, 6)), np.empty((2, 3))
    p_W, C, J, Y, L = np.empty(3), np.empty((3, 3)), np.empty((2, 3)), np.empty((6, 3)), np.empty((3, 3))
    scale = np.empty(2)
    for i in range(len(use)):
        A[i], a[i] = 0.0, 0.0
        if not use[i]:
            continue
        inverse_depth_point(R_WA[i], p_WA[i], abr[i], p_W, C)
        for f in range(n):
            E[i, f] = 0.0
            if not seen[i, f]:
                continue
            if not point_residual(R[f], p[f], R_BC, p_BC, p_W, z[i, f], r):
                continue
            if not point_reprojection(R0[f], p0[f], R_BC, p_BC, p_W, z[i, f], q, J_pose, J_ext, J_p):
                continue
            _weigh(r, sigma[i, f], c2, J_pose, scale)
            for k in range(2):
                for j in range(3):
                    J[k, j] = scale[k] * (J_p[k, 0] * C[0, j] + J_p[k, 1] * C[1, j] + J_p[k, 2] * C[2, j])
            _add_observation(f, 3, r, J_pose, J, H, g, E[i], A[i], a[i])
        A[i, 2, 2] += w_rho * w_rho
        a[i, 2] += w_rho * w_rho * (abr[i, 2] - rho0)
        if not _eliminate(n, seen[i], 3, damping, H, g, E[i], A[i], a[i], Y, L):
            A[i] = 0.0


@njit(cache=True, nogil=True, error_model='numpy')
def add_lines(n, R, p, R0, p0, R_BC, p_BC, use, seen, z, sigma, form, values, origin, c2, damping, H, g, E, A, a):
    """As add_points, for lines in any form (see geometry/line_forms.py): E (M, n, 4, 6), A (M, 4, 4), a (M, 4)."""
    r, q, J_pose, J_ext, J_l = np.empty(2), np.empty(2), np.empty((2, 6)), np.empty((2, 6)), np.empty((2, 6))
    n_W, d_W, C = np.empty(3), np.empty(3), np.empty((6, 4))
    J, Y, L, scale = np.empty((2, 4)), np.empty((6, 4)), np.empty((4, 4)), np.empty(2)
    for i in range(len(use)):
        A[i], a[i] = 0.0, 0.0
        if not use[i]:
            continue
        world_line(form, values[i], origin[i], n_W, d_W, C)
        for f in range(n):
            E[i, f] = 0.0
            if not seen[i, f]:
                continue
            if not line_residual(R[f], p[f], R_BC, p_BC, n_W, d_W, z[i, f], r):
                continue
            if not line_reprojection(R0[f], p0[f], R_BC, p_BC, n_W, d_W, z[i, f], q, J_pose, J_ext, J_l):
                continue
            _weigh(r, sigma[i, f], c2, J_pose, scale)
            for k in range(2):
                for j in range(4):
                    J[k, j] = 0.0
                    for m in range(6):
                        J[k, j] += scale[k] * J_l[k, m] * C[m, j]
            _add_observation(f, 4, r, J_pose, J, H, g, E[i], A[i], a[i])
        for j in range(4):
            A[i, j, j] += 1.0  # one radian of doubt: a line without parallax stays put instead of being singular
        if not _eliminate(n, seen[i], 4, damping, H, g, E[i], A[i], a[i], Y, L):
            A[i] = 0.0


@njit(cache=True, nogil=True, error_model='numpy')
def back_substitute(n, use, seen, d, E, A, a, dx, step):
    """Landmark steps (M, d) = -A^-1 (a + E dx) of the states' step dx."""
    for i in range(len(use)):
        for j in range(d):
            step[i, j] = 0.0
        if not use[i]:
            continue
        for j in range(d):
            s = a[i, j]
            for f in range(n):
                if seen[i, f]:
                    for m in range(6):
                        s += E[i, f, j, m] * dx[STATE * f + m]
            for k in range(d):
                step[i, k] -= A[i, k, j] * s


@njit(cache=True, nogil=True, error_model='numpy')
def point_cost(n, R, p, R_BC, p_BC, use, seen, z, sigma, abr, R_WA, p_WA, c2, rho0, w_rho, chi2):
    """Robust cost of the points; fills chi2 (M, n) with squared whitened residuals (-1 where unseen or behind)."""
    r, p_W, C = np.empty(2), np.empty(3), np.empty((3, 3))
    cost = 0.0
    for i in range(len(use)):
        if not use[i]:
            continue
        inverse_depth_point(R_WA[i], p_WA[i], abr[i], p_W, C)
        cost += (w_rho * (abr[i, 2] - rho0)) ** 2
        for f in range(n):
            chi2[i, f] = -1.0
            if not seen[i, f]:
                continue
            if not point_residual(R[f], p[f], R_BC, p_BC, p_W, z[i, f], r):
                cost += BEHIND
                chi2[i, f] = BEHIND
                continue
            chi2[i, f] = (r[0] / sigma[i, f, 0]) ** 2 + (r[1] / sigma[i, f, 1]) ** 2
            cost += robust(CAUCHY, chi2[i, f], c2)[0]
    return 0.5 * cost


@njit(cache=True, nogil=True, error_model='numpy')
def line_cost(n, R, p, R_BC, p_BC, use, seen, z, sigma, form, values, origin, c2, chi2):
    """Robust cost of the lines; chi2 (M, n) as in point_cost."""
    r, n_W, d_W, C = np.empty(2), np.empty(3), np.empty(3), np.empty((6, 4))
    cost = 0.0
    for i in range(len(use)):
        if not use[i]:
            continue
        world_line(form, values[i], origin[i], n_W, d_W, C)
        for f in range(n):
            chi2[i, f] = -1.0
            if seen[i, f] and line_residual(R[f], p[f], R_BC, p_BC, n_W, d_W, z[i, f], r):
                chi2[i, f] = (r[0] / sigma[i, f, 0]) ** 2 + (r[1] / sigma[i, f, 1]) ** 2
                cost += robust(CAUCHY, chi2[i, f], c2)[0]
    return 0.5 * cost


@njit(cache=True, nogil=True, error_model='numpy')
def retract_landmarks(use_points, abr, point_step, use_lines, form, values, line_step):
    """Apply landmark steps in place; an inverse depth may shrink to a fifth per step but stays positive."""
    for i in range(len(use_points)):
        if use_points[i]:
            abr[i, 0] += point_step[i, 0]
            abr[i, 1] += point_step[i, 1]
            abr[i, 2] = max(abr[i, 2] + point_step[i, 2], 0.2 * abr[i, 2], 1e-4)
    for i in range(len(use_lines)):
        if use_lines[i]:
            move_line(form, values[i], line_step[i], values[i])
