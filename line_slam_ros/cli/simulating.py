"""The work behind ``line_slam simulate corridor``."""
from __future__ import annotations

from collections.abc import Iterator
from heapq import merge
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from line_slam_ros.calibration import kalibr_text
from line_slam_ros.cli.bag_writer import BagWriter
from line_slam_ros.cli.results import TumWriter
from line_slam_ros.geometry.lie import rigid
from line_slam_ros.simulation.corridor import Corridor
from line_slam_ros.simulation.features import imu_readings
from line_slam_ros.simulation.rendering import CAMERA, Renderer
from line_slam_ros.simulation.walk import Walk
from line_slam_ros.types import Calibration
from msg_adapters import outputs
from msg_adapters.factories import MessageFactory

_START_NS = 1_700_000_000_000_000_000
_FRAME_RATE, _IMU_RATE = 20, 200  # Hz
_IMAGE, _INFO, _IMU, _TRUTH = '/cam0/image_raw', '/cam0/camera_info', '/imu0', '/ground_truth/pose'
_QUALITY = 95  # of JPEG
_GYRO_BIAS, _ACCEL_BIAS = (-0.002, 0.021, 0.077), (-0.02, 0.13, 0.07)  # rad/s, m/s^2, at the start
Stamped = tuple[int, str, Any]  # t_ns, topic, message


def record_corridor(directory: Path, seed: int = 0, speed: float = 1.2, sway: float = 1.0,
                    seconds: float | None = None, light: float = 1.0, texture: float = 1.0,
                    calibration: Calibration = CAMERA) -> int:
    """Writes bag, calibration.yaml, groundtruth.tum and gt_lines.csv; ValueError if a setting or DIR is of no use."""
    if seconds is not None and not seconds >= 0.1:
        raise ValueError(f'seconds must be at least 0.1, got {seconds:g}')
    corridor = Corridor.random(seed, texture)
    walk = Walk.along(corridor.route, seed, speed, sway)
    renderer = Renderer(corridor, calibration, walk, light, seed)
    seconds = min(seconds or walk.seconds, walk.seconds)
    directory.mkdir(parents=True, exist_ok=True)
    frames = int(seconds * _FRAME_RATE)
    with BagWriter(directory / 'bag') as bag, TumWriter(directory / 'groundtruth.tum') as truth:
        streams = merge(_images(bag.new, renderer, calibration, frames),
                        _readings(bag.new, walk, calibration, int(seconds * _IMU_RATE), seed, truth),
                        key=lambda stamped: stamped[0])
        for t_ns, topic, message in streams:
            bag.write(topic, t_ns, message)
    text = kalibr_text(calibration, 'cam0', _IMAGE, _IMU, _IMU_RATE)
    (directory / 'calibration.yaml').write_text(text, encoding='utf-8')
    edges = corridor.edges()
    np.savetxt(directory / 'gt_lines.csv', edges.reshape(-1, 6), fmt='%.5f', delimiter=',',
               header='x1 [m],y1 [m],z1 [m],x2 [m],y2 [m],z2 [m]')
    print(f'{directory}: {frames} images, {seconds:g} s, {corridor.length:.1f} m of corridor, {len(edges)} lines')
    return 0


def _images(new: MessageFactory, renderer: Renderer, calibration: Calibration, count: int) -> Iterator[Stamped]:
    """Each image, followed by its camera_info."""
    for k in tqdm(range(count), unit='image', desc='simulate', dynamic_ncols=True):
        t_ns = _START_NS + k * 10**9 // _FRAME_RATE
        jpeg = cv2.imencode('.jpg', renderer.image(k / _FRAME_RATE), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
        yield t_ns, f'{_IMAGE}/compressed', outputs.compressed_image(new, jpeg.tobytes(), 'jpeg', t_ns, 'cam0')
        yield t_ns, _INFO, outputs.camera_info(new, calibration, t_ns, 'cam0')


def _readings(new: MessageFactory, walk: Walk, calibration: Calibration, count: int, seed: int,
              truth: TumWriter) -> Iterator[Stamped]:
    """Each IMU reading with the true pose, which goes into the file, too."""
    rng = np.random.default_rng([seed, 2])
    imu = imu_readings(walk, calibration.imu_noise, count, _IMU_RATE, rng, _GYRO_BIAS, _ACCEL_BIAS)
    R, p, *_ = walk.at(imu.t_ns * 1e-9)
    for since, gyro_B, accel_B, T_WB in zip(imu.t_ns.tolist(), imu.gyro_B, imu.accel_B, rigid(R, p), strict=True):
        t_ns = _START_NS + since
        truth.add(t_ns, T_WB)
        yield t_ns, _IMU, outputs.imu(new, t_ns, gyro_B, accel_B, 'imu0')
        yield t_ns, _TRUTH, outputs.pose_stamped(new, t_ns, T_WB, 'world')
