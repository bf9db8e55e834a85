"""The whole method on one screen."""
from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from line_slam_ros.config import Config
from line_slam_ros.estimation.bootstrap import Bootstrap
from line_slam_ros.estimation.estimator import Estimator
from line_slam_ros.estimation.stillness import MAX_GYRO_STD, Stillness
from line_slam_ros.frontend.front_end import FrontEnd
from line_slam_ros.geometry.camera import Camera
from line_slam_ros.geometry.imu import between, joined, longest_gap, turned
from line_slam_ros.geometry.lie import so3_log
from line_slam_ros.mapping.line_map import LineMap
from line_slam_ros.types import (
    F64,
    I64,
    U8,
    Calibration,
    Estimate,
    Frame,
    ImuBatch,
    LineSegments,
    Observations,
    RigCorrection,
    Samples,
    Status,
)
from line_slam_ros.warm_up import warm_up

MAX_IMU_GAP_S = 0.2  # longer, and the motion in between is anyone's guess
MAX_REPEATED_S = 1.0  # longer with one and the same image while the camera turns, and the estimate is lost


class Slam:
    """Frames and inertial samples in, estimates and a line map out."""

    def __init__(self, config: Config, calibration: Calibration):
        self.config, self.calibration = config, calibration
        self.camera = Camera(calibration)
        self.front_end = FrontEnd(self.camera, config)
        self.line_map = LineMap(config.mapping)
        focal = self.camera.focal
        self.estimator = Estimator(config.estimator, calibration, focal, config.points.max_count,
                                   config.lines.max_count)
        self._bootstrap = Bootstrap(self.estimator, calibration)
        self._stillness = Stillness(focal, config.estimator.point_sigma_px)
        self.status, self.waiting_for, self.resets = Status.INITIALISING, 'first image', 0
        self.timings: dict[str, float] = {}
        self._last_ns: int | None = None
        self._last_image: U8 | None = None
        self._kept: list[ImuBatch] = []  # of images left out since
        self._mapped = np.empty(0, np.int64)

    def warm_up(self, tell: Callable[[str], None] = print) -> None:
        """Compile every kernel, or load it from the cache, on throwaway copies fed with simulated data.

        tell is called with a sentence for the human when it takes long.
        """
        warm_up(FrontEnd(self.camera, self.config), self.calibration, self.config, tell)

    def process(self, frame: Frame, imu: ImuBatch, behind: bool = False) -> Estimate | None:
        """One frame and the inertial samples since the previous one; None until initialised and while lost.

        When the caller is behind, nothing new is detected in this frame unless few tracks are left.
        Raises ValueError for a frame that is not newer than the last, that no inertial sample
        accompanies, whose size is not the camera's, or that repeats the last one while the camera turns
        and is tracked; when that lasts, the estimate is lost.
        """
        self.timings = {}
        with self._timed('total'):
            imu = joined([*self._kept, imu])
            samples = None if self._last_ns is None else between(imu, self._last_ns, frame.t_ns)
            if samples is not None and self._repeats(frame, samples):
                if samples[0][-1] < MAX_REPEATED_S:
                    self._kept = [imu]
                    raise ValueError('the image is the last one again, though the camera turned: check the driver')
                self._last_ns, self._kept = frame.t_ns, []
                return self._lose(f'the same image for {samples[0][-1]:.1f} s, though the camera turned')
            with self._timed('track'):
                observations = self.front_end.track(frame, self._camera_rotation(samples), skip_detection=behind)
            self._kept, self._last_image = [], frame.image
            previous_ns, self._last_ns = self._last_ns, frame.t_ns
            still = self._stillness.add(observations, samples)
            if samples is not None and (gap := longest_gap(imu, previous_ns, frame.t_ns)) > MAX_IMU_GAP_S:
                if self.status is Status.TRACKING:
                    return self._lose(f'no inertial data for {gap:.2f} s')
                samples = None  # a start begins after it
            if self.status is not Status.TRACKING or samples is None:
                return self._initialise(observations, samples, still)
            try:
                return self._follow(observations, samples, still)
            except np.linalg.LinAlgError as error:
                return self._lose(f'equations without a solution ({error})')

    def _follow(self, observations: Observations, samples: Samples, still: bool) -> Estimate | None:
        """One frame through the running estimator and the map."""
        with self._timed('optimise'):
            outliers = self.estimator.step(observations, samples, still)
            self.front_end.forget(*outliers)
            self._drop(outliers[1])
        if self.estimator.failure:
            return self._lose(self.estimator.failure)
        estimate = self._estimate(samples)
        if estimate.is_keyframe and self.config.use_lines:
            with self._timed('map'):
                self._map()
        with self._timed('marginalise'):
            self.estimator.marginalise()
        return estimate

    def reset(self, reason: str) -> None:
        """Start anew: time, map and origin."""
        self.resets += 1
        self.status, self.waiting_for = Status.INITIALISING, reason
        self._forget()
        self._bootstrap.anchor = None
        self.line_map.clear()
        self._last_ns, self._kept = None, []

    def rig(self) -> RigCorrection:
        """How far the calibration of camera and IMU was refined."""
        return self.estimator.rig()

    def active_lines(self) -> LineSegments:
        """The lines the window sees now."""
        return self.line_map.active()

    def points(self) -> F64:
        """Landmarks (N, 3) of the window in W."""
        return self.estimator.points()

    def _initialise(self, observations: Observations, samples: Samples | None, still: bool) -> Estimate | None:
        with self._timed('initialise'):
            started = self._bootstrap.add(observations, samples, self._stillness.mean_imu() if still else None)
        self.waiting_for = self._bootstrap.waiting_for
        if not started or samples is None:
            return None
        self.status, self.waiting_for = Status.TRACKING, ''
        return self._estimate(samples)

    def _lose(self, reason: str) -> None:
        self.resets += 1
        self.status, self.waiting_for = Status.LOST, f'a new start, lost: {reason}'
        self._forget()

    def _forget(self) -> None:
        """Drop the window but not the map; the next start continues where it ended."""
        self._bootstrap.anchor = self.estimator.last_good()
        self.line_map.retire(self._mapped)
        self._mapped = np.empty(0, np.int64)
        self._bootstrap.clear()
        self._stillness.clear()
        self.front_end.reset()

    def _repeats(self, frame: Frame, samples: Samples) -> bool:
        """Whether the image is the last one to the bit although the body turned faster than a body at rest may.

        An image without any contrast is none: a covered lens sees the same wherever it turns.
        """
        if (self.status is not Status.TRACKING or not np.array_equal(frame.image, self._last_image)
                or frame.image.min() == frame.image.max()):
            return False
        t, gyro, _ = samples
        angle = np.linalg.norm(so3_log(turned(t, gyro, self.estimator.gyro_bias())))
        return bool(angle > MAX_GYRO_STD * t[-1])

    def _camera_rotation(self, samples: Samples | None) -> F64 | None:
        """R_CnCp by the gyro: turns rays of the previous camera into the newest."""
        if samples is None:
            return None
        t, gyro, _ = samples
        R_BC = self.estimator.window.R_BC
        return R_BC.T @ turned(t, gyro, self.estimator.gyro_bias()).T @ R_BC

    def _map(self) -> None:
        """Hand the window's lines to the map, new ones with all their views; retire those that left it."""
        lines, newest = self.estimator.lines(), self.estimator.window.n - 1
        self.line_map.refine(lines.ids, lines.pluecker, lines.cov, lines.views)
        new = ~np.isin(lines.ids, self._mapped)
        for slot, T_WC in enumerate(lines.T_WC):
            given = lines.seen[:, slot] & (new | (slot == newest))
            if given.any():
                self.line_map.observe(lines.ids[given], lines.ends[given, slot], T_WC)
        self.line_map.retire(np.setdiff1d(self._mapped, lines.ids))
        self._mapped = lines.ids

    def _drop(self, line_ids: I64) -> None:
        """Lines that turned out wrong never reach the map."""
        if not len(line_ids):
            return
        wrong = np.intersect1d(line_ids, self._mapped)
        self.line_map.drop(wrong)
        self._mapped = np.setdiff1d(self._mapped, wrong)

    def _estimate(self, samples: Samples) -> Estimate:
        w = self.estimator.window
        k, gyro = w.n - 1, samples[1]
        T_WB = np.eye(4)
        T_WB[:3, :3], T_WB[:3, 3] = w.R[k], w.p[k]
        gyro_bias, accel_bias = w.b[k, :3].copy(), w.b[k, 3:].copy()
        return Estimate(int(w.t_ns[k]), T_WB, w.v[k].copy(), gyro[-1] - gyro_bias, gyro_bias, accel_bias,
                        self.estimator.covariance(), self.estimator.newest_is_keyframe, self.timings)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.timings[stage] = time.perf_counter() - started
