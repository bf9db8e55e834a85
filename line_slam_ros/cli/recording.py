"""A run as messages in a bag that Foxglove and RViz open: the topics of the node, stamped with sensor time."""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from line_slam_ros.cli.bag_writer import BagWriter
from line_slam_ros.types import F64, Estimate
from msg_adapters import outputs
from msg_adapters.estimate_bytes import EstimateBytes
from msg_adapters.marker_bytes import LineMarkers
from msg_adapters.path_bytes import PathBytes

_LINE_WIDTH = 0.01  # m
_PATH_POSES = 1000  # a longer path is thinned out
_PERIOD_NS = 1_000_000_000  # of map, path, points and diagnostics


class Recording:
    """Writes poses at frame rate, everything bigger once a second and at the end."""

    def __init__(self, writer: BagWriter, odom_frame: str, body_frame: str, namespace: str = '/line_slam') -> None:
        self._writer, self._new = writer, writer.new
        self._odom, self._namespace = odom_frame, namespace
        self._bytes_of = EstimateBytes(writer.new, writer.serialise, odom_frame, body_frame)
        self._markers = LineMarkers(writer.new, writer.serialise, odom_frame, _LINE_WIDTH)
        self._path_of = PathBytes(odom_frame)
        self._path: list[bytes] = []  # poses
        self._every = 1  # of the estimates go into the path
        self._estimates = 0
        self._state_ns = -_PERIOD_NS

    def estimate(self, estimate: Estimate, gyro_variance: float = 0.0) -> None:
        """Odometry, pose and transform."""
        t_ns = estimate.t_ns
        transform, odometry, pose = self._bytes_of(estimate, gyro_variance)
        self._writer.write_serialised('/tf', t_ns, 'tf2_msgs/msg/TFMessage', transform)
        self._write_serialised('odometry', t_ns, 'nav_msgs/msg/Odometry', odometry)
        self._write_serialised('pose', t_ns, 'geometry_msgs/msg/PoseWithCovarianceStamped', pose)
        self._extend_path(t_ns, estimate.T_WB)

    def state(self, t_ns: int, slam: Any, counts: Mapping[str, int]) -> None:
        """Diagnostics, map, path and points of a Slam or LineMapper, if they are due."""
        if abs(t_ns - self._state_ns) < _PERIOD_NS:
            return
        self._state_ns = t_ns
        values = {**counts, 'resets': slam.resets}
        health = outputs.diagnostics(self._new, t_ns, slam.status, slam.waiting_for, values)
        self._writer.write('/diagnostics', t_ns, health)
        if self._path:
            self._write_world(t_ns, slam)

    def finish(self, t_ns: int, slam: Any) -> None:
        """The final map and path."""
        self._write_world(t_ns, slam)

    def _write_world(self, t_ns: int, slam: Any) -> None:
        for marker in self._markers(t_ns, slam.line_map.segments().ends, slam.active_lines().ends):
            self._write_serialised('lines', t_ns, 'visualization_msgs/msg/Marker', marker, latched=True)
        self._write('points', t_ns, outputs.points_cloud(self._new, slam.points(), t_ns, self._odom))
        self._write_serialised('path', t_ns, 'nav_msgs/msg/Path', self._path_of(t_ns, self._path))

    def _extend_path(self, t_ns: int, T_WB: F64) -> None:
        if self._estimates % self._every == 0:
            self._path.append(self._path_of.pose(t_ns, T_WB))
        self._estimates += 1
        if len(self._path) > _PATH_POSES:
            self._path, self._every = self._path[::2], 2 * self._every

    def _write(self, name: str, t_ns: int, message: Any) -> None:
        self._writer.write(f'{self._namespace}/{name}', t_ns, message)

    def _write_serialised(self, name: str, t_ns: int, type_name: str, data: bytes, latched: bool = False) -> None:
        self._writer.write_serialised(f'{self._namespace}/{name}', t_ns, type_name, data, latched)
