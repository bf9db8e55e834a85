"""Core types to messages; ``new`` is a MessageFactory (live or bag), ``t_ns`` a sensor stamp.

World messages live in ``frame_id`` (REP 105: odom), the body is ``child_frame_id``.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from line_slam_ros.geometry.lie import quaternion_from_matrix
from line_slam_ros.ros_conventions import linear_velocity, pose_covariance, twist_covariance
from line_slam_ros.types import F64, U8, Calibration, Estimate, Status
from msg_adapters.factories import MessageFactory

Colour = tuple[float, float, float, float]  # red, green, blue, alpha, 0..1
MAP_COLOUR: Colour = (0.1, 0.45, 0.9, 1.0)
ACTIVE_COLOUR: Colour = (1.0, 0.55, 0.0, 1.0)
_LEVELS = {Status.TRACKING: 0, Status.INITIALISING: 1, Status.LOST: 2}  # DiagnosticStatus OK, WARN, ERROR
_LINE_LIST, _ADD = 5, 0  # visualization_msgs/Marker
_FLOAT32 = 7  # sensor_msgs/PointField


def header(new: MessageFactory, t_ns: int, frame_id: str) -> Any:
    """std_msgs/Header with the stamp t_ns (nanoseconds)."""
    return new('std_msgs/msg/Header', stamp=_time(new, t_ns), frame_id=frame_id)


def odometry(new: MessageFactory, estimate: Estimate, frame_id: str, child_frame_id: str,
             gyro_variance: float = 0.0) -> Any:
    """nav_msgs/Odometry: pose in frame_id, twist in child_frame_id, both with covariance."""
    twist = new('geometry_msgs/msg/Twist', linear=_vector(new, linear_velocity(estimate)),
                angular=_vector(new, estimate.omega_B))
    return new('nav_msgs/msg/Odometry', header=header(new, estimate.t_ns, frame_id), child_frame_id=child_frame_id,
               pose=_pose_with_covariance(new, estimate),
               twist=new('geometry_msgs/msg/TwistWithCovariance', twist=twist,
                         covariance=twist_covariance(estimate, gyro_variance).ravel()))


def pose(new: MessageFactory, estimate: Estimate, frame_id: str) -> Any:
    """geometry_msgs/PoseWithCovarianceStamped of the body."""
    return new('geometry_msgs/msg/PoseWithCovarianceStamped', header=header(new, estimate.t_ns, frame_id),
               pose=_pose_with_covariance(new, estimate))


def pose_stamped(new: MessageFactory, t_ns: int, T_WB: F64, frame_id: str) -> Any:
    """geometry_msgs/PoseStamped of the body."""
    return new('geometry_msgs/msg/PoseStamped', header=header(new, t_ns, frame_id), pose=_pose(new, T_WB))


def transform(new: MessageFactory, t_ns: int, T_AB: F64, frame_id: str, child_frame_id: str) -> Any:
    """geometry_msgs/TransformStamped: child B in parent A."""
    return new('geometry_msgs/msg/TransformStamped', header=header(new, t_ns, frame_id), child_frame_id=child_frame_id,
               transform=new('geometry_msgs/msg/Transform', translation=_vector(new, T_AB[:3, 3]),
                             rotation=_quaternion(new, T_AB[:3, :3])))


def tf(new: MessageFactory, transforms: Sequence[Any]) -> Any:
    """tf2_msgs/TFMessage."""
    return new('tf2_msgs/msg/TFMessage', transforms=list(transforms))


def clock(new: MessageFactory, t_ns: int) -> Any:
    """rosgraph_msgs/Clock."""
    return new('rosgraph_msgs/msg/Clock', clock=_time(new, t_ns))


def lines_marker(new: MessageFactory, frame_id: str, namespace: str, colour: Colour, width: float) -> Any:
    """visualization_msgs/Marker LINE_LIST without points, which marker_bytes.py adds; one marker (namespace, 0),
    replaced each time."""
    return new('visualization_msgs/msg/Marker', header=header(new, 0, frame_id), ns=namespace, id=0,
               type=_LINE_LIST, action=_ADD, pose=_pose(new, np.eye(4)), scale=_vector(new, (width, 0.0, 0.0)),
               color=_colour(new, colour), lifetime=new('builtin_interfaces/msg/Duration', sec=0, nanosec=0),
               frame_locked=False, points=[], colors=[],
               texture_resource='', texture=_no_image(new, frame_id), uv_coordinates=[], text='', mesh_resource='',
               mesh_file=new('visualization_msgs/msg/MeshFile', filename='', data=new.octets(np.zeros(0, np.uint8))),
               mesh_use_embedded_materials=False)


def points_cloud(new: MessageFactory, points_W: F64, t_ns: int, frame_id: str) -> Any:
    """sensor_msgs/PointCloud2 with float32 x, y, z of points (N, 3) m."""
    xyz = np.ascontiguousarray(points_W, '<f4').reshape(-1, 3)
    field = [new('sensor_msgs/msg/PointField', name=name, offset=4 * i, datatype=_FLOAT32, count=1)
             for i, name in enumerate('xyz')]
    return new('sensor_msgs/msg/PointCloud2', header=header(new, t_ns, frame_id), height=1, width=len(xyz),
               fields=field, is_bigendian=False, point_step=12, row_step=12 * len(xyz),
               data=new.octets(xyz.view(np.uint8).ravel()), is_dense=True)


def image(new: MessageFactory, pixels: U8, t_ns: int, frame_id: str) -> Any:
    """sensor_msgs/Image of (H, W) grey or (H, W, 3) BGR pixels."""
    height, width = pixels.shape[:2]
    return new('sensor_msgs/msg/Image', header=header(new, t_ns, frame_id), height=height, width=width,
               encoding='mono8' if pixels.ndim == 2 else 'bgr8', is_bigendian=0,
               step=pixels.size // height, data=new.octets(np.ascontiguousarray(pixels).ravel()))


def compressed_image(new: MessageFactory, data: bytes, encoding: str, t_ns: int, frame_id: str) -> Any:
    """sensor_msgs/CompressedImage of encoded bytes; encoding 'jpeg' or 'png'."""
    return new('sensor_msgs/msg/CompressedImage', header=header(new, t_ns, frame_id), format=encoding,
               data=new.octets(np.frombuffer(data, np.uint8)))


def camera_info(new: MessageFactory, calibration: Calibration, t_ns: int, frame_id: str) -> Any:
    """sensor_msgs/CameraInfo of an unrectified monocular camera."""
    fx, fy, cx, cy = calibration.intrinsics
    region = new('sensor_msgs/msg/RegionOfInterest', x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return new('sensor_msgs/msg/CameraInfo', header=header(new, t_ns, frame_id), height=calibration.height,
               width=calibration.width, distortion_model=_ros_model(calibration), d=np.array(calibration.distortion),
               k=np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]), r=np.eye(3).ravel(),
               p=np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
               binning_x=0, binning_y=0, roi=region)


def imu(new: MessageFactory, t_ns: int, gyro_B: F64, accel_B: F64, frame_id: str) -> Any:
    """sensor_msgs/Imu without orientation, which its covariance says with -1."""
    unknown = np.zeros(9)
    return new('sensor_msgs/msg/Imu', header=header(new, t_ns, frame_id),
               orientation=new('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0),
               orientation_covariance=np.array([-1.0] + [0.0] * 8),
               angular_velocity=_vector(new, gyro_B), angular_velocity_covariance=unknown,
               linear_acceleration=_vector(new, accel_B), linear_acceleration_covariance=unknown)


def diagnostics(new: MessageFactory, t_ns: int, status: Status, waiting_for: str, values: Mapping[str, Any],
                name: str = 'line_slam', warnings: Sequence[str] = ()) -> Any:
    """diagnostic_msgs/DiagnosticArray: estimator status, what it waits for, warnings, and named values as text."""
    level = max(_LEVELS[status], 1 if warnings else 0)
    entry = new('diagnostic_msgs/msg/DiagnosticStatus', level=_byte(new, level), name=name, hardware_id='',
                message='; '.join(filter(None, (status.value, waiting_for, *warnings))),
                values=[new('diagnostic_msgs/msg/KeyValue', key=key, value=str(v)) for key, v in values.items()])
    return new('diagnostic_msgs/msg/DiagnosticArray', header=header(new, t_ns, ''), status=[entry])


def _ros_model(calibration: Calibration) -> str:
    if calibration.model == 'equidistant':
        return 'equidistant'
    return 'rational_polynomial' if len(calibration.distortion) > 5 else 'plumb_bob'


def _time(new: MessageFactory, t_ns: int) -> Any:
    sec, nanosec = divmod(int(t_ns), 1_000_000_000)
    return new('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)


def _vector(new: MessageFactory, v: Sequence[float] | F64) -> Any:
    x, y, z = map(float, v)
    return new('geometry_msgs/msg/Vector3', x=x, y=y, z=z)


def _quaternion(new: MessageFactory, R: F64) -> Any:
    x, y, z, w = map(float, quaternion_from_matrix(R))
    return new('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)


def _pose(new: MessageFactory, T: F64) -> Any:
    x, y, z = map(float, T[:3, 3])
    return new('geometry_msgs/msg/Pose', position=new('geometry_msgs/msg/Point', x=x, y=y, z=z),
               orientation=_quaternion(new, T[:3, :3]))


def _pose_with_covariance(new: MessageFactory, estimate: Estimate) -> Any:
    return new('geometry_msgs/msg/PoseWithCovariance', pose=_pose(new, estimate.T_WB),
               covariance=pose_covariance(estimate).ravel())


def _colour(new: MessageFactory, colour: Colour) -> Any:
    r, g, b, a = map(float, colour)
    return new('std_msgs/msg/ColorRGBA', r=r, g=g, b=b, a=a)


def _no_image(new: MessageFactory, frame_id: str) -> Any:
    return new('sensor_msgs/msg/CompressedImage', header=header(new, 0, frame_id), format='',
               data=new.octets(np.zeros(0, np.uint8)))


def _byte(new: MessageFactory, value: int) -> Any:
    """A ROS 'byte' field is bytes of length one in rclpy, an int in bags: take the form its own constant has."""
    constant = new.type('diagnostic_msgs/msg/DiagnosticStatus').OK
    return bytes([value]) if isinstance(constant, bytes) else value
