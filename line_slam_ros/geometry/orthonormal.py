"""Four numbers for the four degrees of freedom of a line: a frame U in SO(3) and an angle phi.

    U = [n/|n|, d/|d|, n x d / |n x d|],   phi = atan2(|d|, |n|),   L = [cos(phi) u1, sin(phi) u2] up to scale

(Bartoli, Sturm 2005, with atan2: acos loses the sign of w1, asin loses n). The update is multiplicative, by
delta = [dtheta, dphi]: right U <- U Exp(dtheta), the package's convention, or left U <- Exp(dtheta) U, both with
phi <- phi + dphi. phi runs on without folding: beyond pi/2 or below 0 it stays the same smooth family of lines.

orth4 = [ax, ay, az, phi] with U = Rz(az) Ry(ay) Rx(ax) is the storage that older line code exchanges: a chart with
singularities, at which these functions raise. Nothing is estimated in it. Leading batch axes everywhere.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from line_slam_ros.geometry.lie import so3_exp
from line_slam_ros.types import F64

SINGULAR = 1e-9  # cosine of ay, or relative length of n or d, at which orth4 is undefined


def orthonormal_from_pluecker(L: ArrayLike) -> tuple[F64, F64]:
    """U (..., 3, 3) and phi (...) of lines (..., 6).

    Where n = 0 (through the origin) or d = 0 (at infinity) its axis is any one perpendicular to the other: L does not
    depend on it. The longer one keeps its direction if rounding made n . d differ from 0.
    """
    L = np.asarray(L, float)
    n, d = L[..., :3], L[..., 3:]
    n_length, d_length = (np.linalg.norm(v, axis=-1, keepdims=True) for v in (n, d))
    first, longer = n_length >= d_length, np.maximum(n_length, d_length)
    longer = np.where(longer > 0.0, longer, np.nan)  # six zeros are no line
    u_long = np.where(first, n, d) / longer
    u_short = _perpendicular(np.where(first, d, n) / longer, u_long)
    u_1, u_2 = np.where(first, u_long, u_short), np.where(first, u_short, u_long)
    return np.stack([u_1, u_2, np.cross(u_1, u_2)], axis=-1), np.arctan2(d_length, n_length)[..., 0]


def pluecker_from_orthonormal(U: ArrayLike, phi: ArrayLike) -> F64:
    """Line (..., 6) of norm 1."""
    U, phi = np.asarray(U, float), np.asarray(phi, float)[..., None]
    return np.concatenate([np.cos(phi) * U[..., :, 0], np.sin(phi) * U[..., :, 1]], axis=-1)


def plus_right(U: ArrayLike, phi: ArrayLike, delta: ArrayLike) -> tuple[F64, F64]:
    """(U Exp(dtheta), phi + dphi); delta (..., 4)."""
    delta = np.asarray(delta, float)
    return _back_on_so3(np.asarray(U, float) @ so3_exp(delta[..., :3])), np.asarray(phi, float) + delta[..., 3]


def plus_left(U: ArrayLike, phi: ArrayLike, delta: ArrayLike) -> tuple[F64, F64]:
    """(Exp(dtheta) U, phi + dphi); delta (..., 4)."""
    delta = np.asarray(delta, float)
    return _back_on_so3(so3_exp(delta[..., :3]) @ np.asarray(U, float)), np.asarray(phi, float) + delta[..., 3]


def jacobian_right(U: ArrayLike, phi: ArrayLike) -> F64:
    """Derivative (..., 6, 4) of pluecker_from_orthonormal by delta of plus_right, at delta = 0."""
    U, phi = np.asarray(U, float), np.asarray(phi, float)
    u_1, u_2, u_3 = np.moveaxis(U, -1, 0)
    w_1, w_2 = np.cos(phi)[..., None], np.sin(phi)[..., None]
    J = np.zeros((*U.shape[:-2], 6, 4))
    J[..., 3:, 0] = w_2 * u_3
    J[..., :3, 1] = -w_1 * u_3
    J[..., :3, 2], J[..., 3:, 2] = w_1 * u_2, -w_2 * u_1
    J[..., :3, 3], J[..., 3:, 3] = -w_2 * u_1, w_1 * u_2
    return J


def jacobian_left(U: ArrayLike, phi: ArrayLike) -> F64:
    """The same by delta of plus_left: rotation columns of jacobian_right times U', since Exp(a) U = U Exp(U' a)."""
    J = jacobian_right(U, phi)
    J[..., :3] = J[..., :3] @ np.swapaxes(np.asarray(U, float), -1, -2)
    return J


def orth4_from_pluecker(L: ArrayLike) -> F64:
    """Lines (..., 6) to orth4 (..., 4). Raises ValueError where orth4 cannot hold the line."""
    U, phi = orthonormal_from_pluecker(L)
    if not np.all((np.cos(phi) > SINGULAR) & (np.sin(phi) > SINGULAR)):
        raise ValueError('orth4 needs a line neither through the origin (n = 0) nor at infinity (d = 0): '
                         f'phi = {phi}; use (U, phi)')
    return orth4_from_orthonormal(U, phi)


def orth4_from_orthonormal(U: ArrayLike, phi: ArrayLike) -> F64:
    """(U, phi) to orth4 (..., 4). Raises ValueError at gimbal lock: n parallel to z, as of lines in the plane z = 0."""
    U = np.asarray(U, float)
    cosine = np.hypot(U[..., 0, 0], U[..., 1, 0])
    if not np.all(cosine > SINGULAR):
        raise ValueError(f'orth4 has no angles for n parallel to z: cos(ay) = {cosine}; use (U, phi)')
    return np.stack([np.arctan2(U[..., 2, 1], U[..., 2, 2]), np.arctan2(-U[..., 2, 0], cosine),
                     np.arctan2(U[..., 1, 0], U[..., 0, 0]), np.broadcast_to(phi, cosine.shape)], axis=-1)


def orthonormal_from_orth4(orth4: ArrayLike) -> tuple[F64, F64]:
    """orth4 (..., 4) to U (..., 3, 3) and phi (...)."""
    orth4 = np.asarray(orth4, float)
    about_x, about_y, about_z = (so3_exp(orth4[..., k, None] * np.eye(3)[k]) for k in range(3))
    return about_z @ about_y @ about_x, orth4[..., 3]


def orth4_plus(orth4: ArrayLike, delta: ArrayLike) -> F64:
    """plus_right in orth4 (..., 4), by way of (U, phi). Raises ValueError at gimbal lock."""
    return orth4_from_orthonormal(*plus_right(*orthonormal_from_orth4(orth4), delta))


def orth4_plus_jacobian(orth4: ArrayLike) -> F64:
    """Derivative (..., 4, 4) of orth4_plus by delta at delta = 0. Raises ValueError at gimbal lock.

    For derivatives by the four ambient numbers only: those of jacobian_right are by delta already.
    """
    orth4 = np.asarray(orth4, float)
    (s_1, s_2), (c_1, c_2) = np.sin(np.moveaxis(orth4, -1, 0)[:2]), np.cos(np.moveaxis(orth4, -1, 0)[:2])
    if not np.all(np.abs(c_2) > SINGULAR):
        raise ValueError(f'orth4 has no derivative at gimbal lock: ay = {orth4[..., 1]} rad')
    o, one = np.zeros_like(s_1), np.ones_like(s_1)
    return np.stack([one, s_1 * s_2 / c_2, c_1 * s_2 / c_2, o,
                     o, c_1, -s_1, o,
                     o, s_1 / c_2, c_1 / c_2, o,
                     o, o, o, one], axis=-1).reshape(*orth4.shape, 4)


def _perpendicular(wanted: F64, axis: F64) -> F64:
    """Unit vector perpendicular to the unit axis (..., 3), along wanted where that says anything."""
    wanted = wanted - np.sum(wanted * axis, axis=-1, keepdims=True) * axis
    length = np.linalg.norm(wanted, axis=-1, keepdims=True)
    least = np.eye(3)[np.argmin(np.abs(axis), axis=-1)]
    other = np.cross(axis, least)
    says = length > 1e-15
    return np.where(says, wanted / np.where(says, length, 1.0), other / np.linalg.norm(other, axis=-1, keepdims=True))


def _back_on_so3(U: F64) -> F64:
    """One Newton step of the polar decomposition: many updates do not drift off SO(3)."""
    return U @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(U, -1, -2) @ U)
