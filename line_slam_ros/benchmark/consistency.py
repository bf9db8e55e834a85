"""Monte Carlo on simulated features: accuracy, and whether the covariance tells the truth.

Each run is a room of random points and lines with a random smooth motion in it, or a walk along a corridor, and
inertial data with noise as of EuRoC's IMU; every other run in a room starts from rest. The observations go to the
estimator without images, the start included.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context

import numpy as np

from line_slam_ros.benchmark.nees import gauge, line_nees, state_nees
from line_slam_ros.config import Estimator as Options
from line_slam_ros.config import Mapping
from line_slam_ros.estimation.bootstrap import drive
from line_slam_ros.estimation.estimator import Estimator
from line_slam_ros.geometry.lie import rigid, rigid_inverse, transform_points
from line_slam_ros.mapping.fusion import worst_sigma
from line_slam_ros.simulation.features import Room, Trajectory, calibration
from line_slam_ros.simulation.features import Sequence as Simulated
from line_slam_ros.types import F64, LineObservations

FOCAL_PX = 450.0  # of simulation.features.calibration
MAX_POINTS, MAX_LINES = 700, 150
REST_S = 1.5  # before every other run
GYRO_BIAS, ACCEL_BIAS = 0.02, 0.05  # rad/s, m/s^2: standard deviations of the true biases
NO_LINES = LineObservations(np.empty(0, np.int64), np.empty((0, 2, 2)), np.empty((0, 2)))


@dataclass(frozen=True, slots=True)
class World:
    """One run: everything follows from the seed."""

    seed: int
    seconds: float
    pixel_sigma: float  # px, of the observations; the estimator is told
    lines: bool
    place: str = 'room'  # or 'corridor'
    points: int = 600  # in it; about a sixth is in view at a time
    in_view: int = MAX_POINTS  # points used at a time, at most
    options: Options = field(default_factory=Options)

    def sequence(self) -> Simulated:
        rng = np.random.default_rng((self.seed, 1))
        gyro_bias, accel_bias = GYRO_BIAS * rng.normal(size=3), ACCEL_BIAS * rng.normal(size=3)
        if self.place == 'corridor':
            motion, room = Trajectory.walk(self.seed), Room.corridor(self.seed, self.points)
        else:
            motion, room = Trajectory.random(self.seed, REST_S * (self.seed % 2)), Room.random(self.seed, self.points)
        return Simulated(motion, room, calibration(), self.seconds, pixel_sigma=self.pixel_sigma, seed=self.seed,
                         max_points=self.in_view, gyro_bias=tuple(gyro_bias), accel_bias=tuple(accel_bias))


@dataclass
class Trace:
    """What one run did: newest states by time, and NEES by quantity; empty if it never started."""

    world: World
    failure: str = ''  # why it ended early or never started
    t_s: list[float] = field(default_factory=list)
    T_EB: list[F64] = field(default_factory=list)  # estimated, in the estimate's world E
    true_T_EB: list[F64] = field(default_factory=list)  # with start and heading of the estimate
    nees: dict[str, list[float]] = field(default_factory=dict)  # by quantity, at t_s; NaN where not computed

    def add(self, t_s: float, T_EB: F64, true_T_EB: F64, nees: dict[str, float]) -> None:
        self.t_s.append(t_s)
        self.T_EB.append(T_EB)
        self.true_T_EB.append(true_T_EB)
        for name, value in nees.items():
            self.nees.setdefault(name, []).append(value)


def simulate(world: World) -> Trace:
    """One run from its first frame to its end or failure."""
    sequence, trace = world.sequence(), Trace(world, 'never started')
    options = replace(world.options, point_sigma_px=world.pixel_sigma)
    estimator = Estimator(options, sequence.calibration, FOCAL_PX, MAX_POINTS, MAX_LINES)
    steps = ((seen if world.lines else replace(seen, lines=NO_LINES), samples) for seen, samples in sequence.steps())
    judge: Judge | None = None
    try:
        for _ in drive(estimator, sequence.calibration, steps):
            judge, trace.failure = judge or Judge(sequence, estimator), estimator.failure
            if trace.failure:
                break
            judge.record(trace)
    except np.linalg.LinAlgError as error:
        trace.failure = f'equations without a solution ({error})'
    return trace


class Judge:
    """Compares the newest state and the window's lines with the truth, moved to the gauge of the estimate: the first
    state of the window at the start, whose position and heading the estimator holds fixed."""

    def __init__(self, sequence: Simulated, estimator: Estimator) -> None:
        self._sequence, self._estimator = sequence, estimator
        w = estimator.window
        self._T_EW = gauge(rigid(w.R[0], w.p[0]), self._truth(w.t_ns[0])[0])
        self._next_lines_s = 0.0

    def record(self, trace: Trace) -> None:
        """The newest state, of which the estimator must not have marginalised anything yet."""
        w, k = self._estimator.window, self._estimator.window.n - 1
        t_s, (true_T_WB, true_v_W) = float(w.t_ns[k]) * 1e-9, self._truth(w.t_ns[k])
        T_EB, true_T_EB = rigid(w.R[k], w.p[k]), self._T_EW @ true_T_WB
        found = state_nees(T_EB, w.v[k], self._estimator.covariance(), true_T_EB, self._T_EW[:3, :3] @ true_v_W)
        found |= self._lines(t_s, T_EB, true_T_EB) if trace.world.lines else {}
        trace.add(t_s, T_EB, true_T_EB, found)

    def _truth(self, t_ns: int) -> tuple[F64, F64]:
        R, p, v, *_ = self._sequence.trajectory.at(np.array([t_ns * 1e-9]))
        return rigid(R[0], p[0]), v[0]

    def _lines(self, t_s: float, T_EB: F64, true_T_EB: F64) -> dict[str, float]:
        """Mean over the lines good enough for the map, at the first keyframe of each second that has such: as they
        stand in the world, and as seen from the newest pose, with that pose's own error taken out."""
        names = 'line in the world', 'line from the newest pose'
        if t_s < self._next_lines_s or not self._estimator.newest_is_keyframe:
            return dict.fromkeys(names, float('nan'))
        lines, options = self._estimator.lines(), Mapping()
        true_E = transform_points(self._T_EW, self._sequence.room.lines[lines.ids])
        sigma = worst_sigma(lines.pluecker, lines.cov, true_E)
        rows = np.flatnonzero((lines.views >= options.min_views) & (sigma <= options.max_sigma_m))
        if not len(rows):
            return dict.fromkeys(names, float('nan'))
        self._next_lines_s = np.floor(t_s) + 1.0
        seen = transform_points(T_EB @ rigid_inverse(true_T_EB), true_E)
        return {name: float(line_nees(lines.pluecker[rows], lines.cov[rows], true[rows]).mean())
                for name, true in zip(names, (true_E, seen), strict=True)}


def simulate_all(worlds: Sequence[World], jobs: int) -> Iterator[Trace]:
    """Traces in the order of the worlds, ``jobs`` processes at a time; with one, in this process."""
    if jobs == 1:
        yield from map(simulate, worlds)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context('spawn')) as pool:
        yield from pool.map(simulate, worlds)
