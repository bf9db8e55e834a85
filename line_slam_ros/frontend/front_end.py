"""Image in, observations with stable ids out."""
from __future__ import annotations

from time import perf_counter

import cv2
import numpy as np

from line_slam_ros.config import Config
from line_slam_ros.frontend.line_tracker import LineTracker
from line_slam_ros.frontend.point_tracker import PointTracker
from line_slam_ros.geometry.camera import Camera
from line_slam_ros.types import F64, I64, U8, Frame, Observations

LONGEST_PACE = 5.0  # motion is not extrapolated further
OLD = 20  # images, age at which a drawn track has its final colour


class FrontEnd:
    """Corners and line segments of one camera, followed over time."""

    def __init__(self, camera: Camera, config: Config):
        self._camera, self._config = camera, config
        self._points = PointTracker(camera, config.points)
        self._lines = LineTracker(camera, config.lines)
        self._image, self._before = np.zeros((2, camera.calibration.height, camera.calibration.width), np.uint8)
        self._t_ns, self._elapsed_ns = 0, 0
        self.timings: dict[str, float] = {}

    def reset(self) -> None:
        """Forget every track; ids go on counting."""
        self._points.reset()
        self._lines.reset()

    def forget(self, point_ids: I64, line_ids: I64) -> None:
        """End tracks that the estimator found wrong; their ids never come again."""
        self._points.forget(point_ids)
        self._lines.forget(line_ids)

    def track(self, frame: Frame, R_CnCp: F64 | None, skip_detection: bool = False) -> Observations:
        """Follow points and lines into frame; R_CnCp (3, 3) turns rays of the previous camera into this one.

        None: the rotation is unknown. New points and lines are looked for in different images, if that can wait; with
        skip_detection, which saves time, only where few are left. Raises ValueError when the image is not of
        the calibrated size.
        """
        if frame.image.shape != self._image.shape:
            (h, w), (rows, columns) = self._image.shape, frame.image.shape[:2]
            raise ValueError(f'image is {columns}x{rows} px, the calibration is for {w}x{h}: use the one that fits')
        self._image, self._before = self._before, self._image
        np.copyto(self._image, frame.image)  # it is needed again when the next one comes
        R_CnCp = None if R_CnCp is None else np.ascontiguousarray(R_CnCp, float)
        times, pace = [perf_counter()], self._pace(frame.t_ns)
        if self._config.use_points:
            self._points.track(self._image, R_CnCp, pace)
        if self._config.use_lines:
            self._lines.take(self._image)
            corners = self._points.corners
            self._lines.track(R_CnCp, corners.x - corners.motion, corners.motion, pace)
        times.append(perf_counter())
        looked = self._config.use_lines and self._lines.detect(skip_detection)
        if self._config.use_points:
            self._points.detect(skip_detection or looked)
        times.append(perf_counter())
        self.timings = dict(zip(('track', 'detect'), np.diff(times).tolist(), strict=True))
        return Observations(frame.t_ns, self._points.observations(), self._lines.observations())

    def _pace(self, t_ns: int) -> float:
        """Time since the previous image in units of that before it; 1 when there was none, LONGEST_PACE at most."""
        before, self._elapsed_ns, self._t_ns = self._elapsed_ns, t_ns - self._t_ns, t_ns
        return min(self._elapsed_ns / before, LONGEST_PACE) if before > 0 and self._elapsed_ns > 0 else 1.0

    def draw(self) -> U8:
        """Newest image (H, W, 3) BGR with the tracks in it: new ones blue, old ones green (points) or red (lines)."""
        canvas = cv2.cvtColor(self._image, cv2.COLOR_GRAY2BGR)
        corners, segments = self._points.corners, self._lines.segments
        ends = self._camera.project(self._lines.canvas.normalise(segments.ends.reshape(-1, 2))).reshape(-1, 4)
        for (u0, v0, u1, v1), age in zip(ends.tolist(), segments.ages.tolist(), strict=True):
            if np.isfinite(u0 + v0 + u1 + v1):
                cv2.line(canvas, (round(u0), round(v0)), (round(u1), round(v1)), _colour(age, 2), 2, cv2.LINE_AA)
        for (u, v), age in zip(corners.uv.tolist(), corners.ages.tolist(), strict=True):
            cv2.circle(canvas, (round(u), round(v)), 3, _colour(age, 1), 1, cv2.LINE_AA)
        return canvas


def _colour(age: int, channel: int) -> tuple[int, ...]:
    """BGR from blue (new) to full channel (OLD images and more)."""
    share = min(age / OLD, 1.0)
    colour = [round(255 * (1.0 - share)), 80, 0]
    colour[channel] = round(80 + 175 * share)
    return tuple(colour)
