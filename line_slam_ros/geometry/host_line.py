"""Two numbers for a line that is pinned to the plane in which its first (host) camera H saw it.

The local frame of the host observation has y along the ray through the middle of the segment, z normal to the
observation plane and x = y x z. With the inverse RANGE rho (1/m) along y and the angle theta of the direction,

    d = cos(theta) x + sin(theta) y,   L_H = [y / rho x d, d] = [-cos(theta) z, rho d] up to scale, also for rho = 0

The host's own reprojection residual of this line is identically zero, and the noise of the host segment never
averages out: the four-parameter form (orthonormal.py) is the better estimator when views are many.

rho_theta is (..., 2), R_HL (..., 3, 3) holds [x, y, z] as columns, leading batch axes everywhere.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from line_slam_ros.types import F64


def host_frame(ends: ArrayLike) -> F64:
    """R_HL (..., 3, 3) in SO(3) of observed segment ends (..., 2, 2), normalised; NaN where both ends are the same."""
    ends = np.asarray(ends, float)
    first, second = np.moveaxis(np.concatenate([ends, np.ones((*ends.shape[:-1], 1))], axis=-1), -2, 0)
    y, z = _unit(first + second), _unit(np.cross(first, second))
    return np.stack([np.cross(y, z), y, z], axis=-1)


def rho_theta_from_pluecker(L_H: ArrayLike, R_HL: ArrayLike) -> F64:
    """Exact rho = |y x d|^2 / (y x d . n) and theta of lines L_H (..., 6) in the host plane, otherwise of their
    projection on it; rho is infinite for a line through the host's optical centre."""
    L_H = np.asarray(L_H, float)
    x, y, _ = np.moveaxis(np.asarray(R_HL, float), -1, 0)
    n, d = L_H[..., :3], L_H[..., 3:]
    lever = np.cross(y, d)
    with np.errstate(divide='ignore', invalid='ignore'):
        rho = np.sum(lever * lever, axis=-1) / np.sum(lever * n, axis=-1)
    return np.stack([rho, np.arctan2(np.sum(d * y, axis=-1), np.sum(d * x, axis=-1))], axis=-1)


def pluecker_from_rho_theta(rho_theta: ArrayLike, R_HL: ArrayLike) -> F64:
    """Line L_H (..., 6) in the host camera."""
    rho, cosine, sine = _parts(rho_theta)
    x, y, z = np.moveaxis(np.asarray(R_HL, float), -1, 0)
    return np.concatenate([-cosine * z, rho * (cosine * x + sine * y)], axis=-1)


def jacobian(rho_theta: ArrayLike, R_HL: ArrayLike) -> F64:
    """Derivative (..., 6, 2) of pluecker_from_rho_theta by [rho, theta]."""
    rho, cosine, sine = _parts(rho_theta)
    x, y, z = np.moveaxis(np.asarray(R_HL, float), -1, 0)
    by_rho = np.concatenate([np.zeros_like(z), cosine * x + sine * y], axis=-1)
    by_theta = np.concatenate([sine * z, rho * (cosine * y - sine * x)], axis=-1)
    return np.stack(np.broadcast_arrays(by_rho, by_theta), axis=-1)


def plus(rho_theta: ArrayLike, delta: ArrayLike) -> F64:
    """rho_theta + delta (..., 2) with theta wrapped into [-pi, pi)."""
    rho, theta = np.moveaxis(np.add(rho_theta, delta), -1, 0)
    wrapped = (theta + np.pi) % (2.0 * np.pi) - np.pi
    return np.stack([rho, np.where(wrapped < np.pi, wrapped, -np.pi)], axis=-1)  # rounding may end at pi


def _parts(rho_theta: ArrayLike) -> tuple[F64, F64, F64]:
    """rho, cos(theta), sin(theta), (..., 1) each."""
    rho_theta = np.asarray(rho_theta, float)
    return rho_theta[..., :1], np.cos(rho_theta[..., 1:]), np.sin(rho_theta[..., 1:])


def _unit(v: F64) -> F64:
    """v (..., 3) of length 1; NaN for zero."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(length > 0.0, length, np.nan)
