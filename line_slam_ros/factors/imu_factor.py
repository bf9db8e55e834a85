"""The preintegrated IMU factor between two states, whitened, and its Jacobians.

Source: Forster et al. 2017, section VI; states [rotation, position, velocity, gyro bias, accel bias],
right perturbation on the rotation, all else additive.
"""
import numpy as np

from line_slam_ros.geometry.lie_kernels import (
    exp_so3,
    log_so3,
    multiply,
    multiply_transposed,
    right_jacobian,
    right_jacobian_inverse,
)
from line_slam_ros.kernel_cache import inner


@inner
def _raw_residual(R_i, p_i, v_i, b_i, R_j, p_j, v_j, b_j, dt, dR, dp, dv, J_b, b_lin, g_W, r, E, rho, mu):
    """Unwhitened residual r (15,); E = dR_corrected' R_i' R_j; rho, mu (3,) the position and velocity in frame i."""
    c, A, B = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        c[i] = 0.0
        for m in range(6):
            c[i] += J_b[i, m] * (b_i[m] - b_lin[m])
    exp_so3(c, A)
    multiply(dR, A, B)  # bias-corrected rotation
    multiply_transposed(R_i, R_j, A)
    multiply_transposed(B, A, E)
    log_so3(E, c)
    for i in range(3):
        r[i] = c[i]
        rho[i] = 0.0
        mu[i] = 0.0
        for m in range(3):
            rho[i] += R_i[m, i] * (p_j[m] - p_i[m] - v_i[m] * dt - 0.5 * g_W[m] * dt * dt)
            mu[i] += R_i[m, i] * (v_j[m] - v_i[m] - g_W[m] * dt)
        r[3 + i] = rho[i] - dp[i]
        r[6 + i] = mu[i] - dv[i]
        for m in range(6):
            r[3 + i] -= J_b[3 + i, m] * (b_i[m] - b_lin[m])
            r[6 + i] -= J_b[6 + i, m] * (b_i[m] - b_lin[m])
    for i in range(6):
        r[9 + i] = b_j[i] - b_i[i]


@inner
def imu_residual(R_i, p_i, v_i, b_i, R_j, p_j, v_j, b_j, dt, dR, dp, dv, J_b, b_lin, W, w_b, g_W, r):
    """Fills the whitened residual r (15,) = [rotation, position, velocity, gyro bias, accel bias].

        r_rot = Log((dR Exp(J_rot db))' R_i' R_j)
        r_pos = R_i' (p_j - p_i - v_i dt - g dt^2 / 2) - (dp + J_pos db)
        r_vel = R_i' (v_j - v_i - g dt) - (dv + J_vel db),  r_bias = b_j - b_i,  db = b_i - b_lin

    b_i, b_j, b_lin (6,) are [gyro, accel]; W (9, 9) whitens the first nine (W' W = cov^-1), w_b (6,)
    the bias walk; g_W (3,) is gravity (pointing down).
    """
    E, rho, mu, raw = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(15)
    _raw_residual(R_i, p_i, v_i, b_i, R_j, p_j, v_j, b_j, dt, dR, dp, dv, J_b, b_lin, g_W, raw, E, rho, mu)
    for i in range(9):
        r[i] = 0.0
        for m in range(9):
            r[i] += W[i, m] * raw[m]
    for i in range(6):
        r[9 + i] = w_b[i] * raw[9 + i]


@inner
def imu_jacobians(R_i, p_i, v_i, b_i, R_j, p_j, v_j, b_j, dt, dR, dp, dv, J_b, b_lin, W, w_b, g_W, J_i, J_j):
    """Fills J_i, J_j (15, 15): the whitened residual's derivatives by the two states."""
    E, rho, mu, raw = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(15)
    _raw_residual(R_i, p_i, v_i, b_i, R_j, p_j, v_j, b_j, dt, dR, dp, dv, J_b, b_lin, g_W, raw, E, rho, mu)
    Ji, Jj = np.zeros((15, 15)), np.zeros((15, 15))
    inv, A, B, c = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    right_jacobian_inverse(raw, inv)
    multiply_transposed(R_j, R_i, A)
    multiply(inv, A, B)
    for i in range(3):
        for j in range(3):
            Ji[i, j] = -B[i, j]  # -J_r^-1 R_j' R_i
            Jj[i, j] = inv[i, j]
    # bias: Log(Exp(-J_r(c) J db) E) = r - J_r^-1(r) E' J_r(c) J db
    for i in range(3):
        c[i] = 0.0
        for m in range(6):
            c[i] += J_b[i, m] * (b_i[m] - b_lin[m])
    right_jacobian(c, A)
    multiply_transposed(E, A, B)
    multiply(inv, B, A)
    for i in range(3):
        for j in range(6):
            Ji[i, 9 + j] = -(A[i, 0] * J_b[0, j] + A[i, 1] * J_b[1, j] + A[i, 2] * J_b[2, j])
            Ji[3 + i, 9 + j] = -J_b[3 + i, j]
            Ji[6 + i, 9 + j] = -J_b[6 + i, j]
    for k in range(2):  # d(R_i' x)/d rotation = [R_i' x]x
        x = rho if k == 0 else mu
        o = 3 + 3 * k
        Ji[o, 1], Ji[o, 2] = -x[2], x[1]
        Ji[o + 1, 0], Ji[o + 1, 2] = x[2], -x[0]
        Ji[o + 2, 0], Ji[o + 2, 1] = -x[1], x[0]
    for i in range(3):
        for j in range(3):
            Ji[3 + i, 3 + j] = -R_i[j, i]
            Jj[3 + i, 3 + j] = R_i[j, i]
            Ji[3 + i, 6 + j] = -R_i[j, i] * dt
            Ji[6 + i, 6 + j] = -R_i[j, i]
            Jj[6 + i, 6 + j] = R_i[j, i]
    for j in range(15):
        for i in range(9):
            s, q = 0.0, 0.0
            for m in range(9):
                s += W[i, m] * Ji[m, j]
                q += W[i, m] * Jj[m, j]
            J_i[i, j], J_j[i, j] = s, q
        for i in range(6):
            J_i[9 + i, j] = -w_b[i] if j == 9 + i else 0.0
            J_j[9 + i, j] = w_b[i] if j == 9 + i else 0.0
