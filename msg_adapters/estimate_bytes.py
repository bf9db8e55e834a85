"""Serialised odometry, pose and transform of an estimate in microseconds: numbers go into messages serialised once.

In CDR (OMG DDSI-RTPS) each of them ends with its doubles, one after the other; before them, only the stamp changes.
"""
from __future__ import annotations

import struct

import numpy as np

from line_slam_ros.geometry.lie import quaternion_from_matrix
from line_slam_ros.ros_conventions import linear_velocity, pose_covariance, twist_covariance
from line_slam_ros.types import F64, Estimate
from msg_adapters import outputs
from msg_adapters.factories import MessageFactory
from msg_adapters.marker_bytes import STAMP_AT, Serialiser

POSE, COVARIANCE, TWIST = 7, 36, 6  # doubles


class EstimateBytes:
    """tf2_msgs/TFMessage, nav_msgs/Odometry and geometry_msgs/PoseWithCovarianceStamped, as outputs.py makes them."""

    def __init__(self, new: MessageFactory, serialise: Serialiser, frame_id: str, child_frame_id: str) -> None:
        none, nowhere = np.zeros(3), np.eye(4)
        blank = Estimate(0, nowhere, none, none, none, none, np.zeros((9, 9)), False, {})
        moved = outputs.transform(new, 0, nowhere, frame_id, child_frame_id)
        self._transform = _Template(serialise(outputs.tf(new, [moved])), STAMP_AT + 4, POSE)  # after the count
        self._pose = _Template(serialise(outputs.pose(new, blank, frame_id)), STAMP_AT, POSE + COVARIANCE)
        self._odometry = _Template(serialise(outputs.odometry(new, blank, frame_id, child_frame_id)), STAMP_AT,
                                   POSE + COVARIANCE + TWIST + COVARIANCE)

    def __call__(self, estimate: Estimate, gyro_variance: float = 0.0) -> tuple[bytes, bytes, bytes]:
        """Transform, odometry and pose."""
        t_ns, T_WB = estimate.t_ns, estimate.T_WB
        pose = np.concatenate([T_WB[:3, 3], quaternion_from_matrix(T_WB[:3, :3]), pose_covariance(estimate).ravel()])
        twist = np.concatenate([linear_velocity(estimate), estimate.omega_B,
                                twist_covariance(estimate, gyro_variance).ravel()])
        return (self._transform(t_ns, pose[:POSE]), self._odometry(t_ns, np.concatenate([pose, twist])),
                self._pose(t_ns, pose))


class _Template:
    """A message whose stamp and last doubles change."""

    def __init__(self, message: bytes | memoryview, stamp_at: int, doubles: int) -> None:
        message = bytes(message)
        self._before, self._after = message[:stamp_at], message[stamp_at + 8:len(message) - 8 * doubles]

    def __call__(self, t_ns: int, doubles: F64) -> bytes:
        stamp = struct.pack('<iI', *divmod(t_ns, 1_000_000_000))
        return b''.join((self._before, stamp, self._after, doubles.astype('<f8').tobytes()))
