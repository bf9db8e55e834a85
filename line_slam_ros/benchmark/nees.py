"""Normalised estimation error squared: is an error as large as its covariance says?

NEES = e' P^-1 e is chi-square distributed with dim(e) degrees of freedom if the covariance P is right, so its mean is
dim(e): more is overconfident. The mean of N independent runs lies within ``bounds`` with the given probability.

Source: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4.
"""
from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from line_slam_ros.geometry.lie import hat, rigid, so3_exp, so3_log
from line_slam_ros.types import F64

FREEDOM = {'position': 3, 'orientation': 3, 'pose': 6, 'velocity': 3, 'line in the world': 4,
           'line from the newest pose': 4}


def nees(error: F64, cov: F64) -> F64:
    """e' P^-1 e (...) of errors (..., d) and covariances (..., d, d)."""
    return np.einsum('...i,...i->...', error, np.linalg.solve(cov, error[..., None])[..., 0])


def bounds(freedom: int, runs: int, probability: float = 0.95) -> tuple[float, float]:
    """Between which the mean NEES per degree of freedom of independent runs lies if the covariance is right."""
    tail = 0.5 * (1.0 - probability)
    low, high = chi2.ppf([tail, 1.0 - tail], freedom * runs) / (freedom * runs)
    return float(low), float(high)


def gauge(T_EB: F64, T_WB: F64) -> F64:
    """T_EW (4, 4) of heading and position alone that takes a true pose T_WB to where the estimate T_EB has it.

    A visual-inertial estimate knows neither; roll and pitch it knows, so their errors stay. The heading is that of
    which the rotation left over has no part about the vertical.
    """
    turn = T_EB[:3, :3] @ T_WB[:3, :3].T
    heading = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    R_EW = so3_exp(np.array([0.0, 0.0, heading]))
    return rigid(R_EW, T_EB[:3, 3] - R_EW @ T_WB[:3, 3])


def state_nees(T_EB: F64, v_E: F64, cov: F64, true_T_EB: F64, true_v_E: F64) -> dict[str, float]:
    """Of one state: estimated and true pose (4, 4) and velocity (3,) in the estimate's world, covariance (9, 9) of
    [rotation in B, position, velocity]."""
    turned = so3_log(true_T_EB[:3, :3].T @ T_EB[:3, :3])
    error = np.concatenate([turned, T_EB[:3, 3] - true_T_EB[:3, 3], v_E - true_v_E])
    parts = {'orientation': slice(0, 3), 'position': slice(3, 6), 'pose': slice(0, 6), 'velocity': slice(6, 9)}
    return {name: float(nees(error[s], cov[s, s])) for name, s in parts.items()}


def end_errors(pluecker: F64, cov: F64, segments: F64) -> tuple[F64, F64]:
    """How far estimated lines (L, 6), |d| = 1, of covariance (L, 6, 6) run past true segments (L, 2, 3): offset across
    the line at either end, (L, 4) m, and its covariance (L, 4, 4).

    The offset x x d - n of a point x is linear in the line and perpendicular to d: two numbers per end, which together
    are the four degrees of freedom.
    """
    n, d = pluecker[:, None, :3], pluecker[:, None, 3:]
    across = np.linalg.svd(d)[2][:, None, 1:]  # (L, 1, 2, 3), perpendicular to d
    by_line = np.concatenate([-np.broadcast_to(np.eye(3), (*segments.shape, 3)), hat(segments)], axis=-1)
    J = (across @ by_line).reshape(-1, 4, 6)
    offset = (across @ (np.cross(segments, d) - n)[..., None]).reshape(-1, 4)
    return offset, J @ cov @ J.transpose(0, 2, 1)


def line_nees(pluecker: F64, cov: F64, segments: F64) -> F64:
    """NEES (L,) of end_errors."""
    return nees(*end_errors(pluecker, cov, segments))
