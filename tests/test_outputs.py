"""Messages carry what the core types say, in ROS conventions, and serialise both live and into bags."""
from __future__ import annotations

import message_samples as samples
import numpy as np
import pytest

from line_slam_ros.geometry.lie import so3_exp, so3_log
from line_slam_ros.ros_conventions import linear_velocity, pose_covariance, twist_covariance
from line_slam_ros.types import Status
from msg_adapters import outputs
from msg_adapters.estimate_bytes import EstimateBytes
from msg_adapters.factories import MessageFactory


@pytest.fixture(params=['bag', 'ros'])
def new(request: pytest.FixtureRequest) -> MessageFactory:
    return samples.factory(request.param)


def serialise(message: object) -> bytes:
    """CDR bytes with the library the message belongs to: fails if a field has the wrong type."""
    if hasattr(message, '__msgtype__'):
        from rosbags.typesys import Stores, get_typestore
        return bytes(get_typestore(Stores.ROS2_JAZZY).serialize_cdr(message, message.__msgtype__))
    from rclpy.serialization import serialize_message
    return serialize_message(message)


def xyz(v: object) -> list[float]:
    return [v.x, v.y, v.z]


def test_odometry(new):
    estimate = samples.estimate()
    message = outputs.odometry(new, estimate, 'odom', 'imu_link', gyro_variance=1e-4)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    assert (message.header.frame_id, message.child_frame_id) == ('odom', 'imu_link')
    np.testing.assert_array_equal(xyz(message.pose.pose.position), estimate.T_WB[:3, 3])
    np.testing.assert_allclose(xyz(message.twist.twist.linear), estimate.T_WB[:3, :3].T @ estimate.v_W)
    np.testing.assert_array_equal(xyz(message.twist.twist.angular), estimate.omega_B)
    np.testing.assert_array_equal(message.pose.covariance, pose_covariance(estimate).ravel())
    np.testing.assert_array_equal(message.twist.covariance, twist_covariance(estimate, 1e-4).ravel())
    assert serialise(message)


@pytest.mark.parametrize('frame,body', [('odom', 'imu_link'), ('map', 'b'), ('', 'body'), ('world', 'imu_0')])
def test_an_estimate_in_bytes_equals_its_messages_serialised(frame, body):
    new, estimate = samples.factory('bag'), samples.estimate()
    moved = outputs.transform(new, estimate.t_ns, estimate.T_WB, frame, body)
    assert EstimateBytes(new, serialise, frame, body)(estimate, 1e-4) == (
        serialise(outputs.tf(new, [moved])), serialise(outputs.odometry(new, estimate, frame, body, 1e-4)),
        serialise(outputs.pose(new, estimate, frame)))


def test_covariances_follow_the_ros_conventions():
    """Against drawn deltas: disturb as geometry/lie.py says, measure as ROS does (fixed axes, body twist)."""
    rng = np.random.default_rng(1)
    estimate = samples.estimate()
    R = estimate.T_WB[:3, :3]
    deltas = rng.multivariate_normal(np.zeros(9), estimate.cov * 1e-4, 4000)
    R_disturbed = R @ so3_exp(deltas[:, :3])
    about_fixed_axes = so3_log(R_disturbed @ R.T)
    v_B = np.einsum('nji,nj->ni', R_disturbed, estimate.v_W + deltas[:, 6:])
    measured_pose = np.cov(np.hstack([deltas[:, 3:6], about_fixed_axes]).T) * 1e4
    measured_twist = np.cov((v_B - linear_velocity(estimate)).T) * 1e4
    scale = np.abs(estimate.cov).max()
    np.testing.assert_allclose(measured_pose, pose_covariance(estimate), atol=0.15 * scale)  # 4000 draws: about 5 %
    np.testing.assert_allclose(measured_twist, twist_covariance(estimate)[:3, :3], atol=0.5 * scale)


def test_pose_and_transform(new):
    estimate = samples.estimate()
    pose = outputs.pose(new, estimate, 'odom')
    np.testing.assert_array_equal(xyz(pose.pose.pose.position), estimate.T_WB[:3, 3])
    stamped = outputs.pose_stamped(new, 7, estimate.T_WB, 'odom')
    np.testing.assert_array_equal(xyz(stamped.pose.position), estimate.T_WB[:3, 3])
    transform = outputs.transform(new, 7, estimate.T_WB, 'odom', 'base_link')
    np.testing.assert_array_equal(xyz(transform.transform.translation), estimate.T_WB[:3, 3])
    assert (transform.header.frame_id, transform.child_frame_id) == ('odom', 'base_link')
    assert all(map(serialise, (pose, stamped, transform)))


def test_lines_marker_waits_for_its_points(new):
    marker = outputs.lines_marker(new, 'odom', 'active', outputs.ACTIVE_COLOUR, 0.02)
    assert (marker.type, marker.action, marker.ns) == (5, 0, 'active')
    assert marker.pose.orientation.w == 1.0 and marker.color.a == 1.0 and marker.scale.x == 0.02
    assert marker.points == [] and serialise(marker)


def test_points_cloud(new):
    points = np.random.default_rng(3).normal(size=(4, 3))
    cloud = outputs.points_cloud(new, points, 3, 'odom')
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (1, 4, 12, 48)
    fields = [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields]
    assert fields == [('x', 0, 7, 1), ('y', 4, 7, 1), ('z', 8, 7, 1)]
    np.testing.assert_array_equal(np.frombuffer(cloud.data, '<f4').reshape(-1, 3), points.astype('f4'))
    assert serialise(cloud) and serialise(outputs.points_cloud(new, np.empty((0, 3)), 3, 'odom'))


@pytest.mark.parametrize(('shape', 'encoding', 'step'), [((4, 6), 'mono8', 6), ((4, 6, 3), 'bgr8', 18)])
def test_image(new, shape, encoding, step):
    pixels = np.random.default_rng(4).integers(0, 256, shape, dtype=np.uint8)
    message = outputs.image(new, pixels, 3, 'cam0')
    assert (message.height, message.width, message.encoding, message.step) == (4, 6, encoding, step)
    assert bytes(message.data) == pixels.tobytes() and serialise(message)


@pytest.mark.parametrize(('status', 'warnings', 'level'), [
    (Status.TRACKING, (), 0), (Status.TRACKING, ('IMU gap',), 1), (Status.INITIALISING, (), 1), (Status.LOST, (), 2)])
def test_diagnostics(new, status, warnings, level):
    message = outputs.diagnostics(new, 3, status, 'motion', {'frames': 7}, warnings=warnings)
    entry, = message.status
    assert ord(entry.level) == level if isinstance(entry.level, bytes) else entry.level == level
    assert entry.message == '; '.join((status.value, 'motion', *warnings))
    assert [(v.key, v.value) for v in entry.values] == [('frames', '7')]
    assert serialise(message)


def test_tf_in_bags():
    new = samples.factory('bag')
    message = outputs.tf(new, [outputs.transform(new, 7, np.eye(4), 'odom', 'imu_link')])
    assert message.transforms[0].child_frame_id == 'imu_link' and serialise(message)
