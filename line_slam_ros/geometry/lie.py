"""Rotations and rigid transforms on arrays: every function accepts leading batch axes.

The perturbation convention of the whole package is stated here, once: on the right of a rotation, additive on a
position in the parent frame,

    R_AB <- R_AB Exp(dtheta),    p_AB <- p_AB + dp,    delta = [dtheta, dp]  (rotation first)

so an uncertainty of orientation is expressed in the child frame, one of position in the parent frame. Angles are in
radians, quaternions are [x, y, z, w] of unit length, ``T_AB`` (4, 4) maps coordinates in B to A.

Formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendix B.
"""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from line_slam_ros.types import F64


def hat(w: ArrayLike) -> F64:
    """Matrix of the cross product, (..., 3) to (..., 3, 3): hat(a) @ b == cross(a, b)."""
    w = np.asarray(w, float)
    W = np.zeros((*w.shape, 3))
    W[..., 2, 1], W[..., 0, 2], W[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    return W - np.swapaxes(W, -1, -2)


def so3_exp(w: ArrayLike) -> F64:
    """Rotation vector (..., 3) to matrix (..., 3, 3); Rodrigues in the sinc form, exact down to zero."""
    angle, W = _angle_and_hat(w)
    return np.eye(3) + np.sinc(angle / np.pi) * W + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * (W @ W)


def so3_log(R: ArrayLike) -> F64:
    """Rotation matrix (..., 3, 3) to the rotation vector (..., 3) with norm in [0, pi].

    By way of the quaternion, so accurate near zero and near pi; at pi exactly either of the two signs is right.
    """
    q_xyzw = quaternion_from_matrix(R)
    sine, cosine = np.linalg.norm(q_xyzw[..., :3], axis=-1), q_xyzw[..., 3]
    scale = np.where(sine > 0.0, 2.0 * np.arctan2(sine, cosine) / np.where(sine > 0.0, sine, 1.0), 2.0)
    return scale[..., None] * q_xyzw[..., :3]


def right_jacobian(w: ArrayLike) -> F64:
    """Jr (..., 3, 3) of a rotation vector: Exp(w + d) = Exp(w) Exp(Jr(w) d) to first order."""
    angle, W = _angle_and_hat(w)
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    cubic = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) - 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * W + cubic * (W @ W)


def right_jacobian_inverse(w: ArrayLike) -> F64:
    """Inverse of right_jacobian (..., 3, 3): Log(Exp(w) Exp(d)) = w + Jr^-1(w) d to first order; singular at 2 pi."""
    angle, W = _angle_and_hat(w)
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    square = np.where(small, 1.0 / 12.0 + angle**2 / 720.0, 1.0 / safe**2 - 0.5 / (safe * np.tan(0.5 * safe)))
    return np.eye(3) + 0.5 * W + square * (W @ W)


def matrix_from_quaternion(q_xyzw: ArrayLike) -> F64:
    """Quaternion (..., 4) of any length but zero to its rotation matrix (..., 3, 3)."""
    q = np.asarray(q_xyzw, float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    Q = hat(q[..., :3])
    return np.eye(3) + 2.0 * q[..., 3, None, None] * Q + 2.0 * (Q @ Q)


def quaternion_from_matrix(R: ArrayLike) -> F64:
    """Rotation matrix (..., 3, 3) to the unit quaternion (..., 4) in xyzw with w >= 0.

    The matrix gives all products 4 q_i q_j; the column of the largest square is q up to scale (Shepperd, 1978).
    """
    R = np.asarray(R, float)
    return np.array([_quaternion(one) for one in R.reshape(-1, 3, 3).tolist()]).reshape(*R.shape[:-2], 4)


def _quaternion(R: list[list[float]]) -> list[float]:
    """Of one matrix. On numbers: arrays as small as this take NumPy longer."""
    trace = R[0][0] + R[1][1] + R[2][2]
    largest, square = 3, 1.0 + trace
    for k in range(2, -1, -1):
        if 2.0 * R[k][k] + (1.0 - trace) >= square:
            largest, square = k, 2.0 * R[k][k] + (1.0 - trace)
    skew = [R[2][1] - R[1][2], R[0][2] - R[2][0], R[1][0] - R[0][1]]
    if largest == 3:
        x, y, z, w = *skew, square
    else:
        x, y, z = (square if k == largest else R[k][largest] + R[largest][k] for k in range(3))
        w = skew[largest]
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return [(-c if w < 0.0 else c) / norm for c in (x, y, z, w)]


def rigid(R_AB: ArrayLike, p_AB: ArrayLike) -> F64:
    """Rotation (..., 3, 3) and position (..., 3) to T_AB (..., 4, 4)."""
    R_AB, p_AB = np.asarray(R_AB, float), np.asarray(p_AB, float)
    T_AB = np.zeros((*np.broadcast_shapes(R_AB.shape[:-2], p_AB.shape[:-1]), 4, 4))
    T_AB[..., :3, :3], T_AB[..., :3, 3], T_AB[..., 3, 3] = R_AB, p_AB, 1.0
    return T_AB


def rigid_inverse(T_AB: ArrayLike) -> F64:
    """T_BA (..., 4, 4), exact for a rotation that is orthogonal to rounding."""
    T_AB = np.asarray(T_AB, float)
    R_BA = np.swapaxes(T_AB[..., :3, :3], -1, -2)
    return rigid(R_BA, -(R_BA @ T_AB[..., :3, 3:])[..., 0])


def transform_points(T_AB: ArrayLike, p_B: ArrayLike) -> F64:
    """Points (..., N, 3) in B to A; T_AB (..., 4, 4)."""
    T_AB = np.asarray(T_AB, float)
    return np.asarray(p_B, float) @ np.swapaxes(T_AB[..., :3, :3], -1, -2) + T_AB[..., None, :3, 3]


def pose_plus(T_AB: ArrayLike, delta: ArrayLike) -> F64:
    """T_AB (..., 4, 4) moved by delta (..., 6) = [dtheta, dp] in the package's convention."""
    T_AB, delta = np.asarray(T_AB, float), np.asarray(delta, float)
    return rigid(T_AB[..., :3, :3] @ so3_exp(delta[..., :3]), T_AB[..., :3, 3] + delta[..., 3:])


def pose_plus_jacobian(q_xyzw: ArrayLike) -> F64:
    """Derivative (..., 7, 6) of the ambient pose [p, q_xyzw] with respect to delta of pose_plus, at delta = 0.

    For derivatives taken with respect to the seven ambient numbers only: a factor whose Jacobian is already with
    respect to delta must not be multiplied by it.
    """
    q = np.asarray(q_xyzw, float)
    J = np.zeros((*q.shape[:-1], 7, 6))
    J[..., :3, 3:] = np.eye(3)
    J[..., 3:6, :3] = 0.5 * (q[..., 3, None, None] * np.eye(3) + hat(q[..., :3]))
    J[..., 6, :3] = -0.5 * q[..., :3]
    return J


def _angle_and_hat(w: ArrayLike) -> tuple[F64, F64]:
    """Norm (..., 1, 1) and cross product matrix (..., 3, 3) of rotation vectors (..., 3)."""
    return np.linalg.norm(np.asarray(w, float), axis=-1)[..., None, None], hat(w)
