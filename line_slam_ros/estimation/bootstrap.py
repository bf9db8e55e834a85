"""Collects frames until the estimator can start, and says what it waits for."""
from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np

from line_slam_ros.estimation.estimator import Estimator
from line_slam_ros.estimation.initialisation import Snapshot, Start, start_in_motion, upright
from line_slam_ros.estimation.shift import matches
from line_slam_ros.estimation.stillness import SPAN_S, Stillness
from line_slam_ros.geometry.imu import chained
from line_slam_ros.geometry.lie import so3_exp
from line_slam_ros.types import F64, I64, Calibration, Observations, Samples

MIN_MATCHES = 10  # corners; their motion between two images has five unknowns
MIN_PARALLAX_PX = 15.0  # median shift, rotation included, between first and last frame
MIN_VIEWS = 4  # of a corner that says something about the quality of a start
MAX_CHI2 = 4.0  # median squared whitened residual of a refined start; 1.4 when the noise model is right
MAX_INERTIAL_CHI2 = 2.5  # mean squared whitened inertial residual; 1 when right, tens at a wrong scale
MAX_UNSETTLED = 10.0  # half squared standard deviations that another step would gain: more, and it is no minimum


class Bootstrap:
    """Start from rest as soon as the body is still, which needs no corners, from motion as soon as they show scale."""

    def __init__(self, estimator: Estimator, calibration: Calibration):
        self._estimator, self._calibration = estimator, calibration
        self._options = estimator.options
        self._shots: list[Snapshot] = []
        self._next_try_ns = 0
        self.anchor: tuple[F64, F64] | None = None  # position (3,) m of the first state in W, R_WB to take heading from
        self._unbroken_ns = 0  # since when every frame shares corners with the one before
        self.waiting_for = 'first image'

    def clear(self) -> None:
        self._shots.clear()
        self._next_try_ns = 0

    def add(self, observations: Observations, samples: Samples | None, still_imu: tuple[F64, F64] | None) -> bool:
        """Take a frame; True once the estimator's window is filled.

        samples: those since the previous frame; still_imu: mean rate and force when the body is at rest.
        """
        if samples is None:
            self._shots.clear()
        if not self._shots or len(matches(self._shots[-1].observations, observations)[0]) < MIN_MATCHES:
            self._unbroken_ns = observations.t_ns
        self._shots.append(Snapshot(observations.t_ns, observations, samples))
        horizon = observations.t_ns - int(self._options.init_window_s * 1e9)
        while len(self._shots) > 2 and self._shots[1].t_ns <= horizon:
            del self._shots[0]
        if still_imu is not None:
            return self._from_rest(observations.t_ns, *still_imu)
        return self._from_motion(observations.t_ns)

    def _from_rest(self, now_ns: int, rate: F64, force: F64) -> bool:
        strength = float(np.linalg.norm(force))
        if abs(strength - self._options.gravity) > 1.0:
            self.waiting_for = (f'gravity: the accelerometer reads {strength:.2f} m/s^2 at rest, '
                                f'{self._options.gravity} expected (are its units m/s^2?)')
            return False
        shots = self._spread(2, now_ns - int(SPAN_S * 1e9))  # before that it may have moved
        if len(shots) < 2:
            return False
        R = np.repeat(upright(force)[None], len(shots), axis=0)
        zeros = np.zeros((len(shots), 3))
        self._begin(shots, Start(R, zeros, zeros, rate), still=True)
        return True

    def _from_motion(self, now_ns: int) -> bool:
        needed = 0.5 * self._options.init_window_s
        if (now_ns - self._shots[0].t_ns) * 1e-9 < needed:
            self.waiting_for = f'{needed:.1f} s of images with inertial data'
            return False
        shots = self._spread(self._options.window - 1, self._unbroken_ns)
        span = (now_ns - shots[0].t_ns) * 1e-9
        if span < needed:
            self.waiting_for = (f'texture: {MIN_MATCHES} corners tracked from image to image over {needed:.1f} s; '
                                'lines alone need a start at rest: hold still for a second')
            return False
        if now_ns < self._next_try_ns:
            return False
        self._next_try_ns = now_ns + 100_000_000
        shift = self._shift(shots)
        if shift < MIN_PARALLAX_PX:
            self.waiting_for = f'motion: corners moved {shift:.0f} px in {span:.1f} s, {MIN_PARALLAX_PX:.0f} needed'
            return False
        start = start_in_motion(shots, self._calibration.T_BC, self._calibration.imu_noise, self._options.gravity)
        if start is None:
            self.waiting_for = 'motion that makes velocity and gravity observable: turn and accelerate the camera'
            return False
        self._begin(shots, start, still=False)
        self.waiting_for = self._refuse()
        return not self.waiting_for

    def _shift(self, shots: list[Snapshot]) -> float:
        """Median path of the corners over the snapshots, px, rotation included."""
        steps = [np.linalg.norm(y - x, axis=1) for x, y in (matches(a.observations, b.observations)
                                                            for a, b in pairwise(shots))]
        return float(sum(np.median(s) for s in steps if len(s))) * self._estimator.focal

    def _spread(self, count: int, since_ns: int) -> list[Snapshot]:
        """At most count snapshots evenly over those since a time, newest included, samples merged in between."""
        first = next(k for k, s in enumerate(self._shots) if s.t_ns >= since_ns)
        picked = np.unique(np.linspace(first, len(self._shots) - 1, count).round().astype(int))
        chosen = [self._shots[picked[0]]]
        for a, b in pairwise(picked):
            parts = [s.samples for s in self._shots[a + 1:b + 1] if s.samples is not None]
            chosen.append(Snapshot(self._shots[b].t_ns, self._shots[b].observations, chained(parts)))
        return chosen

    def _begin(self, shots: list[Snapshot], start: Start, still: bool) -> None:
        position, R_WB = self.anchor or (np.zeros(3), start.R_WB[0])
        turn = R_WB @ start.R_WB[0].T  # its part about the vertical that comes closest
        heading = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
        R = so3_exp(np.array([0.0, 0.0, heading]))
        placed = Start(R @ start.R_WB, start.p_W @ R.T + position, start.v_W @ R.T, start.gyro_bias)
        self._estimator.begin(placed, shots, still)
        self._estimator.refine(1 if still else 8)

    def _refuse(self) -> str:
        """Why a refined start from motion is not good enough, or ''."""
        e, w = self._estimator, self._estimator.window
        inertial = 2.0 * e.solver.inertial_cost() / (9 * (w.n - 1))
        if inertial > MAX_INERTIAL_CHI2:
            return (f'agreement of motion and inertial data (squared residual {inertial:.1f} per measurement, '
                    f'{MAX_INERTIAL_CHI2:.1f} allowed): keep moving; if it stays, calibrate the noise of the IMU and '
                    'how the camera is turned against it')
        rows = w.points.seen[:w.points.count, :w.n].sum(axis=1) >= MIN_VIEWS
        used = e.solver.points.chi2[:w.points.count, :w.n][rows]
        used = used[used >= 0.0]
        if rows.sum() < MIN_MATCHES:
            return f'corners that can be followed: {rows.sum()} in {MIN_VIEWS} views, {MIN_MATCHES} needed'
        if (corners := float(np.median(used))) > MAX_CHI2:
            return (f'agreement of motion and corners (squared residual {corners:.0f} per corner, {MAX_CHI2:.0f} '
                    'allowed): keep moving')
        if np.linalg.norm(w.b[w.n - 1, 3:]) > 5.0 * self._options.accel_bias_sigma:
            return 'a plausible accelerometer bias: accelerate the camera in several directions'
        moved = w.p[w.n - 1] - w.p[0]
        e.linearise()
        if e.solver.unsettled() > MAX_UNSETTLED:
            return 'metric scale: a first estimate that settles, accelerate the camera'
        cov = e.solver.covariance(e.window.n - 1)[3:6, 3:6]
        distance = max(float(np.linalg.norm(moved)), 1e-9)
        sigma = float(np.sqrt(moved @ cov @ moved)) / distance**2
        if sigma > self._options.init_max_scale_sigma:
            return f'metric scale: known to {100 * sigma:.0f} %, accelerate the camera'
        return ''


def drive(estimator: Estimator, calibration: Calibration, steps: Iterable[tuple[Observations, Samples | None]],
          ) -> Iterator[tuple[Observations, tuple[I64, I64]]]:
    """Feed an estimator frames, each with the samples since the one before.

    Yields, from the start on and before anything is marginalised, the frame and which points and lines were wrong.
    """
    bootstrap, none = Bootstrap(estimator, calibration), (np.empty(0, np.int64), np.empty(0, np.int64))
    stillness, started = Stillness(estimator.focal, estimator.options.point_sigma_px), False
    for seen, samples in steps:
        still = stillness.add(seen, samples)
        if started and samples is not None:
            outliers = estimator.step(seen, samples, still)
        else:
            outliers, started = none, bootstrap.add(seen, samples, stillness.mean_imu() if still else None)
        if started:
            yield seen, outliers
            estimator.marginalise()
