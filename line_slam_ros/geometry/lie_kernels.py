"""SO(3) for compiled loops: one rotation at a time, results written into the caller's buffers.

Same conventions as lie.py (right perturbation). Nothing here allocates.
"""
import numpy as np

from line_slam_ros.kernel_cache import inner, kernel


@kernel
def exp_so3(w, R):
    """Rotation vector w (3,) -> R (3, 3): Rodrigues, Taylor below 1e-4 rad."""
    x, y, z = w[0], w[1], w[2]
    a2 = x * x + y * y + z * z
    if a2 < 1e-8:
        s, c = 1.0 - a2 / 6.0, 0.5 - a2 / 24.0
    else:
        a = np.sqrt(a2)
        s, c = np.sin(a) / a, (1.0 - np.cos(a)) / a2
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
    R[1, 0], R[1, 1], R[1, 2] = c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x
    R[2, 0], R[2, 1], R[2, 2] = c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)


@kernel
def log_so3(R, w):
    """R (3, 3) -> rotation vector w (3,), |w| <= pi, through the quaternion of largest component."""
    t = R[0, 0] + R[1, 1] + R[2, 2]
    if t > 0.0:
        q3 = np.sqrt(t + 1.0) * 0.5
        k = 0.25 / q3
        q0, q1, q2 = (R[2, 1] - R[1, 2]) * k, (R[0, 2] - R[2, 0]) * k, (R[1, 0] - R[0, 1]) * k
    elif R[0, 0] >= R[1, 1] and R[0, 0] >= R[2, 2]:
        q0 = np.sqrt(1.0 + R[0, 0] - R[1, 1] - R[2, 2]) * 0.5
        k = 0.25 / q0
        q1, q2, q3 = (R[0, 1] + R[1, 0]) * k, (R[0, 2] + R[2, 0]) * k, (R[2, 1] - R[1, 2]) * k
    elif R[1, 1] >= R[2, 2]:
        q1 = np.sqrt(1.0 - R[0, 0] + R[1, 1] - R[2, 2]) * 0.5
        k = 0.25 / q1
        q0, q2, q3 = (R[0, 1] + R[1, 0]) * k, (R[1, 2] + R[2, 1]) * k, (R[0, 2] - R[2, 0]) * k
    else:
        q2 = np.sqrt(1.0 - R[0, 0] - R[1, 1] + R[2, 2]) * 0.5
        k = 0.25 / q2
        q0, q1, q3 = (R[0, 2] + R[2, 0]) * k, (R[1, 2] + R[2, 1]) * k, (R[1, 0] - R[0, 1]) * k
    if q3 < 0.0:
        q0, q1, q2, q3 = -q0, -q1, -q2, -q3
    n = np.sqrt(q0 * q0 + q1 * q1 + q2 * q2)
    k = 2.0 if n < 1e-12 else 2.0 * np.arctan2(n, q3) / n
    w[0], w[1], w[2] = k * q0, k * q1, k * q2


@inner
def _write_jacobian(w, a, b, J):
    """J = I + a [w]x + b [w]x^2."""
    x, y, z = w[0], w[1], w[2]
    J[0, 0], J[0, 1], J[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    J[1, 0], J[1, 1], J[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    J[2, 0], J[2, 1], J[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)


@kernel
def right_jacobian(w, J):
    """J_r (3, 3): Exp(w + d) = Exp(w) Exp(J_r d)."""
    a2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if a2 < 1e-8:
        _write_jacobian(w, -0.5 + a2 / 24.0, 1.0 / 6.0 - a2 / 120.0, J)
    else:
        a = np.sqrt(a2)
        _write_jacobian(w, -(1.0 - np.cos(a)) / a2, (a - np.sin(a)) / (a2 * a), J)


@kernel
def right_jacobian_inverse(w, J):
    """J_r^-1 (3, 3): Log(Exp(w) Exp(d)) = w + J_r^-1 d."""
    a2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if a2 < 1e-8:
        _write_jacobian(w, 0.5, 1.0 / 12.0 + a2 / 720.0, J)
    else:
        a = np.sqrt(a2)
        _write_jacobian(w, 0.5, 1.0 / a2 - 0.5 / (a * np.tan(0.5 * a)), J)


@kernel
def multiply(A, B, C):
    """C = A B for 3x3; C must be another buffer."""
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@kernel
def multiply_transposed(A, B, C):
    """C = A^T B for 3x3; C must be another buffer."""
    for i in range(3):
        for j in range(3):
            C[i, j] = A[0, i] * B[0, j] + A[1, i] * B[1, j] + A[2, i] * B[2, j]


@kernel
def retract_rotation(R, d, out):
    """out = R Exp(d), put back on SO(3) by one Gram-Schmidt pass; out may be R. Nothing drifts over long runs."""
    E, C = np.empty((3, 3)), np.empty((3, 3))
    exp_so3(d, E)
    multiply(R, E, C)
    n = 1.0 / np.sqrt(C[0, 0] ** 2 + C[1, 0] ** 2 + C[2, 0] ** 2)
    x0, x1, x2 = C[0, 0] * n, C[1, 0] * n, C[2, 0] * n
    k = x0 * C[0, 1] + x1 * C[1, 1] + x2 * C[2, 1]
    y0, y1, y2 = C[0, 1] - k * x0, C[1, 1] - k * x1, C[2, 1] - k * x2
    n = 1.0 / np.sqrt(y0 * y0 + y1 * y1 + y2 * y2)
    y0, y1, y2 = y0 * n, y1 * n, y2 * n
    out[0, 0], out[1, 0], out[2, 0] = x0, x1, x2
    out[0, 1], out[1, 1], out[2, 1] = y0, y1, y2
    out[0, 2], out[1, 2], out[2, 2] = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
