"""A recording made worse, in core types: how much does the estimate depend on good data?

Pure functions of the datum and its stamp, so a degraded replay gives the same bytes twice; ``DegradedStream`` strings
them together for a replay. The estimator is never told: but for ``resize``, which any user would calibrate for, it gets
the calibration of the good recording, or in ``extrinsic_rotation_deg`` a worse one.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from math import inf
from typing import Any

import cv2
import numpy as np

from line_slam_ros.config import Checked, leaves, param
from line_slam_ros.geometry.lie import so3_exp
from line_slam_ros.types import U8, Calibration, Frame, ImuNoise

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Degradation(Checked):
    """What is done to a recording; by default nothing."""

    every_nth: int = param(1, 'only every n-th image is used', 1, 1000)
    imu_noise: float = param(1.0, 'white noise of gyro and accelerometer is this many times the calibrated one', 1.0,
                             100.0)
    brightness: float = param(1.0, 'factor on every grey value; below 1 is darker', 0.0, 10.0)
    ramp: float = param(0.0, 'brightness rises and falls linearly by this share, back and forth', 0.0, 1.0)
    ramp_period_s: float = param(10.0, 'of the ramp, up and down, s', 0.1, 1e4)
    jump: float = param(0.0, 'exposure jumps up and down by this share', 0.0, 1.0)
    jump_period_s: float = param(1.5, 'of the jumps, up and down, s', 0.02, 1e4)
    blur_px: float = param(0.0, 'standard deviation of a Gaussian blur, px', 0.0, 50.0)
    resize: float = param(1.0, 'images and calibration are scaled by this', 0.05, 1.0)
    time_offset_ms: float = param(0.0, 'stamps of the IMU run late by this; images and truth keep theirs, ms', -500.0,
                                  500.0)
    extrinsic_rotation_deg: float = param(0.0, 'the camera is calibrated wrong by this angle, about a random axis, deg',
                                          0.0, 180.0)
    seed: int = param(0, 'of noise and axis', 0)

    @staticmethod
    def of(values: Mapping[str, Any], where: str) -> Degradation:
        """From names and values; ValueError opens with ``where`` and names what is wrong."""
        known = {f.name for f in fields(Degradation)}
        for name in values:
            if name not in known:
                raise ValueError(f'{where}: unknown degradation {name!r}; use {", ".join(sorted(known))}')
        try:
            return Degradation(**values)
        except ValueError as error:
            raise ValueError(f'{where}: {error}') from None

    def changes(self) -> dict[str, Any]:
        """Name and value of everything that differs from the default."""
        return {name: value for name, f, value in leaves(self) if value != f.default}


def degraded_calibration(calibration: Calibration, wanted: Degradation) -> Calibration:
    """The calibration that goes with the degraded data: scaled, and turned by a wrong extrinsic rotation."""
    if wanted.resize != 1.0:
        calibration = _scaled(calibration, wanted.resize)
    if wanted.extrinsic_rotation_deg != 0.0:
        axis = np.random.default_rng(wanted.seed).normal(size=3)
        turn = so3_exp(np.radians(wanted.extrinsic_rotation_deg) * axis / np.linalg.norm(axis))
        T_BC = calibration.T_BC.copy()
        T_BC[:3, :3] = T_BC[:3, :3] @ turn
        calibration = replace(calibration, T_BC=T_BC)
    return calibration


def _scaled(calibration: Calibration, factor: float) -> Calibration:
    """Pixel centres lie on whole numbers: u' + 1/2 = s (u + 1/2), s by axis so that the sizes are whole."""
    width, height = scaled_size(calibration.width, calibration.height, factor)
    sx, sy = width / calibration.width, height / calibration.height
    fx, fy, cx, cy = calibration.intrinsics
    return replace(calibration, width=width, height=height,
                   intrinsics=(sx * fx, sy * fy, sx * (cx + 0.5) - 0.5, sy * (cy + 0.5) - 0.5))


def scaled_size(width: int, height: int, factor: float) -> tuple[int, int]:
    """Whole numbers of pixels, one at least."""
    return max(round(factor * width), 1), max(round(factor * height), 1)


def gain(t_ns: int, wanted: Degradation) -> float:
    """Factor on the grey values of the image taken at a time."""
    ramp = jump = 1.0
    if wanted.ramp:
        ramp += wanted.ramp * (4.0 * abs(_phase(t_ns, wanted.ramp_period_s) - 0.5) - 1.0)
    if wanted.jump:
        jump += wanted.jump if _phase(t_ns, wanted.jump_period_s) < 0.5 else -wanted.jump
    return wanted.brightness * ramp * jump


def _phase(t_ns: int, period_s: float) -> float:
    """Where in the period, in [0, 1)."""
    period_ns = round(period_s * 1e9)
    return (t_ns % period_ns) / period_ns


def degraded_image(image: U8, t_ns: int, wanted: Degradation) -> U8:
    """The image (H, W) blurred, then scaled, then exposed differently; the same array where nothing is asked."""
    if wanted.blur_px:
        image = cv2.GaussianBlur(image, (0, 0), wanted.blur_px)
    if wanted.resize != 1.0:
        height, width = image.shape
        image = cv2.resize(image, scaled_size(width, height, wanted.resize), interpolation=cv2.INTER_AREA)
    factor = gain(t_ns, wanted)
    return image if factor == 1.0 else cv2.convertScaleAbs(image, alpha=factor)


def extra_noise(t_ns: int, interval_s: float, noise: ImuNoise, wanted: Degradation) -> tuple[Vector, Vector]:
    """White noise of gyro (rad/s) and accelerometer (m/s^2) that, on top of the calibrated one, makes it
    ``imu_noise`` times as strong: the variances add. interval_s: between samples."""
    added = np.sqrt((wanted.imu_noise**2 - 1.0) / interval_s)
    draws = added * np.random.default_rng((wanted.seed, t_ns)).normal(size=(2, 3))
    return tuple((noise.gyro_density * draws[0]).tolist()), tuple((noise.accel_density * draws[1]).tolist())


class DegradedStream:
    """Frames and inertial samples of one recording on their way into a replay."""

    def __init__(self, wanted: Degradation, noise: ImuNoise) -> None:
        """noise: of the good recording."""
        self._wanted, self._noise = wanted, noise
        self._frames, self._last_imu_ns = 0, -inf
        self._offset_ns = round(wanted.time_offset_ms * 1e6)

    def frame(self, frame: Frame) -> Frame | None:
        """The frame made worse; None if it is left out."""
        self._frames += 1
        if (self._frames - 1) % self._wanted.every_nth:
            return None
        image = degraded_image(frame.image, frame.t_ns, self._wanted)
        return frame if image is frame.image else replace(frame, image=image)

    def imu(self, t_ns: int, gyro_B: Vector, accel_B: Vector) -> tuple[int, Vector, Vector]:
        """The sample made worse; the first, whose interval is not known, and those out of order get no noise."""
        interval_s, self._last_imu_ns = (t_ns - self._last_imu_ns) * 1e-9, t_ns
        if self._wanted.imu_noise > 1.0 and 0.0 < interval_s < inf:
            added = extra_noise(t_ns, interval_s, self._noise, self._wanted)
            gyro_B, accel_B = (tuple(a + b for a, b in zip(*pair, strict=True))
                               for pair in zip((gyro_B, accel_B), added, strict=True))
        return t_ns + self._offset_ns, gyro_B, accel_B
