"""A recording shown at another pace: faster, or to and fro without end, with the inertial data that a body moving that
way would have measured.

Time t of the showing is time s(t) of the recording. The body is at p(s(t)) and R(s(t)), so its angular velocity is s'
times the recorded one and its acceleration s'^2 times the recorded one plus s'' times the velocity; gravity stays, and
so do the biases of the sensors, which is why the estimate of a run over the recording is needed.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from line_slam_ros.types import F64, I64, ImuBatch

GRAVITY_W = np.array([0.0, 0.0, -9.81])
CHUNK_S = 5.0  # of samples made at a time


@dataclass(frozen=True, slots=True)
class Motion:
    """What a run estimated of a recording."""

    t_ns: I64  # (N,) increasing
    T_WB: F64  # (N, 4, 4)
    v_W: F64  # (N, 3) m/s
    gyro_bias: F64  # (3,) rad/s
    accel_bias: F64  # (3,) m/s^2


class Pace(Protocol):
    """A law s(t); t starts at 0, s is in seconds since the first pose of the motion."""

    def at(self, t: F64) -> tuple[F64, F64, F64]:
        """s (N,) s, s' and s'' (N,) 1/s at t (N,) s."""

    def shown(self, s: F64) -> Iterator[tuple[float, int]]:
        """(t, k): when the frame k taken at s[k] is shown, in order; s (K,) increasing and within the law's range."""


@dataclass(frozen=True, slots=True)
class Faster:
    """The recording once, at a constant rate."""

    rate: float

    def at(self, t: F64) -> tuple[F64, F64, F64]:
        return self.rate * t, np.full_like(t, self.rate), np.zeros_like(t)

    def shown(self, s: F64) -> Iterator[tuple[float, int]]:
        yield from ((float(s_k) / self.rate, k) for k, s_k in enumerate(s))


@dataclass(frozen=True, slots=True)
class ToAndFro:
    """Forwards and backwards without end, starting at rest; it turns within ``turn`` seconds, smoothly."""

    seconds: float  # of the recording
    turn: float = 1.0

    def __post_init__(self) -> None:
        if self.seconds < self.turn:
            raise ValueError(f'{self.seconds:.2f} s with poses are too short to be shown to and fro')

    @property
    def _eased(self) -> float:
        """How much of the recording half a turn passes."""
        return self.turn / np.pi

    @property
    def _stroke(self) -> float:
        """From one end to the other, s."""
        return self.seconds - 2.0 * self._eased + self.turn

    def at(self, t: F64) -> tuple[F64, F64, F64]:
        phase = np.mod(t, 2.0 * self._stroke)
        back = phase > self._stroke
        forward = np.where(back, 2.0 * self._stroke - phase, phase)
        left = self._stroke - forward
        half, pace = 0.5 * self.turn, np.pi / self.turn
        angle = pace * np.minimum(np.minimum(forward, left), half)  # pi/2 where it runs at the recorded pace
        depth = self._eased * (1.0 - np.cos(angle))
        s = np.where(forward < half, depth, np.where(left < half, self.seconds - depth, self._eased + forward - half))
        ds = np.sin(angle) * np.where(back, -1.0, 1.0)
        dds = np.where(forward < half, 1.0, -1.0) * pace * np.cos(angle) * (np.minimum(forward, left) < half)
        return s, ds, dds

    def shown(self, s: F64) -> Iterator[tuple[float, int]]:
        last, stroke, forward = -1.0, 0, self._reached(s)
        while True:
            order = range(len(s)) if stroke % 2 == 0 else range(len(s) - 1, -1, -1)
            for k in order:
                within = forward[k] if stroke % 2 == 0 else self._stroke - forward[k]
                t = stroke * self._stroke + float(within)
                if t > last + 1e-6:  # a frame at the very turn is shown once
                    last = t
                    yield t, k
            stroke += 1

    def _reached(self, s: F64) -> F64:
        """When the first stroke reaches s (K,)."""
        near = np.minimum(s, self.seconds - s)
        eased = np.arccos(np.clip(1.0 - near / self._eased, 0.0, 1.0)) * self.turn / np.pi
        return np.where(s < self._eased, eased, np.where(self.seconds - s < self._eased, self._stroke - eased,
                                                         s - self._eased + 0.5 * self.turn))


def shown_imu(imu: ImuBatch, motion: Motion, pace: Pace, rate_hz: float) -> Iterator[tuple[int, F64, F64]]:
    """(t ns, gyro_B (3,), accel_B (3,)) without end, evenly at rate_hz; where the motion is not known, it ends."""
    turns = Slerp((motion.t_ns - motion.t_ns[0]) * 1e-9, Rotation.from_matrix(motion.T_WB[:, :3, :3]))
    t_imu, end = (imu.t_ns - motion.t_ns[0]) * 1e-9, (motion.t_ns[-1] - motion.t_ns[0]) * 1e-9
    count, first = max(int(CHUNK_S * rate_hz), 1), 0
    while True:
        index = np.arange(first, first + count)
        t = index / rate_hz
        s, ds, dds = pace.at(t)
        known = (s <= end) & (s <= t_imu[-1])
        kept = slice(0, len(t) if known.all() else int(np.argmin(known)))
        t, s, ds, dds = (a[kept] for a in (t, s, ds, dds))
        gyro, accel = _measured(imu, motion, turns, t_imu, s, ds, dds) if len(t) else (np.empty((0, 3)),) * 2
        yield from zip(np.round(t * 1e9).astype(np.int64).tolist(), gyro, accel, strict=True)
        if len(t) < count:
            return
        first += count


def _measured(imu: ImuBatch, motion: Motion, turns: Slerp, t_imu: F64, s: F64, ds: F64, dds: F64) -> tuple[F64, F64]:
    """Gyro and accelerometer (N, 3) at times s (N,) of a recording that is passed at the pace ds, changing by dds."""
    t_motion = (motion.t_ns - motion.t_ns[0]) * 1e-9
    gyro, accel, v_W = (np.column_stack([np.interp(s, t, column) for column in values.T])
                        for t, values in ((t_imu, imu.gyro_B), (t_imu, imu.accel_B), (t_motion, motion.v_W)))
    R_BW = turns(np.clip(s, 0.0, t_motion[-1])).inv()
    gravity_B = R_BW.apply(GRAVITY_W)
    motion_B = accel - motion.accel_bias + gravity_B  # acceleration, in B
    moved = ds[:, None]**2 * motion_B + dds[:, None] * R_BW.apply(v_W)
    return (ds[:, None] * (gyro - motion.gyro_bias) + motion.gyro_bias, moved - gravity_B + motion.accel_bias)


@dataclass(frozen=True, slots=True)
class Shown:
    """What comes next: a frame of the recording, or an inertial sample."""

    t_ns: int
    frame: int = -1  # of the recording; -1: a sample
    gyro_B: F64 | None = None
    accel_B: F64 | None = None


def showing(imu: ImuBatch, frames_ns: I64, motion: Motion, pace: Pace, rate_hz: float) -> Iterator[Shown]:
    """Frames and inertial samples in the order of their times, which start at 0; ends with either."""
    frames = pace.shown((frames_ns - motion.t_ns[0]) * 1e-9)
    upcoming = next(frames, None)
    for t_ns, gyro_B, accel_B in shown_imu(imu, motion, pace, rate_hz):
        while upcoming is not None and (due_ns := round(upcoming[0] * 1e9)) <= t_ns:
            yield Shown(due_ns, upcoming[1])
            upcoming = next(frames, None)
        if upcoming is None:
            return
        yield Shown(t_ns, -1, gyro_B, accel_B)


def frames_within(frames_ns: I64, motion: Motion) -> slice:
    """Which frames (K,) of a recording lie within the motion."""
    first, last = np.searchsorted(frames_ns, [motion.t_ns[0], motion.t_ns[-1] + 1])
    return slice(int(first), int(last))


def sample_rate(t_ns: I64) -> float:
    """Samples a second, by the median interval."""
    return 1e9 / float(np.median(np.diff(t_ns)))
