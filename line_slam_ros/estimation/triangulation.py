"""First 3D estimates of points and lines from the window's poses, compiled."""
import numpy as np

from line_slam_ros.geometry.line_forms import store_line, world_line
from line_slam_ros.kernel_cache import inner, kernel

NEAREST = 0.05  # m from the camera: where a line that is seen cannot be
SIGNIFICANT = 5.0  # standard deviations of an angle between observation planes that noise does not explain


@kernel
def camera_pose(R_WB, p_WB, R_BC, p_BC, R_WC, p_WC):
    """T_WC = T_WB T_BC, written into R_WC (3, 3), p_WC (3,)."""
    for i in range(3):
        p_WC[i] = p_WB[i]
        for j in range(3):
            p_WC[i] += R_WB[i, j] * p_BC[j]
            R_WC[i, j] = R_WB[i, 0] * R_BC[0, j] + R_WB[i, 1] * R_BC[1, j] + R_WB[i, 2] * R_BC[2, j]


@kernel
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


def start_lines(n, R, p, R_BC, p_BC, todo, seen, z, sigma, min_sine, form, values, origin, solved):
    """Lines of the rows in todo, in any form (geometry/line_forms.py), from all observation planes (multi-view SVD).

    Every view's plane (n_j, -n_j . p_j) holds the line, so the two smallest eigenvectors of the sum
    of their outer products span it. Rows stay unsolved when no two planes meet at more than asin(min_sine) and than
    their noise explains (motion along the line, in its plane, or too short), an observed end lies behind a camera, or
    the form cannot hold the line.
    """
    squares, first = np.zeros((len(todo), 4, 4)), np.full(len(todo), -1)
    planes_of_lines(n, R, p, R_BC, p_BC, todo, seen, z, sigma, min_sine, origin, squares, first)
    rows = np.flatnonzero(first >= 0)
    if len(rows):
        points = np.ascontiguousarray(np.linalg.eigh(squares[rows])[1][:, :, :2].transpose(0, 2, 1))
        lines_of_points(rows, points, first, n, R, p, R_BC, p_BC, seen, z, form, values, origin, solved)


@kernel
def planes_of_lines(n, R, p, R_BC, p_BC, todo, seen, z, sigma, min_sine, origin, squares, first):
    """Of the rows in todo, origin (M, 3), the first camera's centre, and squares (M, 4, 4), the sum of their planes'
    outer products; first (M,) becomes the first view's slot where the planes meet at a sufficient angle."""
    R_WC, p_WC, h = np.empty((3, 3)), np.empty(3), np.empty(3)
    normals, planes, noise2 = np.empty((n, 3)), np.empty(4), np.empty(n)
    for i in range(len(todo)):
        if not todo[i]:
            continue
        views, earliest = 0, 0
        for f in range(n):
            if not seen[i, f]:
                continue
            camera_pose(R[f], p[f], R_BC, p_BC, R_WC, p_WC)
            if views == 0:
                earliest = f
                for k in range(3):
                    origin[i, k] = p_WC[k]
            a, b = z[i, f, 0], z[i, f, 1]
            h[0], h[1], h[2] = a[1] - b[1], b[0] - a[0], a[0] * b[1] - a[1] * b[0]
            s = 1.0 / np.sqrt(h[0] * h[0] + h[1] * h[1] + h[2] * h[2])
            planes[3] = 0.0
            for k in range(3):
                planes[k] = s * (R_WC[k, 0] * h[0] + R_WC[k, 1] * h[1] + R_WC[k, 2] * h[2])
                normals[views, k] = planes[k]
                planes[3] -= planes[k] * (p_WC[k] - origin[i, k])
            noise2[views] = plane_variance(z[i, f], sigma[i, f])
            views += 1
            for k in range(4):
                for j in range(4):
                    squares[i, k, j] += planes[k] * planes[j]
        if views >= 2 and has_parallax(normals, noise2, views, min_sine):
            first[i] = earliest


@kernel
def lines_of_points(rows, points, first, n, R, p, R_BC, p_BC, seen, z, form, values, origin, solved):
    """Store the lines of these rows through points (len(rows), 2, 4) where no view sees them behind the camera."""
    R_WC, p_WC, nd = np.empty((3, 3)), np.empty(3), np.empty(6)
    for k in range(len(rows)):
        i = rows[k]
        f = first[i]
        if _line_through(points[k, 0], points[k, 1], nd) \
                and _in_front(n, R, p, R_BC, p_BC, seen[i], z[i], nd, origin[i]):
            camera_pose(R[f], p[f], R_BC, p_BC, R_WC, p_WC)
            solved[i] = store_line(form, nd[:3], nd[3:], R_WC, z[i, f], values[i])


@inner
def plane_variance(ends, sigma):
    """Variance (rad^2) of a segment's plane about its bearing; ends (2, 2), normalised, with noise sigma (2,)."""
    a, b = ends[0], ends[1]
    return (sigma[0] ** 2 + sigma[1] ** 2) / ((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2)


@inner
def has_parallax(normals, noise2, views, min_sine):
    """Whether two of the unit normals (views, 3), blind to their signs, differ by more than min_sine and significantly.

    noise2 (views,): their plane_variance.
    """
    for j in range(views):
        for k in range(j):
            c = normals[j, 0] * normals[k, 0] + normals[j, 1] * normals[k, 1] + normals[j, 2] * normals[k, 2]
            sine2 = 1.0 - c * c
            if sine2 >= min_sine * min_sine and sine2 >= SIGNIFICANT**2 * (noise2[j] + noise2[k]):
                return True
    return False


@inner
def _line_through(A, B, nd):
    """Points A, B (4,) -> nd (6,) = [n, d]; False without direction or, as no camera sees it, through the origin."""
    nd[0], nd[1], nd[2] = A[1] * B[2] - A[2] * B[1], A[2] * B[0] - A[0] * B[2], A[0] * B[1] - A[1] * B[0]
    nd[3], nd[4], nd[5] = A[3] * B[0] - B[3] * A[0], A[3] * B[1] - B[3] * A[1], A[3] * B[2] - B[3] * A[2]
    nn = np.sqrt(nd[0] * nd[0] + nd[1] * nd[1] + nd[2] * nd[2])
    dd = np.sqrt(nd[3] * nd[3] + nd[4] * nd[4] + nd[5] * nd[5])
    return dd > 1e-9 and nn > 1e-6 * dd


@inner
def _in_front(n, R, p, R_BC, p_BC, seen, z, nd, origin):
    """Whether every view sees the feet of its observed ends on line nd (6,) about the origin at positive depth."""
    R_WC, p_WC, n_C, d_C = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    n_O, d_W = nd[:3], nd[3:]
    for f in range(n):
        if not seen[f]:
            continue
        camera_pose(R[f], p[f], R_BC, p_BC, R_WC, p_WC)
        t0, t1, t2 = p_WC[0] - origin[0], p_WC[1] - origin[1], p_WC[2] - origin[2]
        h0, h1 = n_O[0] - (t1 * d_W[2] - t2 * d_W[1]), n_O[1] - (t2 * d_W[0] - t0 * d_W[2])
        h2 = n_O[2] - (t0 * d_W[1] - t1 * d_W[0])
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
            if not z_foot > NEAREST:
                return False
    return True


@kernel
def lines_in_cameras(n, R, p, R_BC, p_BC, solved, seen, form, values, origin, inside):
    """Mark in inside (M,) the solved lines that are nearer than NEAREST to a camera that saw them.

    Every segment agrees with a line through the camera's centre, so a line with little parallax can fall into it, and
    seems more and more certain the nearer it comes.
    """
    R_WC, p_WC, n_W, d_W, J = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty((6, 4))
    for i in range(len(solved)):
        if not solved[i]:
            continue
        world_line(form, values[i], origin[i], n_W, d_W, J)
        length2 = d_W[0] ** 2 + d_W[1] ** 2 + d_W[2] ** 2
        for f in range(n):
            if not seen[i, f]:
                continue
            camera_pose(R[f], p[f], R_BC, p_BC, R_WC, p_WC)
            m0 = n_W[0] - (p_WC[1] * d_W[2] - p_WC[2] * d_W[1])
            m1 = n_W[1] - (p_WC[2] * d_W[0] - p_WC[0] * d_W[2])
            m2 = n_W[2] - (p_WC[0] * d_W[1] - p_WC[1] * d_W[0])
            if not m0 * m0 + m1 * m1 + m2 * m2 > NEAREST * NEAREST * length2:
                inside[i] = True
