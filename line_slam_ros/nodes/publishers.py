"""Everything the node publishes about the world: what is made, how often, and only if somebody listens."""
from __future__ import annotations

from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message

from line_slam_ros.shell_config import ShellConfig
from line_slam_ros.types import F64, U8, Estimate, LineSegments
from msg_adapters import outputs
from msg_adapters.factories import ros_messages
from msg_adapters.marker_bytes import LineMarkers
from msg_adapters.path_bytes import PathBytes

PATH_POSES = 500  # a path never grows beyond; with more, every second pose is forgotten
PATH_STEP_NS = 100_000_000
# Every event that rclpy watches by default costs the executor 30 us a message: with all of them, 30 % of a core.
NO_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)


class Publishers:
    """``~/odometry``, ``~/pose``, ``~/path``, ``~/lines``, ``~/points``, ``~/image_lines`` and ``/tf``.

    Called by the worker thread, but for lines(): a large map takes milliseconds to send, which is for the executor's.
    """

    def __init__(self, node: Node, shell: ShellConfig) -> None:
        self._new = ros_messages()
        self._shell = shell
        self._path = DecimatedPath()
        self._node = node
        self._odometry = self._advertise('nav_msgs/msg/Odometry', '~/odometry', 100)
        self._pose = self._advertise('geometry_msgs/msg/PoseWithCovarianceStamped', '~/pose', 100)
        self._trajectory = self._advertise('nav_msgs/msg/Path', '~/path', 1)
        self._points = self._advertise('sensor_msgs/msg/PointCloud2', '~/points', 1)
        self._image = self._advertise('sensor_msgs/msg/Image', '~/image_lines', 1)
        latched = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # the last pair: map and active
        self._lines = node.create_publisher(self._new.type('visualization_msgs/msg/Marker'), '~/lines', latched,
                                            event_callbacks=PublisherEventCallbacks(
                                                matched=self._on_lines_matched, use_default_callbacks=False))
        self._markers = LineMarkers(self._new, serialize_message, shell.odom_frame, shell.node.line_width)
        self._newest_lines: tuple[bytes, bytes] | None = None
        self._path_of = PathBytes(shell.odom_frame)
        self._tf = self._advertise_tf()
        self.map_due = Rate(shell.node.map_rate)
        self._path_due = Rate(shell.node.path_rate)
        self._image_due = Rate(shell.node.image_rate)

    def estimate(self, estimate: Estimate, gyro_variance: float) -> None:
        """Odometry, pose, path and transform, all with the image's stamp; gyro_variance in rad^2/s^2."""
        odom, body = self._shell.odom_frame, self._shell.body_frame
        if self._tf is not None:
            moved = outputs.transform(self._new, estimate.t_ns, estimate.T_WB, odom, body)
            self._tf.publish(outputs.tf(self._new, [moved]))
        if heard(self._odometry):
            self._odometry.publish(outputs.odometry(self._new, estimate, odom, body, gyro_variance))
        if heard(self._pose):
            self._pose.publish(outputs.pose(self._new, estimate, odom))
        if self._path.due(estimate.t_ns):
            self._path.add(estimate.t_ns, self._path_of.pose(estimate.t_ns, estimate.T_WB))
        if heard(self._trajectory) and self._path_due(estimate.t_ns):
            self._trajectory.publish(self._path_of(estimate.t_ns, self._path.poses))

    def lines(self, t_ns: int, whole: LineSegments, active: LineSegments) -> None:
        """Two markers: the whole map, and on top of it, thicker, the lines of the window. Kept for late joiners."""
        self._newest_lines = self._markers(t_ns, whole.ends, active.ends)
        if heard(self._lines):
            self._publish_lines()

    def points(self, t_ns: int, points_W: F64) -> None:
        """Landmarks (N, 3) in W."""
        self._points.publish(outputs.points_cloud(self._new, points_W, t_ns, self._shell.odom_frame))

    @property
    def points_wanted(self) -> bool:
        return heard(self._points)

    def image_wanted(self, t_ns: int) -> bool:
        """Whether somebody listens to ``~/image_lines`` and the next one is due."""
        return heard(self._image) and self._image_due(t_ns)

    def image(self, t_ns: int, bgr: U8) -> None:
        """Debug image (H, W, 3); its frame is the camera's, which messages do not need to name."""
        self._image.publish(outputs.image(self._new, bgr, t_ns, ''))

    def reset(self) -> None:
        """Forgets the path."""
        self._path = DecimatedPath()
        for due in (self.map_due, self._path_due, self._image_due):
            due.reset()

    def _publish_lines(self) -> None:
        for marker in self._newest_lines or ():
            self._lines.publish(marker)

    def _on_lines_matched(self, info: Any) -> None:
        """DDS gives a late joiner what was last sent, perhaps long ago as nobody listened: send the newest."""
        if info.current_count_change > 0:
            self._publish_lines()

    def _advertise(self, type_name: str, topic: str, depth: int) -> Publisher:
        return self._node.create_publisher(self._new.type(type_name), topic, depth, event_callbacks=NO_EVENTS)

    def _advertise_tf(self) -> Publisher | None:
        try:
            return self._advertise('tf2_msgs/msg/TFMessage', '/tf', 100)
        except ImportError:
            self._node.get_logger().warning('tf2_msgs is not installed: /tf is not published, the rest is')
            return None


class Rate:
    """At most so many a second, in sensor time."""

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = int(1e9 / rate_hz)
        self.reset()

    def __call__(self, t_ns: int) -> bool:
        due = t_ns >= self._next
        if due:
            self._next = t_ns + self._period_ns
        return due

    def reset(self) -> None:
        """Time may have jumped: the next one is due."""
        self._next = -2**63


class DecimatedPath:
    """Poses (serialised) of the whole way in bounded memory: when full, every second one goes and the step doubles."""

    def __init__(self) -> None:
        self.poses: list[bytes] = []
        self._step_ns = PATH_STEP_NS
        self._next = -2**63

    def due(self, t_ns: int) -> bool:
        """Whether the next pose is far enough from the last."""
        return t_ns >= self._next

    def add(self, t_ns: int, pose: bytes) -> None:
        """Appends a pose and thins the path when it is full."""
        self.poses.append(pose)
        if len(self.poses) >= PATH_POSES:
            self.poses = self.poses[::2]
            self._step_ns *= 2
        self._next = t_ns + self._step_ns


def heard(publisher: Publisher) -> bool:
    """Whether anybody subscribes."""
    return publisher.get_subscription_count() > 0
