"""What a camera on the move makes of a corridor: rays through the distorted pixels during the exposure, then a sensor.

Each pixel is the mean of samples spread over its area and over the exposure time, which blurs edges and motion as a
camera does. The sensor adds vignetting, shot and read noise, and sets exposure time, then gain, by the last image.
"""
from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from line_slam_ros.geometry.camera import Camera
from line_slam_ros.kernel_cache import inner, kernel
from line_slam_ros.simulation.corridor import HEIGHT, TEXEL, TILE, Corridor
from line_slam_ros.simulation.features import CAMERA_IN_BODY, Motion
from line_slam_ros.types import F64, U8, Calibration

CAMERA = Calibration('radtan', 752, 480, (458.0, 457.0, 367.0, 248.0), (-0.283, 0.074, 0.0002, 1.8e-5),
                     CAMERA_IN_BODY)
SAMPLES = 6, 24  # per pixel, fewest and most
SPREADING = 0.7548776662466927, 0.5698402909980532  # 1/g, 1/g^2 of g^3 = g + 1 (Roberts): samples keep apart
STREAK = 1.5  # px that one sample may stand for
TARGET = 0.42  # mean share of the full range that the exposure aims at
REACTION = 0.2  # share of the error in exposure (logarithmic) that one frame mends
SENSITIVITY = 220.0  # share of the full range per second at radiance 1, without gain
EXPOSURE = 5e-5, 0.02  # s, shortest and longest
MOST_GAIN = 16.0
FULL_WELL, READ_NOISE = 9000.0, 12.0  # electrons
VIGNETTING = 0.25  # share lost at one focal length from the principal point


@dataclass
class Sensor:
    """Grey values from radiance; the state is the exposure (gain times seconds) of the next image."""

    light: float  # factor on all radiance
    rng: np.random.Generator
    vignette: F64
    exposure: float = field(init=False)

    def __post_init__(self) -> None:
        if not 1e-4 <= self.light <= 1e4:
            raise ValueError(f'light must lie from 0.0001 to 10000, got {self.light:g}')
        self.exposure = TARGET / (SENSITIVITY * self.light * 0.3)

    @property
    def seconds(self) -> float:
        """Time that the next image is exposed."""
        return float(np.clip(self.exposure, *EXPOSURE))

    def expose(self, radiance: np.ndarray) -> U8:
        """(H, W) grey values; sets the next exposure by them."""
        gain = float(np.clip(self.exposure / self.seconds, 1.0, MOST_GAIN))
        electrons = radiance * self.vignette * np.float32(FULL_WELL * SENSITIVITY * self.light * self.seconds)
        noise = self.rng.standard_normal(radiance.shape, np.float32)
        share = (electrons + np.sqrt(electrons + np.float32(READ_NOISE**2)) * noise) * np.float32(gain / FULL_WELL)
        share = np.clip(share, 0.0, 1.0)
        self.exposure *= float(TARGET / max(share.mean(), 0.01)) ** REACTION
        self.exposure = float(np.clip(self.exposure, EXPOSURE[0], EXPOSURE[1] * MOST_GAIN))
        return np.rint(share * 255.0).astype(np.uint8)


class Renderer:
    """Images of a corridor, one after another."""

    def __init__(self, corridor: Corridor, calibration: Calibration, motion: Motion, light: float, seed: int) -> None:
        self._corridor, self._calibration, self._motion = corridor, calibration, motion
        height, width = calibration.height, calibration.width
        v, u = np.mgrid[:height + 1, :width + 1] - 0.5
        rays = Camera(calibration).normalise(np.column_stack([u.ravel(), v.ravel()]))
        self._rays = rays.reshape(height + 1, width + 1, 2)
        vignette = 1.0 / (1.0 + VIGNETTING * (self._rays[1:, 1:]**2).sum(axis=-1))
        self._sensor = Sensor(light, np.random.default_rng([seed, 1]), vignette.astype(np.float32))
        step = np.roll(corridor.outline, -1, axis=0) - corridor.outline
        length = np.linalg.norm(step, axis=1, keepdims=True)
        self._walls = np.column_stack([corridor.outline, step / length, length, corridor.first_column])
        self._radiance = np.empty((height, width), np.float32)

    def image(self, t: float) -> U8:
        """(H, W) grey values; t (s) is the middle of the exposure."""
        seconds = self._sensor.seconds
        _, _, v, omega, _ = self._motion.at(t)
        streak = self._calibration.intrinsics[0] * seconds * (np.linalg.norm(omega) + 0.5 * np.linalg.norm(v))
        count = int(np.clip(np.ceil(streak / STREAK), *SAMPLES))
        k = np.arange(count)
        R, p, *_ = self._motion.at(t + ((k + 0.5) / count - 0.5) * seconds)
        T_BC, c = self._calibration.T_BC, self._corridor
        offsets = np.outer(k, SPREADING) % 1.0
        offsets += 0.5 - offsets.mean(axis=0)  # the pixel is where its samples are on average
        _cast(self._rays, R @ T_BC[:3, :3], p + R @ T_BC[:3, 3], offsets, self._walls, c.walls, c.floor, c.ceiling,
              c.origin, self._radiance)
        return self._sensor.expose(self._radiance)


@inner
def _look(picture, x, y, left, right):
    """Bilinear value at x, y in texels; between columns left and right."""
    x, y = min(max(x - 0.5, left), right - 1.0), min(max(y - 0.5, 0.0), picture.shape[0] - 1.0)
    i, j = min(int(y), picture.shape[0] - 2), min(int(x), int(right) - 2)
    fx, fy = x - j, y - i
    return ((1.0 - fy) * ((1.0 - fx) * picture[i, j] + fx * picture[i, j + 1])
            + fy * ((1.0 - fx) * picture[i + 1, j] + fx * picture[i + 1, j + 1]))


@kernel
def _cast(rays, R_WC, p_WC, offsets, walls, picture, floor, ceiling, origin, radiance):
    """Fill radiance (H, W) with the means over samples (R_WC (S, 3, 3), p_WC (S, 3), offsets (S, 2) in the pixel).

    rays (H + 1, W + 1, 2): normalised coordinates of the corners of the pixels. walls (M, 6): begin, direction,
    length, first column.
    """
    samples, per_texel, per_tile, columns = len(offsets), 1.0 / TEXEL, 1.0 / TILE, float(floor.shape[1])
    for v in range(radiance.shape[0]):
        for u in range(radiance.shape[1]):
            x0, y0 = rays[v, u]
            right_x, right_y = rays[v, u + 1, 0] - x0, rays[v, u + 1, 1] - y0
            down_x, down_y = rays[v + 1, u, 0] - x0, rays[v + 1, u, 1] - y0
            total = 0.0
            for s in range(samples):
                a, b, R, p = offsets[s, 0], offsets[s, 1], R_WC[s], p_WC[s]
                x, y = x0 + a * right_x + b * down_x, y0 + a * right_y + b * down_y
                dx, dy = R[0, 0] * x + R[0, 1] * y + R[0, 2], R[1, 0] * x + R[1, 1] * y + R[1, 2]
                dz = R[2, 0] * x + R[2, 1] * y + R[2, 2]
                t, wall, along = np.inf, -1, 0.0
                for k in range(len(walls)):
                    ex, ey = walls[k, 2], walls[k, 3]
                    facing = dy * ex - dx * ey  # of the ray along the wall's normal, which points inward
                    if facing < 0.0:
                        to_x, to_y = walls[k, 0] - p[0], walls[k, 1] - p[1]
                        across = to_y * ex - to_x * ey
                        if 0.0 > across > t * facing:
                            at = across / facing
                            place = (at * dx - to_x) * ex + (at * dy - to_y) * ey
                            if 0.0 <= place <= walls[k, 4]:
                                t, wall, along = at, k, place
                z = p[2] + t * dz
                if z < 0.0 or z > HEIGHT:
                    t = ((0.0 if z < 0.0 else HEIGHT) - p[2]) / dz
                    i, j = (p[0] + t * dx - origin[0]) * per_tile, (p[1] + t * dy - origin[1]) * per_tile
                    total += _look(floor if z < 0.0 else ceiling, i, j, 0.0, columns)
                else:
                    first = walls[wall, 5]
                    total += _look(picture, first + along * per_texel, z * per_texel, first,
                                   first + walls[wall, 4] * per_texel)
            radiance[v, u] = total / samples
