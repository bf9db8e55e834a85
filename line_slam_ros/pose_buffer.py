"""Poses from another odometry, interpolated to the time of a frame."""
from __future__ import annotations

import numpy as np

from line_slam_ros.geometry.lie import rigid, so3_exp, so3_log
from line_slam_ros.types import F64


class PoseBuffer:
    """Fixed memory, oldest forgotten first."""

    MAX_GAP_NS = 500_000_000  # further apart, two poses say too little about what is between

    def __init__(self, capacity: int) -> None:
        self._t = np.zeros(capacity, np.int64)
        self._T = np.zeros((capacity, 4, 4))
        self._n = 0
        self.newest = -1  # ns, -1 when empty

    def push(self, t_ns: int, T_WB: F64) -> None:
        """Append a pose; ValueError unless its stamp is after the newest one."""
        if t_ns <= self.newest:
            raise ValueError(f'pose stamp {t_ns} is not after {self.newest}')
        if self._n == len(self._t):
            self._n //= 2
            self._t[: self._n], self._T[: self._n] = self._t[-self._n:], self._T[-self._n:]
        self._t[self._n], self._T[self._n] = t_ns, T_WB
        self._n += 1
        self.newest = t_ns

    def at(self, t_ns: int) -> F64 | None:
        """T_WB (4, 4) at t_ns, or None outside the buffer and inside a gap between poses."""
        after = int(np.searchsorted(self._t[: self._n], t_ns, side='left'))
        if after == self._n:
            return None
        if self._t[after] == t_ns:
            return self._T[after].copy()
        if after == 0 or self._t[after] - self._t[after - 1] > self.MAX_GAP_NS:
            return None
        share = float(t_ns - self._t[after - 1]) / float(self._t[after] - self._t[after - 1])
        return interpolate(self._T[after - 1], self._T[after], share)

    def clear(self) -> None:
        self._n, self.newest = 0, -1


def interpolate(T_A: F64, T_B: F64, share: float) -> F64:
    """Pose (4, 4) at ``share`` of the way from T_A to T_B: constant angular rate (slerp), straight line."""
    R_A, p_A = T_A[:3, :3], T_A[:3, 3]
    R = R_A @ so3_exp(share * so3_log(R_A.T @ T_B[:3, :3]))
    return rigid(R, p_A + share * (T_B[:3, 3] - p_A))
