"""What flows between the rooms: immutable, stamped in integer nanoseconds, shapes stated.

Frames: W world (gravity along -z), B body = IMU, C camera (z forward). ``T_AB`` maps coordinates in B
to A. Normalised image coordinates ``x`` are undistorted, on the plane z = 1; pixels are ``uv``.
"""
from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
Samples = tuple[F64, F64, F64]  # t (N,) s from the first, gyro (N, 3) rad/s, accel (N, 3) m/s^2


class LineForm(IntEnum):
    """What the numbers of an estimated line are; geometry/line_forms.py has the mathematics of each."""

    ORTHONORMAL = 0  # frame U and angle phi, right update
    ORTHONORMAL_LEFT = 1  # the same storage, left update
    PLUECKER = 2  # six numbers, put back on the quadric n . d = 0 by each update
    ORTH4 = 3  # Euler angles of U and phi, as other line code stores it; refuses lines near its singularities
    HOST = 4  # inverse range and angle in the plane in which the first camera saw the line
    HOST_FREE = 5  # the same, and that plane may tilt: four degrees of freedom again

    @staticmethod
    def of(name: str) -> LineForm:
        """By its name in lower case. ValueError for another."""
        try:
            return LineForm[name.upper()]
        except KeyError:
            raise ValueError(f'line form must be one of {", ".join(LINE_FORMS)}, got {name!r}') from None

    @property
    def freedom(self) -> int:
        """Numbers that an update has."""
        return 2 if self is LineForm.HOST else 4


LINE_FORMS = tuple(form.name.lower() for form in LineForm)


class Loss(IntEnum):
    """What an outlier costs; factors/robust.py."""

    L2 = 0
    HUBER = 1
    CAUCHY = 2


@dataclass(frozen=True, slots=True)
class Frame:
    """One grey image, as received (distorted)."""

    t_ns: int
    image: U8  # (H, W), may be a read-only view of the message


@dataclass(frozen=True, slots=True)
class ImuBatch:
    """Consecutive inertial samples; for two frames, from at or before the first to at or after the second."""

    t_ns: I64  # (N,) strictly increasing
    gyro_B: F64  # (N, 3) rad/s
    accel_B: F64  # (N, 3) m/s^2, specific force (+9.81 on the upward axis at rest)


@dataclass(frozen=True, slots=True)
class PointObservations:
    """Corners seen in one frame; ids are stable over time and never reused."""

    ids: I64  # (N,)
    uv: F64  # (N, 2) px in the received (distorted) image
    x: F64  # (N, 2) normalised, undistorted


@dataclass(frozen=True, slots=True)
class LineObservations:
    """Straight segments seen in one frame; endpoint order is stable over time for an id."""

    ids: I64  # (M,)
    ends: F64  # (M, 2, 2) normalised, undistorted: first end, second end
    sigma: F64  # (M, 2) standard deviation of each end across the segment, normalised units


@dataclass(frozen=True, slots=True)
class Observations:
    """What the front end saw in one frame."""

    t_ns: int
    points: PointObservations
    lines: LineObservations


@dataclass(frozen=True, slots=True)
class RigCorrection:
    """What the estimator changed of the calibration of camera and IMU."""

    rotation_deg: float  # angle between the calibrated and the present R_BC
    shift_m: float  # between the calibrated and the present p_BC
    delay_s: float  # images were taken that much later than stamped


class Status(Enum):
    """What the estimator is doing."""

    INITIALISING = 'initialising'
    TRACKING = 'tracking'
    LOST = 'lost'


@dataclass(frozen=True, slots=True)
class Estimate:
    """Where the body was when the frame was taken."""

    t_ns: int
    T_WB: F64  # (4, 4)
    v_W: F64  # (3,) m/s
    omega_B: F64  # (3,) rad/s, bias removed
    gyro_bias: F64  # (3,) rad/s
    accel_bias: F64  # (3,) m/s^2
    cov: F64  # (9, 9) of [rotation in B, position in W, velocity in W]
    is_keyframe: bool
    timings: dict[str, float] = field(default_factory=dict)  # stage -> wall seconds


@dataclass(frozen=True, slots=True)
class LineSegments:
    """A set of 3D line segments, structure of arrays: the map, or the lines active in the window."""

    ids: I64  # (L,) stable landmark ids
    pluecker: F64  # (L, 6) [n, d] in W: n = p x d for any point p of the line, |d| = 1
    ends: F64  # (L, 2, 3) trimmed end points in W, m
    views: I64  # (L,) number of views that support the line
    sigma: F64  # (L,) m, standard deviation across the line at its worse end

    def __len__(self) -> int:
        return len(self.ids)

    @staticmethod
    def empty() -> LineSegments:
        return LineSegments(np.empty(0, np.int64), np.empty((0, 6)), np.empty((0, 2, 3)),
                            np.empty(0, np.int64), np.empty(0))


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Continuous-time noise densities, as Kalibr's imu.yaml gives them."""

    gyro_density: float = 1.7e-4  # rad/s/sqrt(Hz)
    gyro_walk: float = 2.0e-5  # rad/s^2/sqrt(Hz)
    accel_density: float = 2.0e-3  # m/s^2/sqrt(Hz)
    accel_walk: float = 3.0e-3  # m/s^3/sqrt(Hz)


@dataclass(frozen=True, slots=True)
class Calibration:
    """One camera and where it sits on the body; what CameraInfo, Kalibr files and parameters are turned into."""

    model: str  # 'radtan' (plumb_bob, rational_polynomial) or 'equidistant' (fisheye)
    width: int
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy px
    distortion: tuple[float, ...]  # radtan k1 k2 p1 p2 [k3 [k4 k5 k6]]; equidistant k1 k2 k3 k4
    T_BC: F64  # (4, 4) camera in body
    time_offset: float = 0.0  # s, t_imu = t_cam + time_offset (Kalibr's timeshift_cam_imu)
    imu_noise: ImuNoise = field(default_factory=ImuNoise)
