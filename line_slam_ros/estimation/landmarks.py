"""Points and lines in the normal equations, compiled: linearise, eliminate by Schur complement, step back, cost.

A landmark's block E (slots, d, 6) holds its Hessian with the poses, B (d, 7) that with the rig, A (d, d) its own
(inverted once eliminated), a (d,) its gradient; d is 3 for points, 4 for lines. Everything is written into the caller's
buffers. R, p are the bodies' poses when the images were taken, twist (n, 6) their [angular velocity in B, velocity in
W], rig the row of the rig's first unknown in H, or negative when the rig is not estimated.
"""
import numpy as np
from numba import njit

from line_slam_ros.estimation.window import RIG, STATE
from line_slam_ros.factors.line_reprojection import line_reprojection, line_residual
from line_slam_ros.factors.point_reprojection import inverse_depth_point, point_reprojection, point_residual
from line_slam_ros.factors.robust import CAUCHY, robust
from line_slam_ros.geometry.line_forms import move_line, world_line

BEHIND = 100.0  # cost of a point behind its camera, squared standard deviations (a rejected step, not a gradient)


@njit(cache=True, nogil=True, error_model='numpy')
def _weigh(r, sigma, c2, twist, J_pose, J_ext, scale, J_rig):
    """Whiten r (2,) by sigma (2,) and weigh it robustly, J_pose (2, 6) alike; scale (2,) is what to multiply by.

    Fills J_rig (2, 7) from J_ext (2, 6) and the motion: an image taken later by dt shows the body moved by twist dt.
    """
    _, w = robust(CAUCHY, (r[0] / sigma[0]) ** 2 + (r[1] / sigma[1]) ** 2, c2)
    for k in range(2):
        scale[k] = np.sqrt(w) / sigma[k]
        r[k] *= scale[k]
        J_rig[k, 6] = 0.0
        for j in range(6):
            J_pose[k, j] *= scale[k]
            J_rig[k, j] = J_ext[k, j] * scale[k]
            J_rig[k, 6] += J_pose[k, j] * twist[j]


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
def _add_observation(slot, rig, d, r, J_pose, J_rig, J_land, H, g, E, B, A, a):
    """One whitened residual into the system (H, g) and into its landmark's (E, B: with state and rig, A, a)."""
    o = STATE * slot
    for i in range(6):
        for j in range(6):
            H[o + i, o + j] += J_pose[0, i] * J_pose[0, j] + J_pose[1, i] * J_pose[1, j]
        g[o + i] += J_pose[0, i] * r[0] + J_pose[1, i] * r[1]
        for j in range(d):
            E[slot, j, i] = J_pose[0, i] * J_land[0, j] + J_pose[1, i] * J_land[1, j]
    if rig >= 0:
        for i in range(RIG):
            for j in range(6):
                H[o + j, rig + i] += J_pose[0, j] * J_rig[0, i] + J_pose[1, j] * J_rig[1, i]
            for j in range(RIG):
                H[rig + i, rig + j] += J_rig[0, i] * J_rig[0, j] + J_rig[1, i] * J_rig[1, j]
            g[rig + i] += J_rig[0, i] * r[0] + J_rig[1, i] * r[1]
            for j in range(d):
                B[j, i] += J_rig[0, i] * J_land[0, j] + J_rig[1, i] * J_land[1, j]
    for i in range(d):
        for j in range(d):
            A[i, j] += J_land[0, i] * J_land[0, j] + J_land[1, i] * J_land[1, j]
        a[i] += J_land[0, i] * r[0] + J_land[1, i] * r[1]


@njit(cache=True, nogil=True, error_model='numpy')
def _eliminate(n, seen, rig, d, damping, H, g, E, B, A, a, Y, L):
    """Schur complement of one landmark: A becomes its inverse; H -= [E B]' A^-1 [E B] (on and above the
    block diagonal only, see mirror), g -= [E B]' A^-1 a. False when A is singular. Y (7, d) is scratch."""
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
            if rig >= 0:
                _subtract(6, d, Y, B, H, STATE * f, rig)
    if rig >= 0:
        for i in range(RIG):
            s = 0.0
            for j in range(d):
                y = 0.0
                for m in range(d):
                    y += B[m, i] * A[m, j]
                Y[i, j] = y
                s += y * a[j]
            g[rig + i] -= s
        _subtract(RIG, d, Y, B, H, rig, rig)
    return True


@njit(cache=True, nogil=True, error_model='numpy')
def _subtract(rows, d, Y, B, H, at, rig):
    """H[at:, rig:] -= Y B for the first rows of Y (7, d), B (d, 7)."""
    for i in range(rows):
        row = H[at + i]
        for m in range(d):
            y = Y[i, m]
            for j in range(RIG):
                row[rig + j] -= y * B[m, j]


@njit(cache=True, nogil=True, error_model='numpy')
def mirror(n, rig, H):
    """Copy the pose and rig blocks above the diagonal to below it."""
    for f in range(n):
        if rig >= 0:
            for i in range(6):
                for j in range(RIG):
                    H[rig + j, STATE * f + i] = H[STATE * f + i, rig + j]
        for h in range(f + 1, n):
            for i in range(6):
                for j in range(6):
                    H[STATE * h + j, STATE * f + i] = H[STATE * f + i, STATE * h + j]


@njit(cache=True, nogil=True, error_model='numpy')
def add_points(n, R, p, R0, p0, R_BC, p_BC, twist, rig, use, seen, z, sigma, abr, R_WA, p_WA, c2, rho0, w_rho,
               damping, H, g, E, B, A, a):
    """Linearise and eliminate the points of rows with use[i]; residuals at (R, p), Jacobians at the first estimates.

    A weak prior of weight w_rho (m) pulls the inverse depth of unobservable points to rho0 (1/m).
    Fills E (M, n, 3, 6), B (M, 3, 7), A (M, 3, 3) (inverses) and a (M, 3) for the back substitution.
    """
    r, q, J_pose, J_ext, J_p = np.empty(2), np.empty(2), np.empty((2, 6)), np.empty((2, 6)), np.empty((2, 3))
    p_W, C, J, Y, L = np.empty(3), np.empty((3, 3)), np.empty((2, 3)), np.empty((RIG, 3)), np.empty((3, 3))
    scale, J_rig = np.empty(2), np.empty((2, RIG))
    for i in range(len(use)):
        A[i], a[i], B[i] = 0.0, 0.0, 0.0
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
            _weigh(r, sigma[i, f], c2, twist[f], J_pose, J_ext, scale, J_rig)
            for k in range(2):
                for j in range(3):
                    J[k, j] = scale[k] * (J_p[k, 0] * C[0, j] + J_p[k, 1] * C[1, j] + J_p[k, 2] * C[2, j])
            _add_observation(f, rig, 3, r, J_pose, J_rig, J, H, g, E[i], B[i], A[i], a[i])
        A[i, 2, 2] += w_rho * w_rho
        a[i, 2] += w_rho * w_rho * (abr[i, 2] - rho0)
        if not _eliminate(n, seen[i], rig, 3, damping, H, g, E[i], B[i], A[i], a[i], Y, L):
            A[i] = 0.0


@njit(cache=True, nogil=True, error_model='numpy')
def add_lines(n, R, p, R0, p0, R_BC, p_BC, twist, rig, use, seen, z, sigma, form, values, origin, c2, damping, H, g,
              E, B, A, a):
    """As add_points, for lines in any form (geometry/line_forms.py): E (M, n, 4, 6), B (M, 4, 7), A (M, 4, 4), a."""
    r, q, J_pose, J_ext, J_l = np.empty(2), np.empty(2), np.empty((2, 6)), np.empty((2, 6)), np.empty((2, 6))
    n_W, d_W, C = np.empty(3), np.empty(3), np.empty((6, 4))
    J, Y, L, scale = np.empty((2, 4)), np.empty((RIG, 4)), np.empty((4, 4)), np.empty(2)
    J_rig = np.empty((2, RIG))
    for i in range(len(use)):
        A[i], a[i], B[i] = 0.0, 0.0, 0.0
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
            _weigh(r, sigma[i, f], c2, twist[f], J_pose, J_ext, scale, J_rig)
            for k in range(2):
                for j in range(4):
                    J[k, j] = 0.0
                    for m in range(6):
                        J[k, j] += scale[k] * J_l[k, m] * C[m, j]
            _add_observation(f, rig, 4, r, J_pose, J_rig, J, H, g, E[i], B[i], A[i], a[i])
        for j in range(4):
            A[i, j, j] += 1.0  # one radian of doubt: a line without parallax stays put instead of being singular
        if not _eliminate(n, seen[i], rig, 4, damping, H, g, E[i], B[i], A[i], a[i], Y, L):
            A[i] = 0.0


@njit(cache=True, nogil=True, error_model='numpy')
def back_substitute(n, use, seen, d, rig, E, B, A, a, dx, step):
    """Landmark steps (M, d) = -A^-1 (a + [E B] dx) of the step dx of states and rig."""
    for i in range(len(use)):
        for j in range(d):
            step[i, j] = 0.0
        if not use[i]:
            continue
        for j in range(d):
            s = a[i, j]
            if rig >= 0:
                for m in range(RIG):
                    s += B[i, j, m] * dx[rig + m]
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
