"""Points and lines in the normal equations, compiled: residuals, Jacobians, elimination by Schur complement, step back.

All that a camera sees are the rig and the poses, so landmarks fill a system of their own over the columns [rig, pose
of slot 0, pose of slot 1, ...]. For landmark i, of d numbers (3 for a point, 4 for a line), and slot f the buffers hold

    chi2, weight (M, slots), pull (M, slots, 2)   squared whitened residual (-1: none, inf: a point behind the
                                                  camera), its robust weight, their product
    at, undo (M, slots)                           where in J its Jacobian is (-1: nowhere), 1 / sqrt(weight) then
    by_land (M, slots, 2, d)                      Jacobian by the landmark
    L (M, d, d), a (M, d)                         A = L L', the landmark's own Hessian, and its gradient

and J (slots, K, LANES) the Jacobians by rig and pose, slot by slot, two rows an observation, whitened and weighted. In
S each landmark has d rows, from first[i] on: its ties W to the columns, then L^-1 W. So eliminating all takes S' S, and
their gradients and steps S' s and S dx with s = L^-1 a.

R, p are the bodies' poses when the images were taken, twist (n, 6) their [angular velocity in B, velocity in W].
"""
import numpy as np

from line_slam_ros.estimation.window import DELAY, POSE, RIG, STATE, state_row
from line_slam_ros.factors.line_reprojection import line_reprojection, line_residual
from line_slam_ros.factors.point_reprojection import inverse_depth_point, point_reprojection, point_residual
from line_slam_ros.factors.robust import CAUCHY, robust
from line_slam_ros.geometry.line_forms import move_line, world_line
from line_slam_ros.geometry.small_systems import factor
from line_slam_ros.kernel_cache import inner, kernel

BEHIND = 100.0  # cost of a point behind its camera, squared standard deviations (a rejected step, not a gradient)
OWN = RIG + POSE  # columns that one observation depends on
LANES = 16  # OWN and more: what processors like, the rest is zero


@kernel
def column(slot):
    """First column of a slot's pose among those that cameras see."""
    return RIG + POSE * slot


@kernel
def point_residuals(n, R, p, R_BC, p_BC, use, seen, z, sigma, abr, R_WA, p_WA, c2, rho0, w_rho, chi2, pull, weight, a):
    """Robust cost of the points of rows with use[i]; fills their chi2, pull and weight, and starts their gradients a.

    A weak prior of weight w_rho (m) pulls the inverse depth of unobservable points to rho0 (1/m).
    """
    r, p_W, C = np.empty(2), np.empty(3), np.empty((3, 3))
    cost = 0.0
    for i in range(len(use)):
        if not use[i]:
            continue
        inverse_depth_point(R_WA[i], p_WA[i], abr[i], p_W, C)
        belief = w_rho * (abr[i, 2] - rho0)
        cost += belief * belief
        a[i, 0], a[i, 1], a[i, 2] = 0.0, 0.0, w_rho * belief
        for f in range(n):
            chi2[i, f], weight[i, f] = -1.0, 0.0
            pull[i, f, 0], pull[i, f, 1] = 0.0, 0.0
            if not seen[i, f]:
                continue
            if point_residual(R[f], p[f], R_BC, p_BC, p_W, z[i, f], r):
                cost += _weigh(r, sigma, i, f, c2, chi2, pull, weight)
            else:
                cost += BEHIND
                chi2[i, f] = np.inf
    return 0.5 * cost


@kernel
def line_residuals(n, R, p, R_BC, p_BC, use, seen, z, sigma, form, values, origin, c2, chi2, pull, weight, a):
    """As point_residuals, for lines in any form (geometry/line_forms.py)."""
    r, n_W, d_W, C = np.empty(2), np.empty(3), np.empty(3), np.empty((6, 4))
    cost = 0.0
    for i in range(len(use)):
        if not use[i]:
            continue
        world_line(form, values[i], origin[i], n_W, d_W, C)
        for j in range(4):
            a[i, j] = 0.0
        for f in range(n):
            chi2[i, f], weight[i, f] = -1.0, 0.0
            pull[i, f, 0], pull[i, f, 1] = 0.0, 0.0
            if seen[i, f] and line_residual(R[f], p[f], R_BC, p_BC, n_W, d_W, z[i, f], r):
                cost += _weigh(r, sigma, i, f, c2, chi2, pull, weight)
    return 0.5 * cost


@inner(forceinline=True)
def _weigh(r, sigma, i, f, c2, chi2, pull, weight):
    """One residual r (2,) whitened and weighed robustly; returns its cost twice."""
    r0, r1 = r[0] / sigma[i, f, 0], r[1] / sigma[i, f, 1]
    square = r0 * r0 + r1 * r1
    rho, w = robust(CAUCHY, square, c2)
    chi2[i, f], weight[i, f] = square, w
    pull[i, f, 0], pull[i, f, 1] = w * r0, w * r1
    return rho


@kernel
def point_jacobians(n, R, p, R_BC, p_BC, twist, use, z, sigma, abr, R_WA, p_WA, w_rho, weight, count, J, at, undo,
                    by_land, L, first, S):
    """Jacobians at poses (R, p) of all observations with a weight, and the points' rows of L and S (not eliminated).

    Every slot's are appended to its rows of J, of which count (slots,) are taken.
    """
    v, J_pose, J_rig, J_p = np.empty(2), np.empty((2, POSE)), np.empty((2, POSE)), np.empty((2, 3))
    p_W, C = np.empty(3), np.empty((3, 3))
    for i in range(len(use)):
        if not use[i]:
            continue
        inverse_depth_point(R_WA[i], p_WA[i], abr[i], p_W, C)
        L[i] = 0.0
        for f in range(n):
            at[i, f] = -1
            if not (weight[i, f] > 0.0 and point_reprojection(R[f], p[f], R_BC, p_BC, p_W, z[i, f], v, J_pose, J_rig,
                                                              J_p)):
                continue
            root = np.sqrt(weight[i, f])
            for k in range(2):
                scale = root / sigma[i, f, k]
                for j in range(3):
                    by_land[i, f, k, j] = scale * (J_p[k, 0] * C[0, j] + J_p[k, 1] * C[1, j] + J_p[k, 2] * C[2, j])
            _append(i, f, root, sigma, twist, J_pose, J_rig, count, J, at, undo)
            _tie(i, f, 3, J, at, by_land, L, first, S)
        L[i, 2, 2] += w_rho * w_rho


@kernel
def line_jacobians(n, R, p, R_BC, p_BC, twist, use, z, sigma, form, values, origin, weight, count, J, at, undo, by_land,
                   L, first, S):
    """As point_jacobians, for lines."""
    v, J_pose, J_rig, J_l = np.empty(2), np.empty((2, POSE)), np.empty((2, POSE)), np.empty((2, 6))
    n_W, d_W, C = np.empty(3), np.empty(3), np.empty((6, 4))
    for i in range(len(use)):
        if not use[i]:
            continue
        world_line(form, values[i], origin[i], n_W, d_W, C)
        L[i] = 0.0
        for f in range(n):
            at[i, f] = -1
            if not (weight[i, f] > 0.0 and line_reprojection(R[f], p[f], R_BC, p_BC, n_W, d_W, z[i, f], v, J_pose,
                                                             J_rig, J_l)):
                continue
            root = np.sqrt(weight[i, f])
            for k in range(2):
                scale = root / sigma[i, f, k]
                for j in range(4):
                    t = 0.0
                    for m in range(6):
                        t += J_l[k, m] * C[m, j]
                    by_land[i, f, k, j] = scale * t
            _append(i, f, root, sigma, twist, J_pose, J_rig, count, J, at, undo)
            _tie(i, f, 4, J, at, by_land, L, first, S)
        for j in range(4):
            L[i, j, j] += 1.0  # one radian of doubt: a line without parallax stays put instead of being singular


@inner(forceinline=True)
def _append(i, f, root, sigma, twist, J_pose, J_rig, count, J, at, undo):
    """Whiten and weigh the Jacobians (2, 6) of one observation and put them into J.

    The column of the delay: an image taken later by dt shows the body moved by twist dt.
    """
    m = count[f]
    count[f] = m + 2
    at[i, f], undo[i, f] = m, 1.0 / root
    for k in range(2):
        scale, delay = root / sigma[i, f, k], 0.0
        for j in range(POSE):
            delay += J_pose[k, j] * twist[f, j]
            J[f, m + k, j] = scale * J_rig[k, j]
            J[f, m + k, RIG + j] = scale * J_pose[k, j]
        J[f, m + k, DELAY] = scale * delay


@inner(forceinline=True)
def _tie(i, f, d, J, at, by_land, L, first, S):
    """Add one observation to the Hessian (lower triangle, in L) of its landmark and to its ties, in S."""
    m, o, row = at[i, f], RIG + POSE * f, first[i]
    for j in range(d):
        x, y = by_land[i, f, 0, j], by_land[i, f, 1, j]
        for k in range(j + 1):
            L[i, j, k] += x * by_land[i, f, 0, k] + y * by_land[i, f, 1, k]
        for c in range(RIG):
            S[row + j, c] += x * J[f, m, c] + y * J[f, m + 1, c]
        for c in range(POSE):
            S[row + j, o + c] = x * J[f, m, RIG + c] + y * J[f, m + 1, RIG + c]


@kernel
def eliminate(use, d, damping, L, first, columns, S):
    """Factor the landmarks' Hessians, diagonals times 1 + damping, in place, and turn their rows of S into L^-1 W,
    of so many columns.

    A landmark whose Hessian is singular stays where it is: its rows become zero, and its step will.
    """
    for i in range(len(use)):
        if not use[i]:
            continue
        row = first[i]
        if not factor(L[i], d, damping):
            L[i] = 0.0
            S[row:row + d, :columns] = 0.0
            continue
        for j in range(d):
            for k in range(j):
                x = L[i, j, k]
                for c in range(columns):
                    S[row + j, c] -= x * S[row + k, c]
            x = 1.0 / L[i, j, j]
            for c in range(columns):
                S[row + j, c] *= x


@kernel
def gradients(n, use, d, pull, at, undo, by_land, L, a, first, J, own, s):
    """Add what the residuals pull at each slot's [rig, pose] to own (slots, LANES); fill the landmarks' rows of s (K,)
    with L^-1 a."""
    for i in range(len(use)):
        if not use[i]:
            continue
        for f in range(n):
            m = at[i, f]
            if m < 0:
                continue
            x, y = undo[i, f] * pull[i, f, 0], undo[i, f] * pull[i, f, 1]
            for c in range(LANES):
                own[f, c] += x * J[f, m, c] + y * J[f, m + 1, c]
            for j in range(d):
                a[i, j] += x * by_land[i, f, 0, j] + y * by_land[i, f, 1, j]
        row = first[i]
        for j in range(d):
            t = a[i, j]
            for k in range(j):
                t -= L[i, j, k] * s[row + k]
            s[row + j] = t / L[i, j, j] if L[i, j, j] > 0.0 else 0.0


def poses_of(n, x):
    """The part (n, POSE) of x, over the rows of the window, that belongs to the poses of its slots: a view."""
    return x[RIG:state_row(n)].reshape(n, STATE)[:, :POSE]


def add_gradient(n, own, g):
    """Add the slots' pulls own (slots, LANES) to the gradient g of the window."""
    for pull in own[:n, :RIG]:
        g[:RIG] += pull
    poses_of(n, g)[:] += own[:n, RIG:RIG + POSE]


def spread(n, q, g):
    """Add q (C,), over the columns that cameras see, to the gradient g of the window."""
    g[:RIG] += q[:RIG]
    poses_of(n, g)[:] += q[RIG:column(n)].reshape(n, POSE)


def gather(n, dx, columns):
    """Fill columns (C,) with the parts of a step dx of the window that cameras see."""
    columns[:RIG] = dx[:RIG]
    columns[RIG:column(n)].reshape(n, POSE)[:] = poses_of(n, dx)


@kernel
def add_hessian(n, own, SS, H):
    """Add the slots' own Hessians own (slots, LANES, LANES) and -SS (C, C), over the columns that cameras see, to H."""
    rows = np.empty(len(SS), np.int64)
    for a in range(RIG):
        rows[a] = a
    for f in range(n):
        for a in range(POSE):
            rows[column(f) + a] = state_row(f) + a
        for a in range(RIG):
            for c in range(RIG):
                H[a, c] += own[f, a, c]
            for c in range(POSE):
                H[a, state_row(f) + c] += own[f, a, RIG + c]
                H[state_row(f) + c, a] += own[f, a, RIG + c]
        for a in range(POSE):
            for c in range(POSE):
                H[state_row(f) + a, state_row(f) + c] += own[f, RIG + a, RIG + c]
    for a in range(column(n)):
        for c in range(column(n)):
            H[rows[a], rows[c]] -= SS[a, c]


@kernel
def back_substitute(use, d, L, first, t, step):
    """Landmark steps (M, d) = -L'^-1 t, t (K,) = s + S dx."""
    for i in range(len(use)):
        for j in range(d - 1, -1, -1):
            step[i, j] = 0.0
            if not (use[i] and L[i, j, j] > 0.0):
                continue
            x = -t[first[i] + j]
            for k in range(j + 1, d):
                x -= L[i, k, j] * step[i, k]
            step[i, j] = x / L[i, j, j]


@kernel
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
