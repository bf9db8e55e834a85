"""Upright lines of buildings tell roll and pitch, compiled.

After a start the bias of the accelerometer hides up to a degree of tilt until the body has turned. Edges of walls,
doors and furniture point up more exactly than that, and landmarks live in a world whose z axis is up: so the belief is
about each line alone. It points along the building's own vertical, the lean, which all share, give or take the spread
of such lines. A Cauchy loss leaves all others, level ones among them, as free as they were.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.estimation.window import LEAN
from line_slam_ros.factors.robust import CAUCHY, robust
from line_slam_ros.factors.upright import upright
from line_slam_ros.geometry.line_forms import world_line
from line_slam_ros.kernel_cache import kernel

SCALE = 1.0  # of the loss, squared standard deviations


@kernel
def upright_residuals(use, form, values, origin, lean, spread, pull, weight, a):
    """Robust cost of the lines of rows with use[i]; fills their weight (rows,) and pull (rows, 2), which is weight
    times residual, and adds what these pull at the lines to a (rows, 4)."""
    r, J, n_W, d_W, C = np.empty(2), np.empty((2, 4)), np.empty(3), np.empty(3), np.empty((6, 4))
    cost = 0.0
    for i in range(len(use)):
        pull[i, 0], pull[i, 1], weight[i] = 0.0, 0.0, 0.0
        if not use[i]:
            continue
        world_line(form, values[i], origin[i], n_W, d_W, C)
        if not upright(d_W, C, lean, spread, r, J):
            continue
        rho, weight[i] = robust(CAUCHY, r[0] * r[0] + r[1] * r[1], SCALE)
        cost += rho
        for k in range(2):
            pull[i, k] = weight[i] * r[k]
            for j in range(4):
                a[i, j] += pull[i, k] * J[k, j]
    return 0.5 * cost


@kernel
def upright_hessians(use, form, values, origin, lean, spread, weight, L, first, S, H):
    """Add the same, with the weights of the last evaluation, to the lines' Hessians L (rows, 4, 4), to their ties to
    the lean in S (landmarks.py), before they are eliminated, and to the Hessian H of the window."""
    r, J, n_W, d_W, C = np.empty(2), np.empty((2, 4)), np.empty(3), np.empty(3), np.empty((6, 4))
    for i in range(len(use)):
        if not (use[i] and weight[i] > 0.0):
            continue
        world_line(form, values[i], origin[i], n_W, d_W, C)
        upright(d_W, C, lean, spread, r, J)
        for k in range(2):
            H[LEAN + k, LEAN + k] += weight[i] / (spread * spread)
            for j in range(4):
                S[first[i] + j, LEAN + k] -= weight[i] * J[k, j] / spread
                for m in range(j + 1):
                    L[i, j, m] += weight[i] * J[k, j] * J[k, m]
