"""Messages for tests, made the same way for rclpy and for bags."""
from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from line_slam_ros.geometry.lie import rigid, so3_exp
from line_slam_ros.types import Estimate
from msg_adapters import outputs
from msg_adapters.factories import MessageFactory, bag_messages, ros_messages

Vector = tuple[float, float, float]


def bag_factory() -> MessageFactory:
    stores = pytest.importorskip('rosbags.typesys')
    return bag_messages(stores.get_typestore(stores.Stores.ROS2_JAZZY))


def factory(kind: str) -> MessageFactory:
    """'bag' or 'ros'; skips the test where that kind of message is not installed."""
    if kind == 'bag':
        return bag_factory()
    pytest.importorskip('sensor_msgs.msg', reason='no ROS interface packages (pip install line_slam_ros[ros])')
    return ros_messages()


def image(new: MessageFactory, encoding: str, height: int, width: int, step: int, data: bytes,
          t_ns: int = 1_500_000_002, is_bigendian: int = 0) -> Any:
    return new('sensor_msgs/msg/Image', header=outputs.header(new, t_ns, 'cam0'), height=height, width=width,
               encoding=encoding, is_bigendian=is_bigendian, step=step, data=new.octets(np.frombuffer(data, np.uint8)))


def compressed(new: MessageFactory, data: bytes, t_ns: int = 1_500_000_002) -> Any:
    return new('sensor_msgs/msg/CompressedImage', header=outputs.header(new, t_ns, 'cam0'), format='jpeg',
               data=new.octets(np.frombuffer(data, np.uint8)))


def imu(new: MessageFactory, t_ns: int, gyro_B: Vector, accel_B: Vector) -> Any:
    def vector(v: Vector) -> Any:
        return new('geometry_msgs/msg/Vector3', x=v[0], y=v[1], z=v[2])
    unknown = np.zeros(9)
    return new('sensor_msgs/msg/Imu', header=outputs.header(new, t_ns, 'imu0'),
               orientation=new('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0),
               orientation_covariance=unknown,
               angular_velocity=vector(gyro_B), angular_velocity_covariance=unknown,
               linear_acceleration=vector(accel_B), linear_acceleration_covariance=unknown)


def camera_info(new: MessageFactory, k: tuple[float, ...] = (400.0, 0.0, 320.0, 0.0, 410.0, 240.0, 0.0, 0.0, 1.0),
                d: tuple[float, ...] = (-0.3, 0.1, 0.0, 0.0), model: str = 'plumb_bob',
                size: tuple[int, int] = (640, 480),
                binning: tuple[int, int] = (0, 0), roi: tuple[int, int, int, int] = (0, 0, 0, 0)) -> Any:
    """roi: x offset, y offset, width, height."""
    region = new('sensor_msgs/msg/RegionOfInterest', x_offset=roi[0], y_offset=roi[1], width=roi[2], height=roi[3],
                 do_rectify=False)
    return new('sensor_msgs/msg/CameraInfo', header=outputs.header(new, 0, 'cam0'), width=size[0], height=size[1],
               distortion_model=model, d=np.array(d, float), k=np.array(k, float), r=np.eye(3).ravel(), p=np.zeros(12),
               binning_x=binning[0], binning_y=binning[1], roi=region)


def estimate(seed: int = 0) -> Estimate:
    rng = np.random.default_rng(seed)
    root = 0.01 * rng.normal(size=(9, 9))
    T_WB = rigid(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    return Estimate(1_700_000_000_123_456_789, T_WB, rng.normal(size=3), rng.normal(size=3), np.zeros(3),
                    np.zeros(3), root @ root.T, True)
