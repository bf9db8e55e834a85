"""Spliced markers and paths are what rclpy would have serialised."""
from __future__ import annotations

import numpy as np
import pytest

from line_slam_ros.geometry.lie import quaternion_from_matrix, rigid, so3_exp
from msg_adapters.marker_bytes import LineListBytes, LineMarkers
from msg_adapters.path_bytes import PathBytes

pytest.importorskip('rclpy')
from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message
from visualization_msgs.msg import Marker

from msg_adapters.factories import ros_messages


def template(frame: str, ns: str) -> Marker:
    marker = Marker(type=Marker.LINE_LIST, ns=ns, id=7, text='text', mesh_resource='mesh')
    marker.header.frame_id = frame
    marker.scale.x, marker.color.a, marker.pose.orientation.w = 0.02, 0.5, 1.0
    return marker


@pytest.mark.parametrize('count', [0, 2, 1000])
@pytest.mark.parametrize('frame,ns', [('map', 'lines'), ('odom', 'abcd'), ('world', 'a'), ('m', ''), ('', 'active')])
def test_spliced_marker_equals_the_one_built_field_by_field(frame: str, ns: str, count: int) -> None:
    points = np.random.default_rng(count).normal(size=(count, 3))
    spliced = deserialize_message(LineListBytes(template(frame, ns), Point(), serialize_message)(
        1_234_567_890_987_654_321, points), Marker)

    expected = template(frame, ns)
    expected.header.stamp.sec, expected.header.stamp.nanosec = 1_234_567_890, 987_654_321
    expected.points = [Point(x=x, y=y, z=z) for x, y, z in points.tolist()]
    assert spliced == expected


def test_the_two_markers_of_a_map_are_told_apart() -> None:
    ends = np.random.default_rng(1).normal(size=(3, 2, 3))
    markers = LineMarkers(ros_messages(), serialize_message, 'odom', 0.01)(7, ends, ends[:1])
    whole, active = (deserialize_message(data, Marker) for data in markers)
    assert (whole.ns, active.ns) == ('map', 'active') and active.scale.x == 1.5 * whole.scale.x == 0.015
    assert (whole.type, whole.action, whole.header.frame_id) == (Marker.LINE_LIST, Marker.ADD, 'odom')
    assert whole.pose.orientation.w == whole.color.a == 1.0 and whole.color != active.color
    np.testing.assert_array_equal([[p.x, p.y, p.z] for p in whole.points], ends.reshape(-1, 3))
    assert len(active.points) == 2


@pytest.mark.parametrize('count', [0, 1, 2, 30])
@pytest.mark.parametrize('frame', ['', 'm', 'map', 'odom', 'world', 'odomet', 'odometr', 'odometry'])
def test_a_path_of_bytes_equals_the_one_built_field_by_field(frame: str, count: int) -> None:
    rng, make = np.random.default_rng(count), PathBytes(frame)
    poses = [(1_000_000_007 * k, rigid(so3_exp(rng.normal(size=3)), rng.normal(size=3))) for k in range(count)]
    spliced = make(1_234_567_890_987_654_321, [make.pose(t_ns, T_WB) for t_ns, T_WB in poses])

    expected = Path()
    expected.header.frame_id = frame
    expected.header.stamp.sec, expected.header.stamp.nanosec = 1_234_567_890, 987_654_321
    for t_ns, T_WB in poses:
        stamped = PoseStamped()
        stamped.header.frame_id = frame
        stamped.header.stamp.sec, stamped.header.stamp.nanosec = divmod(t_ns, 1_000_000_000)
        p, q = stamped.pose.position, stamped.pose.orientation
        p.x, p.y, p.z = T_WB[:3, 3].tolist()
        q.x, q.y, q.z, q.w = quaternion_from_matrix(T_WB[:3, :3]).tolist()
        expected.poses.append(stamped)
    assert deserialize_message(spliced, Path) == expected
