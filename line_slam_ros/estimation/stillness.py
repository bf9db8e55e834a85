"""Whether the body is at rest, from bearings and inertial samples."""
from __future__ import annotations

from collections import deque

import numpy as np

from line_slam_ros.estimation.shift import FEW_CORNERS, corner_shifts, matches, segment_shifts, shared
from line_slam_ros.types import F64, Observations, Samples

SPAN_S = 0.5  # motion is judged over this long
MAX_SHIFT_PX = 0.4  # median shift over the span beyond noise; 1 cm/s at 5 m and 450 px
RAYLEIGH_MEDIAN = 1.67  # median distance of two noisy sightings of one corner, standard deviations of one
SEGMENTS_QUANTILE = 0.8  # takes the place of the median where segments count: most of them may lie along the motion
SEGMENTS_FACTOR = 1.4  # this quantile over the median, of segments in all directions
MIN_SIGHT = 0.01  # mean squared sine between the segments' planes and a motion that they must not miss
MAX_GYRO_STD, MAX_ACCEL_STD = 0.05, 0.5  # rad/s, m/s^2: a body that shakes is not still


class Stillness:
    """Remembers half a second of frames."""

    def __init__(self, focal_px: float, point_sigma_px: float):
        self._focal_px, self._point_sigma = focal_px, point_sigma_px / focal_px
        self._past: deque[tuple[Observations, Samples | None]] = deque()
        self._rest: Observations | None = None  # the frame since which nothing moved: creeping adds up against it

    def clear(self) -> None:
        self._past.clear()
        self._rest = None

    def add(self, observations: Observations, samples: Samples | None) -> bool:
        """Take the newest frame and the samples that led to it; True when nothing moved over the whole span."""
        self._past.append((observations, samples))
        while len(self._past) > 2 and observations.t_ns - self._past[1][0].t_ns >= SPAN_S * 1e9:
            self._past.popleft()
        first = self._past[0][0]
        if observations.t_ns - first.t_ns < SPAN_S * 1e9:
            return False
        moved = self._moved(first, observations) or (self._rest is not None and self._moved(self._rest, observations))
        still = not moved and not self._shaken()
        self._rest = (self._rest or observations) if still else None
        return still

    def _moved(self, then: Observations, now: Observations) -> bool:
        """Corners judge; where they are few, segments join in, unless they would not see every direction of motion."""
        corners = corner_shifts(*matches(then, now)) / self._allowed(self._point_sigma)
        if len(corners) >= FEW_CORNERS:
            return bool(2 * np.count_nonzero(corners > 1.0) > len(corners))
        i, j = shared(then.lines.ids, now.lines.ids)
        size, sigma = segment_shifts(then.lines.ends[i], now.lines.ends[j], then.lines.sigma[i], now.lines.sigma[j])
        both = np.concatenate([corners, size / self._allowed(sigma)])
        if len(both) < FEW_CORNERS or _sight(now.lines.ends[j]) < MIN_SIGHT:
            return True
        return bool(np.quantile(both, SEGMENTS_QUANTILE) > SEGMENTS_FACTOR)

    def _allowed(self, sigma: F64) -> F64:
        return np.hypot(MAX_SHIFT_PX / self._focal_px, RAYLEIGH_MEDIAN * sigma)

    def _shaken(self) -> bool:
        gyro, accel = self._imu()
        return bool(gyro.std(axis=0).max() > MAX_GYRO_STD or accel.std(axis=0).max() > MAX_ACCEL_STD)

    def mean_imu(self) -> tuple[F64, F64]:
        """Mean rate (3,) and specific force (3,) over the span."""
        gyro, accel = self._imu()
        return gyro.mean(axis=0), accel.mean(axis=0)

    def _imu(self) -> tuple[F64, F64]:
        """Rates (N, 3) and specific forces (N, 3) of the span."""
        blocks = [samples for _, samples in list(self._past)[1:] if samples is not None]
        return np.concatenate([gyro for _, gyro, _ in blocks]), np.concatenate([accel for _, _, accel in blocks])


def _sight(ends: F64) -> float:
    """Mean squared sine between the planes of segments (M, 2, 2) and the direction of motion that they see least."""
    rays = np.insert(ends, 2, 1.0, axis=2)
    normals = np.cross(rays[:, 0], rays[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return float(np.linalg.eigvalsh(normals.T @ normals / max(len(ends), 1))[0])
