"""Serialised LINE_LIST markers in microseconds: points are spliced into a message serialised once."""
from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from line_slam_ros.types import F64
from msg_adapters.factories import MessageFactory
from msg_adapters.outputs import ACTIVE_COLOUR, MAP_COLOUR, lines_marker

STAMP_AT = 4  # CDR: 4 bytes of encapsulation header, then the message, whose first field is the stamp
SENTINEL = (1.2345678e67, -7.654321e-89, 3.3333e101)  # a point no marker contains by chance


Serialiser = Callable[[Any], bytes | memoryview]  # of a message into CDR


class LineListBytes:
    """Serialised visualization_msgs/Marker with any number of points, everything else as in a template.

    In CDR (OMG DDSI-RTPS) a sequence of points is a uint32 count, padding to 8 bytes, 24 bytes per point.
    Nothing after ``points`` in a Marker is aligned to 8, so the rest is the same for every count but 0,
    where the padding is absent.
    """

    def __init__(self, marker: Any, point: Any, serialise: Serialiser) -> None:
        """``marker`` without points and any ``geometry_msgs/Point``, whose values are lost."""
        self._empty = bytes(serialise(marker))
        point.x, point.y, point.z = SENTINEL
        marker.points = [point]
        one = bytes(serialise(marker))
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


class LineMarkers:
    """The two markers of a line map: the whole, and on top of it, thicker, the lines of the window."""

    def __init__(self, new: MessageFactory, serialise: Serialiser, frame_id: str, width: float) -> None:
        """width: of the lines of the whole, m."""
        point = new('geometry_msgs/msg/Point', x=0.0, y=0.0, z=0.0)
        self._whole, self._active = (
            LineListBytes(lines_marker(new, frame_id, namespace, colour, thick), point, serialise)
            for namespace, colour, thick in (('map', MAP_COLOUR, width), ('active', ACTIVE_COLOUR, 1.5 * width)))

    def __call__(self, t_ns: int, whole: F64, active: F64) -> tuple[bytes, bytes]:
        """Both, stamped ``t_ns``; ends (L, 2, 3) m."""
        return self._whole(t_ns, whole.reshape(-1, 3)), self._active(t_ns, active.reshape(-1, 3))
