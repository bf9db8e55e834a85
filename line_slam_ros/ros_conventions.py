"""An estimate in the conventions of nav_msgs/Odometry (REP 103, REP 105).

ROS orders covariances [position, rotation] or [linear, angular] and turns about the fixed axes of the parent frame;
ours is [rotation in B, position in W, velocity in W] with R <- R Exp(dtheta), see geometry/lie.py.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.geometry.lie import hat
from line_slam_ros.types import F64, Estimate, ImuBatch, ImuNoise


def pose_covariance(estimate: Estimate) -> F64:
    """(6, 6) of [position, rotation about fixed axes], both in W: R Exp(dtheta) = Exp(R dtheta) R."""
    J = np.zeros((6, 6))
    J[:3, 3:] = np.eye(3)
    J[3:, :3] = estimate.T_WB[:3, :3]
    return J @ estimate.cov[:6, :6] @ J.T


def linear_velocity(estimate: Estimate) -> F64:
    """v_B (3,) m/s, the velocity seen in the body frame."""
    return estimate.T_WB[:3, :3].T @ estimate.v_W


def twist_covariance(estimate: Estimate, gyro_variance: float = 0.0) -> F64:
    """(6, 6) of [linear, angular] in B; v_B = R' v_W, so dv_B = hat(v_B) dtheta + R' dv_W.

    ``gyro_variance`` is that of one angular rate sample, rad^2/s^2: noise density squared times the sample rate.
    """
    J = np.zeros((3, 9))
    J[:, :3] = hat(linear_velocity(estimate))
    J[:, 6:] = estimate.T_WB[:3, :3].T
    cov = np.zeros((6, 6))
    cov[:3, :3] = J @ estimate.cov @ J.T
    cov[3:, 3:] = gyro_variance * np.eye(3)
    return cov


def gyro_variance(noise: ImuNoise, imu: ImuBatch) -> float:
    """Variance of one angular rate sample, rad^2/s^2: density squared times the sample rate of the batch."""
    seconds = (int(imu.t_ns[-1]) - int(imu.t_ns[0])) * 1e-9
    return noise.gyro_density**2 * (len(imu.t_ns) - 1) / seconds if seconds > 0.0 else 0.0
