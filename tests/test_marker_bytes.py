"""Spliced markers are what rclpy would have serialised."""
from __future__ import annotations

import numpy as np
import pytest

from msg_adapters.marker_bytes import LineListBytes

pytest.importorskip('rclpy')
from geometry_msgs.msg import Point
from rclpy.serialization import deserialize_message, serialize_message
from visualization_msgs.msg import Marker


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
