"""First 3D estimates of points and lines from the window's poses, compiled."""
import numpy as np
from numba import njit

from line_slam_ros.factors.line_reprojection import orthonormal_line


@njit(cache=True, nogil=True, error_model='numpy')
def camera_pose(R_WB, p_WB, R_BC, p_BC, R_WC, p_WC):
    """T_WC = T_WB T_BC, written into R_WC (3, 3), p_WC (3,)."""
    for i in range(3):
        p_WC[i] = p_WB[i]
        for j in range(3):
            p_WC[i] += R_WB[i, j] * p_BC[j]
            R_WC[i, j] = R_WB[i, 0] * R_BC[0, j] + R_WB[i, 1] * R_BC[1, j] + R_WB[i, 2] * R_BC[2, j]


@njit(cache=True, nogil=True, error_model='numpy')
def start_points(n, R, p, R_BC, p_BC, todo, seen, z, sigma, abr, R_WA, p_WA, rho0, w_rho, solved):
    """Anchored inverse depth of the rows in todo, from the first view that saw them.

    With m the anchor bearing, R, t the motion anchor -> view, the view's equation
    x (R m + rho t)_z = (R m + rho t)_xy is linear in rho; least squares over all views together with
    the belief rho0 of weight w_rho always has a solution. Rows seen twice become solved.
    """
    R_WC, p_WC, t, m = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(todo)):
        if not todo[i]:
            continue
        anchor, views = -1, 0
        top, bottom = w_rho * w_rho * rho0, w_rho * w_rho
        for f in range(n):
            if not seen[i, f]:
                continue
            views += 1
            if anchor < 0:
                anchor = f
                camera_pose(R[f], p[f], R_BC, p_BC, R_WA[i], p_WA[i])
                continue
            camera_pose(R[f], p[f], R_BC, p_BC, R_WC, p_WC)
            for k in range(3):
                t[k] = 0.0
                m[k] = 0.0
                for j in range(3):
                    t[k] += R_WC[j, k] * (p_WA[i, j] - p_WC[j])
                    bearing = R_WA[i, j, 0] * z[i, anchor, 0] + R_WA[i, j, 1] * z[i, anchor, 1] + R_WA[i, j, 2]
                    m[k] += R_WC[j, k] * bearing
            for k in range(2):
                A = (z[i, f, k] * t[2] - t[k]) / sigma[i, f, k]
                y = (m[k] - z[i, f, k] * m[2]) / sigma[i, f, k]
                top += A * y
                bottom += A * A
        if views >= 2:
            abr[i, 0], abr[i, 1], abr[i, 2] = z[i, anchor, 0], z[i, anchor, 1], max(top / bottom, 0.02)
            solved[i] = True


@njit(cache=True, nogil=True, error_model='numpy')
def start_lines(n, R, p, R_BC, p_BC, todo, seen, z, min_sine, host, U, phi, rho, origin, solved):
    """Lines of the rows in todo, in either form (see world_line), from all observation planes (multi-view SVD).

    Every view's plane (n_j, -n_j . p_j) holds the line, so the two smallest eigenvectors of the sum
    of their outer products span it. Rows stay unsolved when no two planes meet at more than
    asin(min_sine) (motion along the line, in its plane, or too short) or an observed end lies behind a camera.
    """
    R_WC, p_WC, h = np.empty((3, 3)), np.empty(3), np.empty(3)
    normals, planes = np.empty((n, 3)), np.empty(4)
    for i in range(len(todo)):
        if not todo[i]:
            continue
        M, views = np.zeros((4, 4)), 0
        for f in range(n):
            if not seen[i, f]:
                continue
            camera_pose(R[f], p[f], R_BC, p_BC, R_WC, p_WC)
            if views == 0:
                origin[i] = p_WC
            a, b = z[i, f, 0], z[i, f, 1]
            h[0], h[1], h[2] = a[1] - b[1], b[0] - a[0], a[0] * b[1] - a[1] * b[0]
            s = 1.0 / np.sqrt(h[0] * h[0] + h[1] * h[1] + h[2] * h[2])
            planes[3] = 0.0
            for k in range(3):
                planes[k] = s * (R_WC[k, 0] * h[0] + R_WC[k, 1] * h[1] + R_WC[k, 2] * h[2])
                normals[views, k] = planes[k]
                planes[3] -= planes[k] * (p_WC[k] - origin[i, k])
            views += 1
            for k in range(4):
                for j in range(4):
                    M[k, j] += planes[k] * planes[j]
        if views < 2 or _widest(normals, views) < min_sine:
            continue
        _, V = np.linalg.eigh(M)
        if not _line_through(V[:, 0], V[:, 1], U[i], h):
            continue
        phi[i] = np.arctan2(h[1], h[0])
        solved[i] = _in_front(n, R, p, R_BC, p_BC, seen[i], z[i], U[i], phi[i], origin[i])
        if host and solved[i]:
            first = np.argmax(seen[i])
            camera_pose(R[first], p[first], R_BC, p_BC, R_WC, p_WC)
            solved[i] = _pin_to_host(R_WC, z[i, first], U[i], phi[i:i + 1], rho[i:i + 1])


@njit(cache=True, nogil=True, error_model='numpy')
def _pin_to_host(R_WC, ends, U, phi, rho):
    """Orthonormal (U, phi) about the host camera -> host form, in place: nearest line in the host's observation plane.

    rho = |y x d|^2 / ((y x d) . n) is the exact inverse range at which the bearing y passes the line.
    False when the line is not in front or runs along y.
    """
    x, y, q = np.empty(3), np.empty(3), np.empty(3)
    q[0], q[1] = ends[0, 1] - ends[1, 1], ends[1, 0] - ends[0, 0]
    q[2] = ends[0, 0] * ends[1, 1] - ends[0, 1] * ends[1, 0]
    m0, m1 = 0.5 * (ends[0, 0] + ends[1, 0]), 0.5 * (ends[0, 1] + ends[1, 1])
    nq, nm = 1.0 / np.sqrt(q @ q), 1.0 / np.sqrt(m0 * m0 + m1 * m1 + 1.0)
    n, d = np.cos(phi[0]) * U[:, 0].copy(), np.sin(phi[0]) * U[:, 1].copy()
    zn = np.empty(3)
    for i in range(3):
        y[i] = nm * (R_WC[i, 0] * m0 + R_WC[i, 1] * m1 + R_WC[i, 2])
        zn[i] = nq * (R_WC[i, 0] * q[0] + R_WC[i, 1] * q[1] + R_WC[i, 2] * q[2])
    c = np.cross(y, d)
    along = c @ n
    if not along > 0.0:
        return False
    rho[0] = (c @ c) / along
    x[:] = np.cross(y, zn)
    phi[0] = np.arctan2(d @ y, d @ x)
    U[:, 0], U[:, 1], U[:, 2] = x, y, zn
    return rho[0] > 1e-4


@njit(cache=True, nogil=True, error_model='numpy')
def _widest(normals, views):
    """Largest sine between two of the unit normals (views, 3), blind to their signs."""
    least = 1.0
    for j in range(views):
        for k in range(j):
            c = abs(normals[j, 0] * normals[k, 0] + normals[j, 1] * normals[k, 1] + normals[j, 2] * normals[k, 2])
            least = min(least, c)
    return np.sqrt(max(0.0, 1.0 - least * least))


@njit(cache=True, nogil=True, error_model='numpy')
def _line_through(A, B, U, norms):
    """Points A, B (4,) -> U (3, 3) = [n, d, n x d] normalised, norms[:2] = |n|, |d|; False without direction."""
    n0, n1, n2 = A[1] * B[2] - A[2] * B[1], A[2] * B[0] - A[0] * B[2], A[0] * B[1] - A[1] * B[0]
    d0, d1, d2 = A[3] * B[0] - B[3] * A[0], A[3] * B[1] - B[3] * A[1], A[3] * B[2] - B[3] * A[2]
    nn, nd = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2), np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    if nd < 1e-9 or nn < 1e-6 * nd:
        return False
    norms[0], norms[1] = nn, nd
    n0, n1, n2 = n0 / nn, n1 / nn, n2 / nn
    k = (n0 * d0 + n1 * d1 + n2 * d2)
    d0, d1, d2 = d0 - k * n0, d1 - k * n1, d2 - k * n2
    nd = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    d0, d1, d2 = d0 / nd, d1 / nd, d2 / nd
    U[0, 0], U[1, 0], U[2, 0] = n0, n1, n2
    U[0, 1], U[1, 1], U[2, 1] = d0, d1, d2
    U[0, 2], U[1, 2], U[2, 2] = n1 * d2 - n2 * d1, n2 * d0 - n0 * d2, n0 * d1 - n1 * d0
    return True


@njit(cache=True, nogil=True, error_model='numpy')
def _in_front(n, R, p, R_BC, p_BC, seen, z, U, phi, origin):
    """Whether every view sees the line's feet of its observed ends at positive depth."""
    R_WC, p_WC, n_W, d_W, C = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty((6, 4))
    n_C, d_C = np.empty(3), np.empty(3)
    orthonormal_line(U, phi, origin, n_W, d_W, C)
    for f in range(n):
        if not seen[f]:
            continue
        camera_pose(R[f], p[f], R_BC, p_BC, R_WC, p_WC)
        h0 = n_W[0] - (p_WC[1] * d_W[2] - p_WC[2] * d_W[1])
        h1 = n_W[1] - (p_WC[2] * d_W[0] - p_WC[0] * d_W[2])
        h2 = n_W[2] - (p_WC[0] * d_W[1] - p_WC[1] * d_W[0])
        for k in range(3):
            n_C[k] = R_WC[0, k] * h0 + R_WC[1, k] * h1 + R_WC[2, k] * h2
            d_C[k] = R_WC[0, k] * d_W[0] + R_WC[1, k] * d_W[1] + R_WC[2, k] * d_W[2]
        for e in range(2):
            # foot of the end: the line meets the plane N through the eye and the image normal there,
            # X = [n x N; -d . N] (equation (8) with N through the origin)
            u, v = z[f, e, 0], z[f, e, 1]
            N0, N1, N2 = -n_C[1], n_C[0], u * n_C[1] - v * n_C[0]
            w = d_C[0] * N0 + d_C[1] * N1 + d_C[2] * N2
            z_foot = (n_C[0] * N1 - n_C[1] * N0) / (-w) if w != 0.0 else -1.0
            if not z_foot > 0.05:
                return False
    return True

