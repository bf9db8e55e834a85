"""A room of known points and lines, a smooth trajectory with exact inertial data, and what a camera would track in it.

No images: observations come straight from the geometry, so estimators can be tested against exact
truth, in seconds, with any noise. Same seed, same numbers.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from line_slam_ros.geometry.imu import between
from line_slam_ros.geometry.lie import right_jacobian, so3_exp
from line_slam_ros.types import (
    F64,
    Calibration,
    ImuBatch,
    ImuNoise,
    LineObservations,
    Observations,
    PointObservations,
    Samples,
)

GRAVITY_W = np.array([0.0, 0.0, -9.81])
ROOM = np.array([6.0, 5.0, 2.5])  # m, walls at +- half in x and y, floor at 0
CORRIDOR = np.array([60.0, 2.2, 2.5])  # m, along x from the start
CAMERA_IN_BODY = np.array([[0.0, 0.0, 1.0, 0.02], [-1.0, 0.0, 0.0, -0.05], [0.0, -1.0, 0.0, 0.01],
                           [0.0, 0.0, 0.0, 1.0]])


class Motion(Protocol):
    """Where the body is and what an IMU there would measure without error."""

    def at(self, t: F64) -> tuple[F64, F64, F64, F64, F64]:
        """At times t (N,) s: R_WB (N, 3, 3), p_W, v_W, angular velocity in B, specific force in B, each (N, 3)."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Sums of sines in position (m) and rotation vector (rad), at rest before ``rest`` seconds."""

    amplitude: F64  # (K, 6) position and rotation vector
    frequency: F64  # (K, 6) rad/s
    phase: F64  # (K, 6)
    rest: float
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m/s, of a steady motion on top

    @staticmethod
    def random(seed: int, rest: float = 0.0, speed: float = 1.0) -> Trajectory:
        """Hand-held like motion about the room's middle; speed scales all frequencies."""
        rng = np.random.default_rng(seed)
        amplitude = rng.uniform(0.5, 1.0, (3, 6)) * np.array([0.5, 0.5, 0.25, 0.12, 0.12, 0.35])
        return Trajectory(amplitude, speed * rng.uniform(0.5, 2.0, (3, 6)), rng.uniform(0, 2 * np.pi, (3, 6)), rest)

    @staticmethod
    def walk(seed: int, speed: float = 0.8) -> Trajectory:
        """A walk along a corridor: steady, with the sway of a hand; it looks about by some 20 degrees."""
        sway = Trajectory.random(seed, speed=2.0)
        return Trajectory(sway.amplitude * np.array([0.15, 0.3, 0.3, 0.6, 0.6, 0.6]), sway.frequency, sway.phase, 0.0,
                          (speed, 0.0, 0.0))

    def _sums(self, t: F64) -> tuple[F64, F64, F64]:
        """Values (N, 6) and two derivatives; eased in from rest by a quintic time warp over one second."""
        s = np.clip(t - self.rest, 0.0, None)[:, None, None]
        u = np.minimum(s, 1.0)  # warp w(s): w = w' = w'' = 0 at 0, slope one after one second
        w, dw, ddw = u**4 - 0.6 * u**5 + (s - u), 4 * u**3 - 3 * u**4, 12 * u**2 - 12 * u**3
        a, f = self.amplitude, self.frequency
        sine, cosine = np.sin(f * w + self.phase), np.cos(f * w + self.phase)
        steady = np.array([*self.velocity, 0.0, 0.0, 0.0])
        return ((a * sine).sum(axis=1) + steady * w[:, 0], (a * f * cosine * dw).sum(axis=1) + steady * dw[:, 0],
                (a * f * (cosine * ddw - f * sine * dw**2)).sum(axis=1) + steady * ddw[:, 0])

    def at(self, t: F64) -> tuple[F64, F64, F64, F64, F64]:
        """R_WB (N, 3, 3), p_W, v_W, angular velocity in B, specific force in B, each (N, 3)."""
        x, dx, ddx = self._sums(np.atleast_1d(np.asarray(t, float)))
        R = so3_exp(x[:, 3:])
        omega = np.einsum('nij,nj->ni', right_jacobian(x[:, 3:]), dx[:, 3:])
        force = np.einsum('nji,nj->ni', R, ddx[:, :3] - GRAVITY_W)
        return R, x[:, :3] + [0.0, 0.0, 1.2], dx[:, :3], omega, force


@dataclass(frozen=True, slots=True)
class Room:
    """Points (N, 3) and line segments (L, 2, 3) on walls, floor and ceiling."""

    points: F64
    lines: F64

    @staticmethod
    def random(seed: int, points: int = 600, lines: int = 120) -> Room:
        """Lines run along the axes of the room, 0.5 to 2 m long, as in buildings."""
        return Room._furnished(seed, points, lines, ROOM)

    @staticmethod
    def corridor(seed: int, points: int = 1500, lines: int = 400) -> Room:
        """A long one along x, with doors, frames and skirtings."""
        room = Room._furnished(seed, points, lines, CORRIDOR)
        forward = np.array([CORRIDOR[0] / 2 - 3.0, 0.0, 0.0])
        return Room(room.points + forward, room.lines + forward)

    @staticmethod
    def _furnished(seed: int, points: int, lines: int, size: F64) -> Room:
        rng = np.random.default_rng(seed)
        middle = _on_walls(rng, lines, size)
        half = np.zeros((lines, 3))
        wall = np.argmax(np.abs(middle - [0, 0, size[2] / 2]) / (size / 2), axis=1)
        along = (wall + rng.integers(1, 3, lines)) % 3
        half[np.arange(lines), along] = rng.uniform(0.25, 1.0, lines)
        return Room(_on_walls(rng, points, size), np.stack([middle - half, middle + half], axis=1))


def _on_walls(rng: np.random.Generator, count: int, size: F64) -> F64:
    p = rng.uniform(-0.5, 0.5, (count, 3)) * size + [0, 0, size[2] / 2]
    wall, side = rng.integers(0, 3, count), rng.choice([-0.5, 0.5], count)
    p[np.arange(count), wall] = (side[:, None] * size + [0, 0, size[2] / 2])[np.arange(count), wall]
    return p


def calibration(noise: ImuNoise | None = None) -> Calibration:
    """An undistorted 640x480 camera looking along the body's x axis."""
    return Calibration('radtan', 640, 480, (450.0, 450.0, 320.0, 240.0), (0.0, 0.0, 0.0, 0.0), CAMERA_IN_BODY,
                       0.0, noise or ImuNoise())


def imu_readings(motion: Motion, noise: ImuNoise, count: int, rate: float, rng: np.random.Generator,
                 gyro_bias: ArrayLike, accel_bias: ArrayLike) -> ImuBatch:
    """The first ``count`` readings of an IMU at ``rate`` Hz: exact ones, with biases that walk and white noise."""
    t, root = np.arange(count) / rate, np.sqrt(rate)
    _, _, _, omega, force = motion.at(t)
    walk = rng.normal(size=(2, count, 3)).cumsum(axis=1) / root
    white = root * rng.normal(size=(2, count, 3))
    gyro = omega + gyro_bias + noise.gyro_walk * walk[0] + noise.gyro_density * white[0]
    accel = force + accel_bias + noise.accel_walk * walk[1] + noise.accel_density * white[1]
    return ImuBatch(np.round(t * 1e9).astype(np.int64), gyro, accel)


@dataclass(frozen=True, slots=True)
class Sequence:
    """A simulated recording: iterate for (Observations, ImuBatch), as Slam takes them."""

    trajectory: Trajectory
    room: Room
    calibration: Calibration
    seconds: float
    frame_rate: float = 20.0
    imu_rate: float = 200.0
    pixel_sigma: float = 0.3
    seed: int = 0
    max_points: int = 10**9  # seen at a time
    gyro_bias: tuple[float, float, float] = (0.01, -0.02, 0.03)
    accel_bias: tuple[float, float, float] = (0.05, -0.03, 0.08)

    def __iter__(self) -> Iterator[tuple[Observations, ImuBatch]]:
        rng = np.random.default_rng(self.seed)
        imu = self._imu(rng)
        previous = 0
        for k in range(int(self.seconds * self.frame_rate)):
            t_ns = round(k / self.frame_rate * 1e9)
            first = max(np.searchsorted(imu.t_ns, previous, side='right') - 1, 0)
            last = np.searchsorted(imu.t_ns, t_ns, side='left') + 1
            yield self.observe(t_ns, rng), ImuBatch(*(a[first:last] for a in (imu.t_ns, imu.gyro_B, imu.accel_B)))
            previous = t_ns

    def steps(self) -> Iterator[tuple[Observations, Samples | None]]:
        """As an estimator takes them: observations and the inertial samples since the previous ones, first None."""
        previous = None
        for seen, imu in self:
            yield seen, None if previous is None else between(imu, previous, seen.t_ns)
            previous = seen.t_ns

    def _imu(self, rng: np.random.Generator) -> ImuBatch:
        count = int(self.seconds * self.imu_rate) + 2
        return imu_readings(self.trajectory, self.calibration.imu_noise, count, self.imu_rate, rng, self.gyro_bias,
                            self.accel_bias)

    def observe(self, t_ns: int, rng: np.random.Generator) -> Observations:
        """What is in view at t_ns, with pixel noise."""
        R, p, *_ = self.trajectory.at(np.array([t_ns * 1e-9]))
        T_BC, fx = self.calibration.T_BC, self.calibration.intrinsics[0]
        R_WC, p_WC = R[0] @ T_BC[:3, :3], p[0] + R[0] @ T_BC[:3, 3]
        sigma = self.pixel_sigma / fx
        x, visible = self._project((self.room.points - p_WC) @ R_WC)
        ids = np.flatnonzero(visible)[:self.max_points]  # ids are in no order, so these are spread over the image
        z = x[ids] + sigma * rng.normal(size=(len(ids), 2))
        ends, seen = self._project((self.room.lines - p_WC) @ R_WC)
        lines = np.flatnonzero(seen.all(axis=1))
        noisy = ends[lines] + sigma * rng.normal(size=(len(lines), 2, 2))
        uv = z * fx + self.calibration.intrinsics[2:]
        return Observations(t_ns, PointObservations(ids, uv, z),
                            LineObservations(lines, noisy, np.full((len(lines), 2), max(sigma, 1e-6))))

    def _project(self, p_C: F64) -> tuple[F64, np.ndarray]:
        fx, fy, cx, cy = self.calibration.intrinsics
        depth = np.where(p_C[..., 2] > 0.2, p_C[..., 2], np.inf)
        x = p_C[..., :2] / depth[..., None]
        uv = x * [fx, fy] + [cx, cy]
        inside = (uv > 0).all(axis=-1) & (uv[..., 0] < self.calibration.width) & (uv[..., 1] < self.calibration.height)
        return x, inside & np.isfinite(depth)
