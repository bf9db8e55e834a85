"""Serialised nav_msgs/Path in microseconds: every pose is serialised once, a message strings them together."""
from __future__ import annotations

import struct
from collections.abc import Sequence

from line_slam_ros.geometry.lie import quaternion_from_matrix
from line_slam_ros.types import F64

POSE = struct.Struct('<7d')  # position and quaternion


class PathBytes:
    """Paths and their poses in one frame.

    CDR (OMG DDSI-RTPS), little endian: 4 bytes of encapsulation, stamp, frame_id (uint32, characters), uint32 count,
    then poses of stamp, frame_id and seven doubles, which begin at a multiple of 8. So do all poses but for the first,
    which may begin 4 bytes off: its padding is another one.
    """

    def __init__(self, frame_id: str) -> None:
        name = frame_id.encode() + b'\0'
        self._name = struct.pack('<I', len(name)) + name
        self._fill = _padding(8 + len(self._name), 4)
        first = 8 + len(self._name) + len(self._fill) + 4
        self._first = self._name + _padding(first + 8 + len(self._name), 8)
        self._other = self._name + _padding(8 + len(self._name), 8)

    def pose(self, t_ns: int, T_WB: F64) -> bytes:
        """One pose (4, 4) of a path."""
        q_xyzw = quaternion_from_matrix(T_WB[:3, :3])
        return _stamp(t_ns) + self._other + POSE.pack(*T_WB[:3, 3].tolist(), *q_xyzw.tolist())

    def __call__(self, t_ns: int, poses: Sequence[bytes]) -> bytes:
        """The message stamped ``t_ns`` of what pose() returned."""
        head = b'\0\1\0\0', _stamp(t_ns), self._name, self._fill, struct.pack('<I', len(poses))
        if not poses:
            return b''.join(head)
        return b''.join((*head, poses[0][:8], self._first, poses[0][-POSE.size:], *poses[1:]))


def _stamp(t_ns: int) -> bytes:
    return struct.pack('<iI', *divmod(t_ns, 1_000_000_000))


def _padding(position: int, multiple: int) -> bytes:
    return bytes(-position % multiple)
