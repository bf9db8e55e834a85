"""The forms in which a line is estimated, behind one interface, compiled: evaluate, move, store.

A line is kept as VALUES numbers about a constant origin (the centre of the camera that saw it first), and moved by a
step of 4 or 2 numbers. All forms give the same world line (n, d) and its tangent, so one residual serves them all:

    form              values                 step                          line about the origin
    orthonormal       U row by row, phi      [dtheta, dphi], U Exp(dtheta)  n = cos(phi) u1, d = sin(phi) u2
    orthonormal_left  U row by row, phi      [dtheta, dphi], Exp(dtheta) U  the same
    pluecker          n, d                   as orthonormal                 L / |L|
    orth4             ax, ay, az, phi        as orthonormal                 U = Rz(az) Ry(ay) Rx(ax)
    host              R_WL row by row,       [dtheta, drho]                 n = -cos(theta) z,
                      theta, rho                                            d = rho (cos(theta) x + sin(theta) y)
    host_free         as host                [dtheta, drho, tilt_x, tilt_y] the same, R_WL Exp([tilt_x, tilt_y, 0])

with [x, y, z] the columns of R_WL: y the host's bearing of the segment's middle, z the normal of its observation
plane. What a form cannot hold is refused by store_line, or NaN after move_line. The formulas are those of
geometry/orthonormal.py and geometry/host_line.py.
"""
import numpy as np

from line_slam_ros.geometry.lie_kernels import retract_rotation
from line_slam_ros.kernel_cache import inner, kernel
from line_slam_ros.types import LineForm

VALUES = 11  # numbers that store a line, whatever the form
FURTHEST = 1e4  # m, range at which a host form ends: rho may not become zero or negative
GIMBAL = 1e-6  # cosine of ay, and relative length of n or d, below which orth4 loses digits
LEFT, PLUECKER, ORTH4 = int(LineForm.ORTHONORMAL_LEFT), int(LineForm.PLUECKER), int(LineForm.ORTH4)
HOST, HOST_FREE = int(LineForm.HOST), int(LineForm.HOST_FREE)


@kernel
def freedom(form):
    """Numbers of a step: 2 or 4."""
    return 2 if form == HOST else 4


@kernel
def world_line(form, values, origin_W, n_W, d_W, J):
    """Line n_W (3,), d_W (3,), of any length, of values (VALUES,) about origin_W (3,), and its tangent J (6, 4).

    J is the derivative of [n_W, d_W] by the step of move_line; columns beyond the form's freedom are zero.
    """
    if form == HOST or form == HOST_FREE:
        _host_line(form, values, n_W, d_W, J)
    else:
        U = np.empty((3, 3))
        phi = _frame_of(form, values, U)
        _orthonormal_line(form, U, phi, n_W, d_W, J)
    _move_origin(origin_W, n_W, d_W, J)


@kernel
def move_line(form, values, step, out):
    """out (VALUES,) = values moved by step (4,), of which a form uses the first 2 or all; out may be values."""
    U, turn = np.empty((3, 3)), np.empty(3)
    if form == HOST or form == HOST_FREE:
        theta, rho = values[9] + step[0], values[10] + step[1]
        _read(values, U)
        if form == HOST_FREE:
            turn[0], turn[1], turn[2] = step[2], step[3], 0.0
            retract_rotation(U, turn, U)
        _write(U, out)
        wrapped = (theta + np.pi) % (2.0 * np.pi) - np.pi
        out[9] = wrapped if wrapped < np.pi else -np.pi  # rounding may end at pi
        out[10] = max(rho, 0.2 * values[10], 1.0 / FURTHEST)  # nearer to infinity by a factor of five at most
        return
    phi = _frame_of(form, values, U)
    for i in range(3):
        turn[i] = step[i]
        if form == LEFT:  # Exp(a) U = U Exp(U' a)
            turn[i] = U[0, i] * step[0] + U[1, i] * step[1] + U[2, i] * step[2]
    retract_rotation(U, turn, U)
    _keep_frame(form, U, phi + step[3], out)


@kernel
def store_line(form, n, d, R_WH, ends_H, values):
    """Line n (3,), d (3,) about the origin, axes of W, to values (VALUES,).

    R_WH (3, 3) and ends_H (2, 2): rotation of the host camera, which stands in the origin, and the segment it saw,
    normalised. A host form takes the nearest line in its plane. False where the form cannot hold the line:
    no direction; orth4: n or d nearly nothing, n nearly parallel to z; host: behind the camera or along its ray.
    """
    U = np.empty((3, 3))
    if form == HOST or form == HOST_FREE:
        return _pin_to_host(n, d, R_WH, ends_H, U, values)
    if not d[0] * d[0] + d[1] * d[1] + d[2] * d[2] > 0.0:
        return False
    _keep_frame(form, U, frame_of_line(n, d, U), values)
    return not np.isnan(values[0])


@kernel
def store_lines(form, pluecker, R_WH, ends_H, values, ok):
    """store_line for pluecker (L, 6), R_WH (L, 3, 3), ends_H (L, 2, 2): fills values (L, VALUES) and ok (L,)."""
    for i in range(len(pluecker)):
        ok[i] = store_line(form, pluecker[i, :3], pluecker[i, 3:], R_WH[i], ends_H[i], values[i])


@inner
def unit_world_line(form, values, origin_W, L, J):
    """L (6,) = [n_W, d_W] with |d_W| = 1 and its tangent J (6, 4): (dL - L (d . dd) / |d|^2) / |d|."""
    world_line(form, values, origin_W, L[:3], L[3:], J)
    length = np.sqrt(L[3] * L[3] + L[4] * L[4] + L[5] * L[5])
    for i in range(6):
        L[i] /= length
    for j in range(4):
        along = L[3] * J[3, j] + L[4] * J[4, j] + L[5] * J[5, j]
        for i in range(6):
            J[i, j] = (J[i, j] - L[i] * along) / length


@kernel
def unit_world_lines(form, values, origin_W):
    """Of values (L, VALUES), origin_W (L, 3): pluecker (L, 6) with |d| = 1 and tangents (L, 6, 4)."""
    L, J = np.empty((len(values), 6)), np.empty((len(values), 6, 4))
    for i in range(len(values)):
        unit_world_line(form, values[i], origin_W[i], L[i], J[i])
    return L, J


@kernel
def frame_of_line(n, d, U):
    """U (3, 3) of a line and phi, as orthonormal_from_pluecker: the longer of n, d keeps its direction."""
    nn, dd = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    by_n = nn >= dd
    long, short, first, second = (n, d, 0, 1) if by_n else (d, n, 1, 0)
    scale = 1.0 / max(nn, dd)
    a0, a1, a2 = long[0] * scale, long[1] * scale, long[2] * scale
    along = (short[0] * a0 + short[1] * a1 + short[2] * a2) * scale
    b0, b1, b2 = short[0] * scale - along * a0, short[1] * scale - along * a1, short[2] * scale - along * a2
    length = np.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
    if not length > 1e-15:  # any direction at right angles does
        x, y, z = abs(a0), abs(a1), abs(a2)
        e0, e1, e2 = 1.0 * (x <= y and x <= z), 1.0 * (y < x and y <= z), 1.0 * (z < x and z < y)
        b0, b1, b2 = a1 * e2 - a2 * e1, a2 * e0 - a0 * e2, a0 * e1 - a1 * e0
        length = np.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
    U[0, first], U[1, first], U[2, first] = a0, a1, a2
    U[0, second], U[1, second], U[2, second] = b0 / length, b1 / length, b2 / length
    _cross_columns(U)
    return np.arctan2(dd, nn)


@inner
def _frame_of(form, values, U):
    """U (3, 3) and phi of the forms that are kinds of the orthonormal one."""
    if form == PLUECKER:
        return frame_of_line(values[:3], values[3:6], U)
    if form != ORTH4:
        _read(values, U)
        return values[9]
    s1, s2, s3 = np.sin(values[0]), np.sin(values[1]), np.sin(values[2])
    c1, c2, c3 = np.cos(values[0]), np.cos(values[1]), np.cos(values[2])
    U[0, 0], U[0, 1] = c3 * c2, c3 * s2 * s1 - s3 * c1
    U[1, 0], U[1, 1] = s3 * c2, s3 * s2 * s1 + c3 * c1
    U[2, 0], U[2, 1] = -s2, c2 * s1
    _cross_columns(U)
    return values[3]


@inner
def _keep_frame(form, U, phi, values):
    """The reverse of _frame_of; values NaN where orth4 is singular."""
    values[:] = 0.0
    if form == PLUECKER:
        for i in range(3):
            values[i], values[3 + i] = np.cos(phi) * U[i, 0], np.sin(phi) * U[i, 1]
    elif form == ORTH4:
        cosine = np.hypot(U[0, 0], U[1, 0])
        values[0], values[1] = np.arctan2(U[2, 1], U[2, 2]), np.arctan2(-U[2, 0], cosine)
        values[2], values[3] = np.arctan2(U[1, 0], U[0, 0]), phi
        if not (cosine > GIMBAL and abs(np.cos(phi)) > GIMBAL and abs(np.sin(phi)) > GIMBAL):
            values[:] = np.nan
    else:
        _write(U, values)
        values[9] = phi


@inner
def _orthonormal_line(form, U, phi, n, d, J):
    """Line and tangent about the origin: columns [0; w2 u3], [-w1 u3; 0], [w1 u2; -w2 u1], [-w2 u1; w1 u2] by the
    right update; by the left one the first three times U'."""
    w1, w2 = np.cos(phi), np.sin(phi)
    for i in range(3):
        n[i], d[i] = w1 * U[i, 0], w2 * U[i, 1]
        J[i, 0], J[3 + i, 0] = 0.0, w2 * U[i, 2]
        J[i, 1], J[3 + i, 1] = -w1 * U[i, 2], 0.0
        J[i, 2], J[3 + i, 2] = w1 * U[i, 1], -w2 * U[i, 0]
        J[i, 3], J[3 + i, 3] = -w2 * U[i, 0], w1 * U[i, 1]
    if form == LEFT:
        for i in range(6):
            a, b, c = J[i, 0], J[i, 1], J[i, 2]
            for j in range(3):
                J[i, j] = a * U[j, 0] + b * U[j, 1] + c * U[j, 2]


@inner
def _host_line(form, values, n, d, J):
    """Line and tangent about the host's centre; the plane's tilts turn z about x and y."""
    c, s, rho = np.cos(values[9]), np.sin(values[9]), values[10]
    free = 1.0 if form == HOST_FREE else 0.0
    for i in range(3):
        x, y, z = values[3 * i], values[3 * i + 1], values[3 * i + 2]
        n[i], d[i] = -c * z, rho * (c * x + s * y)
        J[i, 0], J[3 + i, 0] = s * z, rho * (c * y - s * x)
        J[i, 1], J[3 + i, 1] = 0.0, c * x + s * y
        J[i, 2], J[3 + i, 2] = free * c * y, free * rho * s * z
        J[i, 3], J[3 + i, 3] = -free * c * x, -free * rho * c * z


@inner
def _pin_to_host(n, d, R_WH, ends, U, values):
    """Nearest line in the host's observation plane: rho = |y x d|^2 / ((y x d) . n) is the exact inverse range at
    which the bearing y passes the line. False when that is not in front."""
    q0, q1 = ends[0, 1] - ends[1, 1], ends[1, 0] - ends[0, 0]
    q2 = ends[0, 0] * ends[1, 1] - ends[0, 1] * ends[1, 0]
    m0, m1 = 0.5 * (ends[0, 0] + ends[1, 0]), 0.5 * (ends[0, 1] + ends[1, 1])
    nq, nm = 1.0 / np.sqrt(q0 * q0 + q1 * q1 + q2 * q2), 1.0 / np.sqrt(m0 * m0 + m1 * m1 + 1.0)
    for i in range(3):
        U[i, 1] = nm * (R_WH[i, 0] * m0 + R_WH[i, 1] * m1 + R_WH[i, 2])
        U[i, 2] = nq * (R_WH[i, 0] * q0 + R_WH[i, 1] * q1 + R_WH[i, 2] * q2)
    by_x, by_y, square, along = 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        U[i, 0] = U[j, 1] * U[k, 2] - U[k, 1] * U[j, 2]
        c = U[j, 1] * d[k] - U[k, 1] * d[j]
        by_x += d[i] * U[i, 0]
        by_y += d[i] * U[i, 1]
        square += c * c
        along += c * n[i]
    _write(U, values)
    values[9], values[10] = np.arctan2(by_y, by_x), square / along
    return along > 0.0 and values[10] > 1.0 / FURTHEST


@inner
def _read(values, U):
    """U (3, 3) of the first nine values."""
    for i in range(3):
        for j in range(3):
            U[i, j] = values[3 * i + j]


@inner
def _write(U, values):
    """The first nine values of U (3, 3)."""
    for i in range(3):
        for j in range(3):
            values[3 * i + j] = U[i, j]


@inner
def _cross_columns(U):
    """u3 = u1 x u2."""
    U[0, 2] = U[1, 0] * U[2, 1] - U[2, 0] * U[1, 1]
    U[1, 2] = U[2, 0] * U[0, 1] - U[0, 0] * U[2, 1]
    U[2, 2] = U[0, 0] * U[1, 1] - U[1, 0] * U[0, 1]


@inner
def _move_origin(origin_W, n_W, d_W, J):
    """(n, d) about origin_W to (n, d) about W's origin, with the tangent: n += origin x d."""
    o0, o1, o2 = origin_W[0], origin_W[1], origin_W[2]
    n_W[0] += o1 * d_W[2] - o2 * d_W[1]
    n_W[1] += o2 * d_W[0] - o0 * d_W[2]
    n_W[2] += o0 * d_W[1] - o1 * d_W[0]
    for j in range(4):
        J[0, j] += o1 * J[5, j] - o2 * J[4, j]
        J[1, j] += o2 * J[3, j] - o0 * J[5, j]
        J[2, j] += o0 * J[4, j] - o1 * J[3, j]
