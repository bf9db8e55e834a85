"""What the shells (node, replay) need besides the method: calibration, sources, frame names."""
from __future__ import annotations

from dataclasses import dataclass, field

from line_slam_ros.config import Checked, param


@dataclass(frozen=True)
class Node(Checked):
    """The live node only: quality of service, rates, where files go."""

    reliability: str = param('best_effort', 'of sensor subscriptions; best_effort also hears reliable publishers',
                             choices=('best_effort', 'reliable'))
    map_path: str = param('line_map', '~/save_map writes this path with .ply and .csv appended')
    map_rate: float = param(4.0, 'most line markers and point clouds per second of sensor time, Hz', 0.1, 100.0)
    path_rate: float = param(2.0, 'most path messages per second of sensor time, Hz', 0.1, 100.0)
    image_rate: float = param(5.0, 'most debug images per second of sensor time, Hz', 0.1, 100.0)
    line_width: float = param(0.015, 'width of the line markers, m', 1e-4, 10.0)
    input_timeout: float = param(3.0, 'a sensor silent for longer is reported, s of wall time', 0.1, 3600.0)


@dataclass(frozen=True)
class ShellConfig(Checked):
    """Parameters shared by the node and replay, at the top level of the same parameter file."""

    calibration_file: str = param('', 'Kalibr camchain(-imucam).yaml; empty: camera_info and T_body_camera')
    imu_calibration_file: str = param('', 'Kalibr imu.yaml; empty: imu0 in calibration_file, else default noise')
    camera_name: str = param('', 'camera in calibration_file, e.g. cam0; empty: its only camera')
    T_body_camera: tuple[float, ...] = param(
        (), '16 numbers, row by row: camera in body (IMU) coordinates; used when calibration_file is empty')
    time_offset: float = param(0.0, 't_imu - t_camera, s; used when calibration_file is empty', -10.0, 10.0)
    accel_scale: float = param(1.0, 'factor on the accelerometer; 9.80665 for a driver that reports g', 1e-3, 1e3)
    image_transport: str = param('auto', 'raw, compressed or auto (replay: what the bag has; node: raw)',
                                 choices=('auto', 'raw', 'compressed'))
    pose_source: str = param('imu', 'imu: estimate the poses; topic: take them from a topic and map lines only',
                             choices=('imu', 'topic'))
    odom_frame: str = param('odom', 'name of the world frame in outgoing messages')
    body_frame: str = param('imu_link', 'name of the body (IMU) frame in outgoing messages')
    max_frames: int = param(6, 'images waiting at most in the node; the oldest is dropped and counted', 1, 1000)
    node: Node = field(default_factory=Node)
