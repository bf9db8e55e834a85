"""Serialised LINE_LIST markers in microseconds: points are spliced into a message serialised once."""
from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from line_slam_ros.types import F64

STAMP_AT = 4  # CDR: 4 bytes of encapsulation header, then the message, whose first field is the stamp
SENTINEL = (1.2345678e67, -7.654321e-89, 3.3333e101)  # a point no marker contains by chance


class LineListBytes:
    """Serialised visualization_msgs/Marker with any number of points, everything else as in a template.

    In CDR (OMG DDSI-RTPS) a sequence of points is a uint32 count, padding to 8 bytes, 24 bytes per point.
    Nothing after ``points`` in a Marker is aligned to 8, so the rest is the same for every count but 0,
    where the padding is absent.
    """

    def __init__(self, marker: Any, point: Any, serialize: Callable[[Any], bytes]) -> None:
        """``marker`` without points, an empty ``geometry_msgs/Point`` and ``rclpy.serialization.serialize_message``."""
        self._empty = serialize(marker)
        point.x, point.y, point.z = SENTINEL
        marker.points = [point]
        one = serialize(marker)
        marker.points = []
        first = one.index(struct.pack('<3d', *SENTINEL))
        self._tail = one[first + 24:]
        self._padding = bytes(len(one) - len(self._empty) - 24)
        self._head = one[STAMP_AT + 8:first - len(self._padding) - 4]

    def __call__(self, t_ns: int, points: F64) -> bytes:
        """The marker stamped ``t_ns`` with ``points`` (N, 3), two for each line."""
        stamp = struct.pack('<iI', *divmod(t_ns, 1_000_000_000))
        if not len(points):
            return self._empty[:STAMP_AT] + stamp + self._empty[STAMP_AT + 8:]
        return b''.join((self._empty[:STAMP_AT], stamp, self._head, struct.pack('<I', len(points)), self._padding,
                         np.ascontiguousarray(points, '<f8').tobytes(), self._tail))
