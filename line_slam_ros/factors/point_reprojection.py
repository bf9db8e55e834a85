"""A corner's reprojection residual and its Jacobians, compiled and allocation free."""
from line_slam_ros.kernel_cache import inner

MIN_DEPTH = 1e-3  # m: nearer, or behind, a point has no image


@inner(forceinline=True)
def _in_body_and_camera(R_WB, p_WB, R_BC, p_BC, p_W):
    """(p_B, p_C) as six numbers."""
    d0, d1, d2 = p_W[0] - p_WB[0], p_W[1] - p_WB[1], p_W[2] - p_WB[2]
    b0 = R_WB[0, 0] * d0 + R_WB[1, 0] * d1 + R_WB[2, 0] * d2
    b1 = R_WB[0, 1] * d0 + R_WB[1, 1] * d1 + R_WB[2, 1] * d2
    b2 = R_WB[0, 2] * d0 + R_WB[1, 2] * d1 + R_WB[2, 2] * d2
    e0, e1, e2 = b0 - p_BC[0], b1 - p_BC[1], b2 - p_BC[2]
    c0 = R_BC[0, 0] * e0 + R_BC[1, 0] * e1 + R_BC[2, 0] * e2
    c1 = R_BC[0, 1] * e0 + R_BC[1, 1] * e1 + R_BC[2, 1] * e2
    c2 = R_BC[0, 2] * e0 + R_BC[1, 2] * e1 + R_BC[2, 2] * e2
    return b0, b1, b2, c0, c1, c2


@inner(forceinline=True)
def point_residual(R_WB, p_WB, R_BC, p_BC, p_W, x, r):
    """point_reprojection without its Jacobians."""
    _, _, _, c0, c1, c2 = _in_body_and_camera(R_WB, p_WB, R_BC, p_BC, p_W)
    if not c2 > MIN_DEPTH:
        return False
    r[0], r[1] = c0 / c2 - x[0], c1 / c2 - x[1]
    return True


@inner(forceinline=True)
def point_reprojection(R_WB, p_WB, R_BC, p_BC, p_W, x, r, J_pose, J_ext, J_point):
    """Where a point projects minus where it was seen, normalised coordinates.

        p_B = R_WB' (p_W - p_WB),  p_C = R_BC' (p_B - p_BC),  r = p_C[:2] / p_C[2] - x
        dr/dp_C = D = [[1, 0, -u], [0, 1, -v]] / z,  A = D R_BC'
        body pose [A [p_B]x, -A R_WB'],  extrinsic [D [p_C]x, -A],  point A R_WB'

    x (2,) -> fills r (2,), J_pose (2, 6), J_ext (2, 6) (both [rotation, position]), J_point (2, 3).
    Returns False, filling nothing, for a point that is not in front of the camera (z <= MIN_DEPTH).
    """
    b0, b1, b2, c0, c1, c2 = _in_body_and_camera(R_WB, p_WB, R_BC, p_BC, p_W)
    in_front = c2 > MIN_DEPTH
    if in_front:
        _fill(R_WB, R_BC, b0, b1, b2, c0, c1, c2, x, r, J_pose, J_ext, J_point)
    return in_front


@inner(forceinline=True)
def _fill(R_WB, R_BC, b0, b1, b2, c0, c1, c2, x, r, J_pose, J_ext, J_point):
    """point_reprojection of what is at b in the body, c in the camera. Without branches, so arrays need no counting."""
    iz = 1.0 / c2
    u, v = c0 * iz, c1 * iz
    r[0], r[1] = u - x[0], v - x[1]
    J_ext[0, 0], J_ext[0, 1], J_ext[0, 2] = u * v, -1.0 - u * u, v
    J_ext[1, 0], J_ext[1, 1], J_ext[1, 2] = 1.0 + v * v, -u * v, -u
    for k in range(2):
        s = u if k == 0 else v
        a0 = iz * (R_BC[0, k] - s * R_BC[0, 2])
        a1 = iz * (R_BC[1, k] - s * R_BC[1, 2])
        a2 = iz * (R_BC[2, k] - s * R_BC[2, 2])
        J_pose[k, 0], J_pose[k, 1], J_pose[k, 2] = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        J_ext[k, 3], J_ext[k, 4], J_ext[k, 5] = -a0, -a1, -a2
        for j in range(3):
            J_point[k, j] = a0 * R_WB[j, 0] + a1 * R_WB[j, 1] + a2 * R_WB[j, 2]
            J_pose[k, 3 + j] = -J_point[k, j]


@inner
def inverse_depth_point(R_WA, p_WA, abr, p_W, J):
    """World point of anchored inverse depth coordinates (a, b, rho): p_W = R_WA (a, b, 1) / rho + p_WA.

    The anchor is a constant chart, not a variable, so J (3, 3) = dp_W / d(a, b, rho) is all there is.
    Inverse depth keeps the residual near linear for far and freshly seen points (Civera et al. 2008).
    """
    inv = 1.0 / abr[2]
    x, y = abr[0] * inv, abr[1] * inv
    for i in range(3):
        q = R_WA[i, 0] * x + R_WA[i, 1] * y + R_WA[i, 2] * inv
        p_W[i] = q + p_WA[i]
        J[i, 0], J[i, 1], J[i, 2] = R_WA[i, 0] * inv, R_WA[i, 1] * inv, -q * inv
