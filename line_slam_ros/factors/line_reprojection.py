"""A segment's reprojection residual and its Jacobians, compiled and allocation free.

Source: distance of the observed ends to the projected line, equations (11) to (17) of the line
document with (15) corrected.
"""
import numpy as np

from line_slam_ros.kernel_cache import inner

NO_IMAGE = 1e-18  # |n_C[:2]|^2 / |d|^2 at and below which a line runs through the optical centre along the axis


@inner(forceinline=True)
def _in_body_and_camera(R_WB, p_WB, R_BC, p_BC, n_W, d_W):
    """(n_B, d_B, n_C) as nine numbers."""
    m0 = n_W[0] - (p_WB[1] * d_W[2] - p_WB[2] * d_W[1])
    m1 = n_W[1] - (p_WB[2] * d_W[0] - p_WB[0] * d_W[2])
    m2 = n_W[2] - (p_WB[0] * d_W[1] - p_WB[1] * d_W[0])
    nb0 = R_WB[0, 0] * m0 + R_WB[1, 0] * m1 + R_WB[2, 0] * m2
    nb1 = R_WB[0, 1] * m0 + R_WB[1, 1] * m1 + R_WB[2, 1] * m2
    nb2 = R_WB[0, 2] * m0 + R_WB[1, 2] * m1 + R_WB[2, 2] * m2
    db0 = R_WB[0, 0] * d_W[0] + R_WB[1, 0] * d_W[1] + R_WB[2, 0] * d_W[2]
    db1 = R_WB[0, 1] * d_W[0] + R_WB[1, 1] * d_W[1] + R_WB[2, 1] * d_W[2]
    db2 = R_WB[0, 2] * d_W[0] + R_WB[1, 2] * d_W[1] + R_WB[2, 2] * d_W[2]
    h0 = nb0 - (p_BC[1] * db2 - p_BC[2] * db1)
    h1 = nb1 - (p_BC[2] * db0 - p_BC[0] * db2)
    h2 = nb2 - (p_BC[0] * db1 - p_BC[1] * db0)
    nc0 = R_BC[0, 0] * h0 + R_BC[1, 0] * h1 + R_BC[2, 0] * h2
    nc1 = R_BC[0, 1] * h0 + R_BC[1, 1] * h1 + R_BC[2, 1] * h2
    nc2 = R_BC[0, 2] * h0 + R_BC[1, 2] * h1 + R_BC[2, 2] * h2
    return nb0, nb1, nb2, db0, db1, db2, nc0, nc1, nc2


@inner(forceinline=True)
def line_residual(R_WB, p_WB, R_BC, p_BC, n_W, d_W, ends, r):
    """line_reprojection without its Jacobians."""
    _, _, _, db0, db1, db2, nc0, nc1, nc2 = _in_body_and_camera(R_WB, p_WB, R_BC, p_BC, n_W, d_W)
    rho2 = nc0 * nc0 + nc1 * nc1
    if not rho2 > NO_IMAGE * (db0 * db0 + db1 * db1 + db2 * db2):
        return False
    inv = 1.0 / np.sqrt(rho2)
    for k in range(2):
        r[k] = (nc0 * ends[k, 0] + nc1 * ends[k, 1] + nc2) * inv
    return True


@inner(forceinline=True)
def line_reprojection(R_WB, p_WB, R_BC, p_BC, n_W, d_W, ends, r, J_pose, J_ext, J_line):
    """Signed distances of the observed ends to the projected 3D line, normalised coordinates.

        (n, d)_B = (R_WB' (n_W - p_WB x d_W), R_WB' d_W),  n_C = R_BC' (n_B - p_BC x d_B)
        r_k = n_C . x_k / |n_C[:2]|                     x_k = (u, v, 1), the k-th end
        dn_C: body rotation R_BC' ([n_B]x - [p_BC]x [d_B]x), body position R_WC' [d_W]x,
              extrinsic [[n_C]x, R_BC' [d_B]x], line [R_WC', -R_WC' [p_WC]x]

    ends (2, 2) -> fills r (2,), J_pose (2, 6), J_ext (2, 6) ([rotation, position]) and
    J_line (2, 6) with respect to (n_W, d_W). Returns False, filling nothing, when the line passes
    the optical centre along the axis and has no image (see NO_IMAGE).
    """
    nb0, nb1, nb2, db0, db1, db2, nc0, nc1, nc2 = _in_body_and_camera(R_WB, p_WB, R_BC, p_BC, n_W, d_W)
    rho2 = nc0 * nc0 + nc1 * nc1
    if not rho2 > NO_IMAGE * (db0 * db0 + db1 * db1 + db2 * db2):
        return False
    inv = 1.0 / np.sqrt(rho2)
    for k in range(2):
        e = (nc0 * ends[k, 0] + nc1 * ends[k, 1] + nc2) * inv
        r[k] = e
        g0, g1, g2 = (ends[k, 0] - e * nc0 * inv) * inv, (ends[k, 1] - e * nc1 * inv) * inv, inv
        a0 = g0 * R_BC[0, 0] + g1 * R_BC[0, 1] + g2 * R_BC[0, 2]  # a = R_BC g: gradient by h in B
        a1 = g0 * R_BC[1, 0] + g1 * R_BC[1, 1] + g2 * R_BC[1, 2]
        a2 = g0 * R_BC[2, 0] + g1 * R_BC[2, 1] + g2 * R_BC[2, 2]
        # a' [n_B]x = (a x n_B)';  a' [p]x [d]x = ((a x p) x d)'
        c0, c1, c2 = a1 * p_BC[2] - a2 * p_BC[1], a2 * p_BC[0] - a0 * p_BC[2], a0 * p_BC[1] - a1 * p_BC[0]
        J_pose[k, 0] = a1 * nb2 - a2 * nb1 - (c1 * db2 - c2 * db1)
        J_pose[k, 1] = a2 * nb0 - a0 * nb2 - (c2 * db0 - c0 * db2)
        J_pose[k, 2] = a0 * nb1 - a1 * nb0 - (c0 * db1 - c1 * db0)
        w0 = R_WB[0, 0] * a0 + R_WB[0, 1] * a1 + R_WB[0, 2] * a2  # gradient by n_W
        w1 = R_WB[1, 0] * a0 + R_WB[1, 1] * a1 + R_WB[1, 2] * a2
        w2 = R_WB[2, 0] * a0 + R_WB[2, 1] * a1 + R_WB[2, 2] * a2
        J_pose[k, 3], J_pose[k, 4], J_pose[k, 5] = (w1 * d_W[2] - w2 * d_W[1], w2 * d_W[0] - w0 * d_W[2],
                                                    w0 * d_W[1] - w1 * d_W[0])
        J_ext[k, 0], J_ext[k, 1], J_ext[k, 2] = g1 * nc2 - g2 * nc1, g2 * nc0 - g0 * nc2, g0 * nc1 - g1 * nc0
        J_ext[k, 3], J_ext[k, 4], J_ext[k, 5] = a1 * db2 - a2 * db1, a2 * db0 - a0 * db2, a0 * db1 - a1 * db0
        # p_WC = p_WB + R_WB p_BC; dn_W = -p_WC x dd: gradient by d_W is p_WC x w, here in two parts
        q0 = p_WB[0] + R_WB[0, 0] * p_BC[0] + R_WB[0, 1] * p_BC[1] + R_WB[0, 2] * p_BC[2]
        q1 = p_WB[1] + R_WB[1, 0] * p_BC[0] + R_WB[1, 1] * p_BC[1] + R_WB[1, 2] * p_BC[2]
        q2 = p_WB[2] + R_WB[2, 0] * p_BC[0] + R_WB[2, 1] * p_BC[1] + R_WB[2, 2] * p_BC[2]
        J_line[k, 0], J_line[k, 1], J_line[k, 2] = w0, w1, w2
        J_line[k, 3], J_line[k, 4], J_line[k, 5] = q1 * w2 - q2 * w1, q2 * w0 - q0 * w2, q0 * w1 - q1 * w0
    return True
