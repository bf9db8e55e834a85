"""Inertial samples waiting for their frame, and what their stamps and magnitudes say about the sensor."""
from __future__ import annotations

import math

import numpy as np

from line_slam_ros.types import ImuBatch

Vector = tuple[float, float, float]


class ImuBuffer:
    """Fixed memory, oldest forgotten first: push() at sensor rate never grows anything."""

    def __init__(self, capacity: int) -> None:
        self._t = np.zeros(capacity, np.int64)
        self._gyro = np.zeros((capacity, 3))
        self._accel = np.zeros((capacity, 3))
        self._n = 0
        self.newest = -1  # ns, -1 when empty

    def push(self, t_ns: int, gyro_B: Vector, accel_B: Vector) -> None:
        """Append a sample; ValueError unless its stamp is after the newest one."""
        if t_ns <= self.newest:
            raise ValueError(f'IMU stamp {t_ns} is not after {self.newest}')
        if self._n == len(self._t):
            self._drop(self._n // 2)
        self._t[self._n], self._gyro[self._n], self._accel[self._n] = t_ns, gyro_B, accel_B
        self._n += 1
        self.newest = t_ns

    def take_until(self, t_ns: int) -> ImuBatch | None:
        """Samples up to the first at or after t_ns; None if none is at or before it.

        The last sample at or before t_ns stays, as the first of the next batch.
        """
        upto = self._t[: self._n]
        before = int(np.searchsorted(upto, t_ns, side='right'))
        if before == 0:
            return None
        end = min(int(np.searchsorted(upto, t_ns, side='left')) + 1, self._n)
        batch = ImuBatch(self._t[:end].copy(), self._gyro[:end].copy(), self._accel[:end].copy())
        self._drop(before - 1)
        return batch

    def clear(self) -> None:
        self._n, self.newest = 0, -1

    def _drop(self, k: int) -> None:
        if k > 0:
            for rows in (self._t, self._gyro, self._accel):
                rows[: self._n - k] = rows[k : self._n]  # NumPy buffers the overlap itself
            self._n -= k


class GapDetector:
    """Tells when a sample is missing: a period of more than five times the median of the recent ones."""

    _FACTOR, _HISTORY, _REFRESH = 5.0, 64, 16

    def __init__(self) -> None:
        self._periods = np.zeros(self._HISTORY, np.int64)
        self._count = 0
        self._limit = math.inf  # ns

    def is_gap(self, period_ns: int) -> bool:
        """Whether the time since the sample before is a gap; learns from the period."""
        self._periods[self._count % self._HISTORY] = period_ns
        self._count += 1
        if self._count % self._REFRESH == 0:
            self._limit = self._FACTOR * float(np.median(self._periods[: self._count]))
        return period_ns > self._limit


class UnitCheck:
    """Tells from magnitudes when an IMU is not in m/s^2 and rad/s."""

    _WINDOW = 200  # samples

    def __init__(self) -> None:
        self._n, self._accel_sum = 0, 0.0

    def complaint(self, gyro_B: Vector, accel_B: Vector) -> str:
        """A sentence that says what is wrong and what to do, or ''; judges the accelerometer once per window."""
        if max(map(abs, gyro_B)) > 50.0:
            return (f'the gyroscope reads {max(map(abs, gyro_B)):.0f} rad/s, more than any usual sensor can: '
                    'sensor_msgs/Imu wants rad/s, not deg/s; fix the driver')
        self._n += 1
        self._accel_sum += math.hypot(*accel_B)
        if self._n < self._WINDOW:
            return ''
        mean, self._n, self._accel_sum = self._accel_sum / self._n, 0, 0.0
        return _accel_complaint(mean)


def _accel_complaint(mean: float) -> str:
    """What a mean specific force of so many m/s^2 gives away; gravity alone makes 9.8 of it."""
    if 0.7 < mean < 1.4:
        return (f'the accelerometer reads {mean:.2f} on average, so it seems to be in g: sensor_msgs/Imu wants m/s^2; '
                'fix the driver or set accel_scale: 9.80665')
    if mean <= 0.7:
        return (f'the accelerometer reads {mean:.2f} m/s^2 on average, so gravity seems to be removed: '
                'use the topic with the raw acceleration')
    return ''
