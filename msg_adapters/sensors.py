"""Sensor messages to core types, by field name: a live rclpy message or one read from a bag goes the same way.

Only fields are read here. ValueError says what is wrong with a message and what to do about it.
"""
from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from line_slam_ros.calibration import checked_calibration
from line_slam_ros.geometry.lie import matrix_from_quaternion, rigid
from line_slam_ros.types import F64, U8, Calibration, Frame, ImuNoise

# encoding -> bytes per channel, channels, conversion to grey
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    'mono8': (1, 1, None), '8UC1': (1, 1, None), 'mono16': (2, 1, None),
    'rgb8': (1, 3, cv2.COLOR_RGB2GRAY), 'bgr8': (1, 3, cv2.COLOR_BGR2GRAY), '8UC3': (1, 3, cv2.COLOR_BGR2GRAY),
    'rgba8': (1, 4, cv2.COLOR_RGBA2GRAY), 'bgra8': (1, 4, cv2.COLOR_BGRA2GRAY),
    'yuv422': (1, 2, cv2.COLOR_YUV2GRAY_UYVY), 'uyvy': (1, 2, cv2.COLOR_YUV2GRAY_UYVY),
    'yuv422_yuy2': (1, 2, cv2.COLOR_YUV2GRAY_YUY2), 'yuyv': (1, 2, cv2.COLOR_YUV2GRAY_YUY2),
}
_CDR = 4  # bytes before a serialised message
_CDR_HEADER = {order: struct.Struct(order + 'iII') for order in '<>'}
_CDR_IMU = {order: struct.Struct(order + '3d72x3d') for order in '<>'}
_JPEG, _PNG = b'\xff\xd8', b'\x89PNG'

Vector = tuple[float, float, float]


def stamp_ns(msg: Any) -> int:
    """The header's stamp as integer nanoseconds."""
    stamp = msg.header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def image_to_frame(msg: Any) -> Frame:
    """sensor_msgs/Image to a grey frame; rows may be padded (step); mono8 is not copied."""
    if msg.encoding not in _ENCODINGS:
        raise ValueError(f'image encoding {msg.encoding!r} is not supported; publish {", ".join(_ENCODINGS)} '
                         '(debayer with image_proc, or set the driver)')
    depth, channels, to_grey = _ENCODINGS[msg.encoding]
    rows = _rows(msg, msg.width * channels * depth)
    if depth == 2:
        return Frame(stamp_ns(msg), _high_byte(rows, bool(msg.is_bigendian)))
    if to_grey is None:
        return Frame(stamp_ns(msg), rows)
    return Frame(stamp_ns(msg), cv2.cvtColor(rows.reshape(msg.height, msg.width, channels), to_grey))


def compressed_to_frame(msg: Any) -> Frame:
    """sensor_msgs/CompressedImage (JPEG, PNG, anything OpenCV decodes) to a grey frame."""
    data = np.frombuffer(msg.data, np.uint8)
    if not _is_complete(data):
        raise ValueError(f'compressed image ({msg.format!r}) is truncated: {len(data)} bytes; check the recording or '
                         'the network (large best-effort messages need the shipped Fast DDS profile)')
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
    if image is None:
        raise ValueError(f'compressed image ({msg.format!r}, {len(data)} bytes) cannot be decoded; publish JPEG or PNG')
    return Frame(stamp_ns(msg), image)


def imu_fields(msg: Any) -> tuple[int, Vector, Vector]:
    """sensor_msgs/Imu to (t_ns, gyro_B rad/s, accel_B m/s^2), as Inbox.imu takes them."""
    gyro, accel = msg.angular_velocity, msg.linear_acceleration
    return stamp_ns(msg), (gyro.x, gyro.y, gyro.z), (accel.x, accel.y, accel.z)


def imu_of_cdr(data: bytes | memoryview) -> tuple[int, Vector, Vector]:
    """A serialised sensor_msgs/Imu to what imu_fields makes of the message, thirty times as fast as by way of it.

    CDR: encapsulation (4 bytes), stamp, frame_id (uint32 and characters), padding to 8, then 37 doubles: orientation
    and its covariance (4 + 9), angular velocity (3 + 9), linear acceleration (3 + 9).
    """
    if len(data) < _CDR + 12 or data[0] != 0 or data[1] > 1:
        raise ValueError(f'IMU message of {len(data)} bytes is not in plain CDR')
    order = '<' if data[1] else '>'
    sec, nanosec, characters = _CDR_HEADER[order].unpack_from(data, _CDR)
    at = _CDR + (12 + characters + 7) // 8 * 8
    if not 0 <= len(data) - (at + 37 * 8) <= 3:  # a message may be padded to 4
        raise ValueError(f'IMU message of {len(data)} bytes has not the size of one')
    gx, gy, gz, ax, ay, az = _CDR_IMU[order].unpack_from(data, at + 13 * 8)
    return sec * 1_000_000_000 + nanosec, (gx, gy, gz), (ax, ay, az)


def camera_info_to_calibration(msg: Any, T_BC: F64, time_offset: float = 0.0,
                               imu_noise: ImuNoise | None = None) -> Calibration:
    """sensor_msgs/CameraInfo (with binning and region of interest) and the camera's place on the body (4, 4)."""
    where = f'camera_info of {msg.header.frame_id!r}'
    k, d = (msg.k, msg.d) if hasattr(msg, 'k') else (msg.K, msg.D)  # ROS 1 bags: capitals
    fx, _, cx, _, fy, cy, *_ = map(float, k)
    bx, by, roi = max(msg.binning_x, 1), max(msg.binning_y, 1), msg.roi
    size = ((roi.width or msg.width) // bx, (roi.height or msg.height) // by)
    intrinsics = (fx / bx, fy / by, (cx - roi.x_offset) / bx, (cy - roi.y_offset) / by)
    return checked_calibration(msg.distortion_model, size, intrinsics, list(d), T_BC, where,
                               time_offset=time_offset, imu_noise=imu_noise)


def pose_from_msg(msg: Any) -> tuple[int, F64]:
    """nav_msgs/Odometry, PoseWithCovarianceStamped or PoseStamped to (t_ns, T (4, 4)); ValueError if it is no pose."""
    pose = msg.pose.pose if hasattr(msg.pose, 'pose') else msg.pose
    p, q = pose.position, pose.orientation
    q_xyzw = np.array([q.x, q.y, q.z, q.w])
    norm = np.linalg.norm(q_xyzw)
    position = np.array([p.x, p.y, p.z])
    if not (np.isfinite(position).all() and 0.9 < norm < 1.1):
        raise ValueError(f'pose is not usable: position {position}, quaternion {q_xyzw}; check its publisher')
    return stamp_ns(msg), rigid(matrix_from_quaternion(q_xyzw / norm), position)


def _rows(msg: Any, row_bytes: int) -> U8:
    """(height, row_bytes) view of the image data without the padding."""
    step = msg.step or row_bytes
    data = np.frombuffer(msg.data, np.uint8)
    if msg.height < 1 or row_bytes < 1 or step < row_bytes:
        raise ValueError(f'image of {msg.width}x{msg.height} {msg.encoding} cannot have step {msg.step}; '
                         'check the driver')
    need = step * (msg.height - 1) + row_bytes  # the last row's padding may be missing
    if len(data) < need:
        raise ValueError(f'image data is truncated: {len(data)} bytes, {msg.width}x{msg.height} {msg.encoding} with '
                         f'step {step} needs {need}; check the driver or the recording')
    return np.lib.stride_tricks.as_strided(data, (msg.height, row_bytes), (step, 1), writeable=False)


def _high_byte(rows: U8, big_endian: bool) -> U8:
    """16-bit samples scaled to 8 bit."""
    return np.ascontiguousarray(rows[:, 0 if big_endian else 1::2])


def _is_complete(data: U8) -> bool:
    """Whether a JPEG or PNG has its end mark (decoders fill what is missing with grey); True for other formats."""
    head, tail = data[:4].tobytes(), data[-64:].tobytes().rstrip(b'\0')
    if head.startswith(_JPEG):
        return tail.endswith(b'\xff\xd9')
    return b'IEND' in tail if head.startswith(_PNG) else True
