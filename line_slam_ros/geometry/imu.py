"""IMU preintegration on the manifold, with bias Jacobians and covariance, compiled.

Source: Forster, Carlone, Dellaert, Scaramuzza, "On-Manifold Preintegration for Real-Time
Visual-Inertial Odometry", T-RO 2017; each interval takes the mean of its two samples and turns the
acceleration at mid-interval. Error order [rotation, position, velocity].
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.geometry.lie_kernels import exp_so3, multiply, right_jacobian
from line_slam_ros.kernel_cache import inner, kernel
from line_slam_ros.types import F64, I64, ImuBatch, Samples


@kernel
def preintegrate(t, gyro, accel, bg, ba, var_g, var_a, dR, dp, dv, J, cov):
    """Relative motion over the samples t (N,) s, gyro and accel (N, 3), with biases bg, ba (3,) removed.

    var_g, var_a: squared noise densities. Fills dR (3, 3), dp (3,), dv (3,), the bias Jacobian
    J (9, 6) of [rotation, position, velocity] by [gyro bias, accelerometer bias] and their
    covariance cov (9, 9). Returns the duration in s.

    Per interval, w and a the mean rate and specific force, M = dR Exp(w dt / 2):
        dp += dv dt + M a dt^2 / 2,  dv += M a dt,  dR <- dR Exp(w dt)
    """
    W, H, Jr, A, M = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    F, G = np.zeros((9, 9)), np.zeros((9, 6))
    FC, w = np.empty((9, 9)), np.empty(3)
    for i in range(9):
        F[i, i] = 1.0
    dR[:], dp[:], dv[:], J[:], cov[:] = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        dR[i, i] = 1.0
    for k in range(len(t) - 1):
        dt = t[k + 1] - t[k]
        a0 = 0.5 * (accel[k, 0] + accel[k + 1, 0]) - ba[0]
        a1 = 0.5 * (accel[k, 1] + accel[k + 1, 1]) - ba[1]
        a2 = 0.5 * (accel[k, 2] + accel[k + 1, 2]) - ba[2]
        for i in range(3):
            w[i] = 0.5 * dt * (0.5 * (gyro[k, i] + gyro[k + 1, i]) - bg[i])
        exp_so3(w, H)
        multiply(dR, H, M)
        for i in range(3):
            w[i] *= 2.0
        exp_so3(w, W)
        right_jacobian(w, Jr)
        for i in range(3):  # A = -M [a]x; to first order the half step leaves the rotation error as it was
            A[i, 0] = -(M[i, 1] * a2 - M[i, 2] * a1)
            A[i, 1] = -(M[i, 2] * a0 - M[i, 0] * a2)
            A[i, 2] = -(M[i, 0] * a1 - M[i, 1] * a0)
        _transition(W, H, Jr, A, M, dt, F, G)
        _propagate(F, G, var_g / dt, var_a / dt, cov, J, FC)
        for i in range(3):
            acc = M[i, 0] * a0 + M[i, 1] * a1 + M[i, 2] * a2
            dp[i] += dv[i] * dt + 0.5 * acc * dt * dt
            dv[i] += acc * dt
        multiply(dR, W, M)
        _copy(M, dR)
    return t[len(t) - 1] - t[0]


@inner
def _transition(W, H, Jr, A, M, dt, F, G):
    """F (9, 9): error before to error after one interval; G (9, 6): by the rate and the specific force."""
    for i in range(3):
        for j in range(3):
            F[i, j] = W[j, i]
            G[i, j] = Jr[i, j] * dt
            half = A[i, 0] * H[j, 0] + A[i, 1] * H[j, 1] + A[i, 2] * H[j, 2]  # A H': start error at mid-interval
            F[3 + i, j] = 0.5 * dt * dt * half
            F[6 + i, j] = dt * half
            G[3 + i, j] = 0.25 * dt * dt * dt * A[i, j]  # rate error turns the mid rotation by dt / 2
            G[6 + i, j] = 0.5 * dt * dt * A[i, j]
            G[3 + i, 3 + j] = 0.5 * dt * dt * M[i, j]
            G[6 + i, 3 + j] = dt * M[i, j]
        F[3 + i, 6 + i] = dt


@inner
def _propagate(F, G, var_g, var_a, cov, J, FC):
    """cov <- F cov F' + G diag(var_g, var_a) G' and J <- F J - G, in place; FC (9, 9) is scratch."""
    for i in range(9):
        for j in range(9):
            s = 0.0
            for m in range(9):
                s += F[i, m] * cov[m, j]
            FC[i, j] = s
    for i in range(9):
        for j in range(i, 9):
            s = 0.0
            for m in range(9):
                s += FC[i, m] * F[j, m]
            for m in range(3):
                s += G[i, m] * G[j, m] * var_g + G[i, 3 + m] * G[j, 3 + m] * var_a
            cov[i, j] = s
            cov[j, i] = s
    for j in range(6):
        for i in range(9):
            s = -G[i, j]
            for m in range(9):
                s += F[i, m] * J[m, j]
            FC[i, j] = s
        for i in range(9):
            J[i, j] = FC[i, j]


@inner
def _copy(A, B):
    """B = A for 3x3, by elements: assigning whole arrays makes seconds of compiled error messages."""
    for i in range(3):
        for j in range(3):
            B[i, j] = A[i, j]


@kernel
def turned(t, gyro, bias):
    """R_01 (3, 3): how the body turned over the samples t (N,) s, gyro (N, 3) rad/s, bias (3,) removed."""
    R, step, by, product = np.zeros((3, 3)), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        R[i, i] = 1.0
    for k in range(len(t) - 1):
        for i in range(3):
            step[i] = (t[k + 1] - t[k]) * (0.5 * (gyro[k, i] + gyro[k + 1, i]) - bias[i])
        exp_so3(step, by)
        multiply(R, by, product)
        _copy(product, R)
    return R


def between(imu: ImuBatch, start_ns: int, end_ns: int) -> tuple[F64, F64, F64]:
    """Samples of exactly [start_ns, end_ns], ends interpolated linearly: t (N,) s from start, gyro, accel (N, 3).

    A batch that does not reach an end holds its nearest sample there. Raises ValueError when there
    is nothing to interpolate (fewer than two samples) or end_ns <= start_ns.
    """
    if end_ns <= start_ns or len(imu.t_ns) < 2:
        raise ValueError(f'no inertial samples between {start_ns} and {end_ns} ns (batch of {len(imu.t_ns)})')
    inside: I64 = imu.t_ns[(imu.t_ns > start_ns) & (imu.t_ns < end_ns)]
    t_ns = np.concatenate([[start_ns], inside, [end_ns]])
    t, source = (t_ns - start_ns) * 1e-9, (imu.t_ns - start_ns) * 1e-9
    columns = [np.interp(t, source, c) for c in (*imu.gyro_B.T, *imu.accel_B.T)]
    samples = np.ascontiguousarray(np.stack(columns, axis=1))
    return t, np.ascontiguousarray(samples[:, :3]), np.ascontiguousarray(samples[:, 3:])


def chained(parts: list[Samples]) -> Samples:
    """Samples of consecutive spans, each with its own t from 0, as of one.

    An end that lies within one interval of the IMU was interpolated and tells nothing: it goes.
    """
    t, gyro, accel = parts[0]
    for t2, gyro2, accel2 in parts[1:]:
        around = t[-1] - t[-2] + t2[1]
        end = -1 if around < 1.5 * np.median(np.concatenate([np.diff(t), np.diff(t2)])) else len(t)
        t = np.concatenate([t[:end], t[-1] + t2[1:]])
        gyro, accel = np.concatenate([gyro[:end], gyro2[1:]]), np.concatenate([accel[:end], accel2[1:]])
    return t, gyro, accel


def joined(batches: list[ImuBatch]) -> ImuBatch:
    """Consecutive batches, which may overlap at their ends, as one."""
    if len(batches) == 1:
        return batches[0]
    t_ns, first = np.unique(np.concatenate([b.t_ns for b in batches]), return_index=True)
    return ImuBatch(t_ns, np.concatenate([b.gyro_B for b in batches])[first],
                    np.concatenate([b.accel_B for b in batches])[first])


def longest_gap(imu: ImuBatch, start_ns: int, end_ns: int) -> float:
    """Longest time (s) within [start_ns, end_ns] without a sample."""
    inside = imu.t_ns[(imu.t_ns > start_ns) & (imu.t_ns < end_ns)]
    before = imu.t_ns[imu.t_ns <= start_ns][-1:]
    after = imu.t_ns[imu.t_ns >= end_ns][:1]
    times = np.concatenate([before if len(before) else [start_ns], inside, after if len(after) else [end_ns]])
    return float(np.diff(times).max()) * 1e-9
