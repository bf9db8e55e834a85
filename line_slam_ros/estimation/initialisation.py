"""From the first frames to states: attitude, velocity, metric scale and gyro bias, from rest or from motion.

At rest gravity and gyro bias are read off the inertial samples. In motion the gyro bias comes first,
as the one whose rotations bring bearings closest to coplanarity (Kneip and Lynen, ICCV 2013; He et al.,
CVPR 2023), then velocity, gravity and the points solve one linear system with |g| known
(Dong-Si and Mourikis, IROS 2012), which the caller refines with all factors.
"""
from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import brentq, least_squares

from line_slam_ros.estimation.shift import matches
from line_slam_ros.geometry.imu import preintegrate
from line_slam_ros.geometry.lie import so3_exp
from line_slam_ros.geometry.lie_kernels import exp_so3, multiply, multiply_transposed
from line_slam_ros.kernel_cache import inner, kernel
from line_slam_ros.types import F64, ImuNoise, Observations, Samples

BIAS_STEP = 1e-4  # rad/s, of the difference quotient


@dataclass(frozen=True, slots=True)
class Snapshot:
    """One frame kept for initialisation."""

    t_ns: int
    observations: Observations
    samples: Samples | None  # t s, gyro, accel since the previous snapshot


@dataclass(frozen=True, slots=True)
class Start:
    """States of the chosen snapshots, W with gravity along -z and its origin at the first."""

    R_WB: F64  # (K, 3, 3)
    p_W: F64  # (K, 3)
    v_W: F64  # (K, 3)
    gyro_bias: F64  # (3,)


def upright(up_B: F64) -> F64:
    """The rotation R_WB without heading that takes the body's up direction (3,) to +z."""
    up = up_B / np.linalg.norm(up_B)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    if sine < 1e-9:
        return np.eye(3) if up[2] > 0.0 else np.diag([1.0, -1.0, -1.0])
    return so3_exp(axis / sine * np.arctan2(sine, up[2]))


def start_in_motion(shots: list[Snapshot], T_BC: F64, noise: ImuNoise, gravity: float) -> Start | None:
    """States of the snapshots from bearings and inertial samples alone; None when the system is singular."""
    links = [_integrate(s.samples, np.zeros(3), noise) for s in shots[1:] if s.samples is not None]
    bias = _gyro_bias(shots, links, T_BC[:3, :3])
    motion = _chain([_integrate(s.samples, bias, noise) for s in shots[1:] if s.samples is not None])
    solved = _velocity_and_gravity(shots, motion, T_BC, gravity)
    if solved is None:
        return None
    v0, g0 = solved
    R_W0 = upright(-g0)
    t = motion.t[:, None]
    p = v0 * t + 0.5 * g0 * t**2 + motion.p
    v = v0 + g0 * t + motion.v
    return Start(R_W0 @ motion.R, p @ R_W0.T, v @ R_W0.T, bias)


@dataclass(frozen=True, slots=True)
class _Motion:
    """Preintegrated motion from the first snapshot to each (K,), free of velocity and gravity."""

    t: F64
    R: F64
    p: F64
    v: F64


def _integrate(samples: Samples, gyro_bias: F64, noise: ImuNoise) -> tuple[float, F64, F64, F64, F64]:
    dR, dp, dv, J, cov = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((9, 6)), np.empty((9, 9))
    var_g, var_a = noise.gyro_density**2, noise.accel_density**2
    dt = preintegrate(*samples, gyro_bias, np.zeros(3), var_g, var_a, dR, dp, dv, J, cov)
    return dt, dR, dp, dv, J


def _chain(links: list[tuple[float, F64, F64, F64, F64]]) -> _Motion:
    t, R, p, v = [0.0], [np.eye(3)], [np.zeros(3)], [np.zeros(3)]
    for dt, dR, dp, dv, _ in links:
        p.append(p[-1] + v[-1] * dt + R[-1] @ dp)
        v.append(v[-1] + R[-1] @ dv)
        R.append(R[-1] @ dR)
        t.append(t[-1] + dt)
    return _Motion(np.array(t), np.array(R), np.array(p), np.array(v))


@inner
def _scatter(x, y, R, n, M):
    """Fill M (3, 3) with the scatter of f x R f' per match, x, y (N, 2); n (3,): work space."""
    M[:] = 0.0
    for k in range(len(x)):
        a0, a1, a2 = x[k, 0], x[k, 1], 1.0
        s = 1.0 / np.sqrt(a0 * a0 + a1 * a1 + 1.0)
        b0 = R[0, 0] * y[k, 0] + R[0, 1] * y[k, 1] + R[0, 2]
        b1 = R[1, 0] * y[k, 0] + R[1, 1] * y[k, 1] + R[1, 2]
        b2 = R[2, 0] * y[k, 0] + R[2, 1] * y[k, 1] + R[2, 2]
        s /= np.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
        n[0], n[1], n[2] = s * (a1 * b2 - a2 * b1), s * (a2 * b0 - a0 * b2), s * (a0 * b1 - a1 * b0)
        for i in range(3):
            for j in range(3):
                M[i, j] += n[i] * n[j]


def _disagreement(bias, x, y, first, dR, J, R_BC):
    """Root coplanarity (P,) of P frame pairs, rotations corrected for a gyro bias (3,): 0 where bearings agree with it.

    Matches x, y (N, 2) of pair k stand from first[k] to first[k + 1]; dR (P, 3, 3) and J (P, 3, 3) are
    the preintegrated rotation and its derivative by the bias.
    """
    _scatters(bias, x, y, first, dR, J, R_BC, M := np.empty(dR.shape))
    return np.sqrt(np.maximum(np.linalg.eigvalsh(M)[:, 0], 0.0) / np.diff(first) + 1e-14)


@kernel
def _scatters(bias, x, y, first, dR, J, R_BC, M):
    """Fill M (P, 3, 3), the smallest eigenvalues of which tell how far the bearings are from the rotations."""
    turn, E, A, R = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(dR)):
        for i in range(3):
            turn[i] = J[k, i, 0] * bias[0] + J[k, i, 1] * bias[1] + J[k, i, 2] * bias[2]
        exp_so3(turn, E)
        multiply(dR[k], E, A)
        multiply(A, R_BC, E)
        multiply_transposed(R_BC, E, R)
        _scatter(x[first[k]:first[k + 1]], y[first[k]:first[k + 1]], R, turn, M[k])


def _gyro_bias(shots: list[Snapshot], links: list[tuple], R_BC: F64) -> F64:
    pairs = [(*matches(a.observations, b.observations), link)
             for (a, b), link in zip(pairwise(shots), links, strict=True)]
    pairs = [p for p in pairs if len(p[0]) >= 10]
    if not pairs:
        return np.zeros(3)
    x, y = (np.concatenate([p[i] for p in pairs]) for i in (0, 1))
    first = np.cumsum([0, *(len(p[0]) for p in pairs)])
    dR, J = (np.array([part(p[2]) for p in pairs]) for part in (lambda link: link[1], lambda link: link[4][:3, :3]))
    given = x, y, first, dR, J, np.ascontiguousarray(R_BC)

    def slopes(bias: F64) -> F64:
        steps = BIAS_STEP * np.eye(3)
        return np.stack([(_disagreement(bias + h, *given) - _disagreement(bias - h, *given)) / (2.0 * BIAS_STEP)
                         for h in steps], axis=1)

    return least_squares(lambda bias: _disagreement(bias, *given), np.zeros(3), slopes, x_scale=1e-2, loss='soft_l1',
                         f_scale=1e-3, xtol=1e-4, ftol=1e-6, max_nfev=30).x


def _velocity_and_gravity(shots: list[Snapshot], motion: _Motion, T_BC: F64, gravity: float) -> tuple[F64, F64] | None:
    """v0, g0 (3,) in the first body frame, points eliminated one by one, |g0| = gravity enforced."""
    rows: dict[int, list[Samples]] = {}
    for shot, t, R, p in zip(shots, motion.t, motion.R, motion.p, strict=True):
        R_C = (R @ T_BC[:3, :3]).T
        centre = p + R @ T_BC[:3, 3]
        for i, x in zip(shot.observations.points.ids, shot.observations.points.x, strict=True):
            A = np.array([[-1.0, 0.0, x[0]], [0.0, -1.0, x[1]]]) @ R_C  # A (P - centre - v t - g t^2 / 2) = 0
            B = -A @ np.hstack([t * np.eye(3), 0.5 * t * t * np.eye(3)])
            rows.setdefault(int(i), []).append((A, B, A @ centre))
    H, g = np.zeros((6, 6)), np.zeros(6)
    for views in rows.values():
        if len(views) < 4:
            continue
        A, B, c = (np.concatenate(m) for m in zip(*views, strict=True))
        Q, _ = np.linalg.qr(A)
        B = B - Q @ (Q.T @ B)
        H += B.T @ B
        g += B.T @ (c - Q @ (Q.T @ c))
    if np.linalg.cond(H) > 1e12:
        return None
    return _with_gravity_norm(H, g, gravity)


def _with_gravity_norm(H: F64, b: F64, gravity: float) -> tuple[F64, F64] | None:
    """argmin y' H y - 2 b' y over y = (v, g) with |g| = gravity, by its secular equation."""
    Hvv_inv = np.linalg.inv(H[:3, :3])
    D = H[3:, 3:] - H[3:, :3] @ Hvv_inv @ H[:3, 3:]
    d = b[3:] - H[3:, :3] @ Hvv_inv @ b[:3]
    values, vectors = np.linalg.eigh(D)
    q = vectors.T @ d

    def excess(shift: float) -> float:
        return float(np.sum((q / (values + shift)) ** 2) - gravity**2)

    low = -values[0] + 1e-9 * max(values[2], 1e-12)
    high = np.linalg.norm(d) / gravity + values[2]
    if not excess(low) > 0.0 > excess(high):
        return None
    g = vectors @ (q / (values + brentq(excess, low, high, xtol=1e-14 * high)))
    return Hvv_inv @ (b[:3] - H[:3, 3:] @ g), g
