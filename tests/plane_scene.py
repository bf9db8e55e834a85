"""Images of a textured plane seen by a moving pinhole camera: every pixel's motion is known exactly."""
from __future__ import annotations

import cv2
import numpy as np

from line_slam_ros.geometry.camera import Camera
from line_slam_ros.geometry.lie import so3_exp
from line_slam_ros.types import F64, U8, Calibration

WIDTH, HEIGHT, FOCAL = 320, 240, 200.0
K = np.array([[FOCAL, 0.0, 160.0], [0.0, FOCAL, 120.0], [0.0, 0.0, 1.0]])
MARGIN = 200  # px of scene around the first view
DEPTH = 2.0  # m


def pinhole() -> Camera:
    """The camera of these scenes; it has no distortion."""
    intrinsics = (FOCAL, FOCAL, 160.0, 120.0)
    return Camera(Calibration('radtan', WIDTH, HEIGHT, intrinsics, (0.0, 0.0, 0.0, 0.0), np.eye(4)))


def mosaic(seed: int = 1) -> U8:
    """Scene of random grey rectangles, a little blurred; (HEIGHT + 2 MARGIN, WIDTH + 2 MARGIN)."""
    rng = np.random.default_rng(seed)
    scene = np.full((HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN), 128, np.uint8)
    for _ in range(400):
        u, v, w, h = rng.integers(0, 700), rng.integers(0, 620), rng.integers(25, 110), rng.integers(25, 110)
        cv2.rectangle(scene, (int(u), int(v)), (int(u + w), int(v + h)), int(rng.integers(20, 235)), -1)
    return cv2.GaussianBlur(scene, (0, 0), 1.2)


def step_edge(u0: float, v0: float, angle: float, low: float = 60.0, high: float = 180.0) -> U8:
    """Scene with one edge through pixel (u0, v0) of the first view, brighter on the side of (-sin, cos) of angle."""
    v, u = np.mgrid[: HEIGHT + 2 * MARGIN, : WIDTH + 2 * MARGIN] - float(MARGIN)
    distance = -(u - u0) * np.sin(angle) + (v - v0) * np.cos(angle)
    return np.rint(low + (high - low) * 0.5 * (1.0 + np.tanh(0.9 * distance))).astype(np.uint8)


def homography(w: F64, p: F64) -> F64:
    """Pixels of the first view to those of a camera turned by Exp(w) and standing at p m, both in the first's frame."""
    R, normal = so3_exp(np.asarray(w, float)).T, np.array([0.0, 0.0, 1.0])
    return K @ (R @ (np.eye(3) - np.outer(p, normal) / DEPTH)) @ np.linalg.inv(K)


def view(scene: U8, H: F64, gain: float = 1.0, noise: float = 0.0, seed: int = 0) -> U8:
    """Image (HEIGHT, WIDTH) of scene; H from homography()."""
    offset = np.array([[1.0, 0.0, -MARGIN], [0.0, 1.0, -MARGIN], [0.0, 0.0, 1.0]])
    image = cv2.warpPerspective(scene, H @ offset, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC,
                                borderMode=cv2.BORDER_REPLICATE)
    rough = gain * image + np.random.default_rng(seed).normal(0.0, noise, image.shape)
    return np.clip(np.rint(rough), 0, 255).astype(np.uint8)


def move(H: F64, uv: F64) -> F64:
    """Pixels (..., 2) of the first view in the other."""
    ray = np.asarray(uv) @ H[:, :2].T + H[:, 2]
    return ray[..., :2] / ray[..., 2:]
