"""Hears what a running node publishes: for progress, and to keep it."""
from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from rosbags.typesys import Stores, get_typestore
from std_srvs.srv import Trigger

from line_slam_ros.cli import figure
from line_slam_ros.cli.bag_writer import BagWriter, mcap_file
from line_slam_ros.cli.results import TumWriter
from line_slam_ros.mapping.io import read_csv
from line_slam_ros.types import F64
from msg_adapters import received, sensors
from msg_adapters.factories import ros_messages

_ANSWER_S = 20.0  # for a service


class Listener(AbstractContextManager['Listener']):
    """Subscribes to a node's outputs, raw; with a directory, records them into output.mcap there.

    The executor of ``node`` must be spun. ``save_map`` completes the directory as replay would leave it.
    """

    def __init__(self, node: Node, slam_name: str, directory: Path | None) -> None:
        """``slam_name`` is the full name of the node to listen to; OSError if the directory cannot be made."""
        self._node, self._slam, self._directory = node, slam_name, directory
        self.poses: list[tuple[int, F64]] = []  # t_ns, T_WB
        self.lines = 0  # in the newest map
        self.diagnosis, self.frames_waiting = '', 0  # what the node said of itself last
        self.now_ns = 0  # log time of what comes in
        self._active, self._best, self._image = 0, -1, None
        self._new, self._typestore = ros_messages(), get_typestore(Stores.ROS2_JAZZY)
        self._files = ExitStack()
        self._writer: BagWriter | None = None
        if directory is not None:
            directory.mkdir(parents=True, exist_ok=True)
            self._writer = self._files.enter_context(mcap_file(directory / 'output.mcap'))
        self._subscribe()

    @property
    def is_connected(self) -> bool:
        """Whether the node is there."""
        return self._node.count_publishers(f'{self._slam}/odometry') > 0

    def save_map(self, executor: Executor) -> str:
        """Asks the node for its map, writes trajectory and figure; what the node said. ValueError if it did not."""
        assert self._directory is not None
        stem = self._directory.absolute() / 'lines'
        parameters = AsyncParameterClient(self._node, self._slam)
        self._answer(executor, parameters.set_parameters([Parameter('node.map_path', value=str(stem))]))
        service = self._node.create_client(Trigger, f'{self._slam}/save_map')
        reply = self._answer(executor, service.call_async(Trigger.Request()))
        if not reply.success:
            raise ValueError(reply.message)
        with TumWriter(self._directory / 'trajectory.tum') as trajectory:
            for t_ns, T_WB in self.poses:
                trajectory.add(t_ns, T_WB)
        figure.save(self._directory / 'figure.png', self._image, [T_WB[:3, 3] for _, T_WB in self.poses],
                    read_csv(f'{stem}.csv'))
        return reply.message

    def __exit__(self, *_: object) -> None:
        self._files.close()

    def _subscribe(self) -> None:
        latched = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._hear(f'{self._slam}/odometry', 'nav_msgs/msg/Odometry', self._on_odometry, 100)
        self._hear(f'{self._slam}/lines', 'visualization_msgs/msg/Marker', self._on_marker, latched)
        self._hear('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', self._on_diagnostics, 10)
        if self._writer is not None:
            self._hear(f'{self._slam}/pose', 'geometry_msgs/msg/PoseWithCovarianceStamped', None, 100)
            self._hear(f'{self._slam}/path', 'nav_msgs/msg/Path', None, 1)
            self._hear(f'{self._slam}/points', 'sensor_msgs/msg/PointCloud2', None, 10)
            self._hear(f'{self._slam}/image_lines', 'sensor_msgs/msg/Image', self._on_image, 2, record=False)  # big

    def _hear(self, topic: str, kind: str, callback: Callable[[Any], None] | None, qos: QoSProfile | int,
              record: bool = True) -> None:
        def on_message(data: bytes) -> None:
            if record and self._writer is not None:
                self._writer.write_serialised(topic, self.now_ns, kind, data, latched=isinstance(qos, QoSProfile))
            if callback is not None:
                callback(self._typestore.deserialize_cdr(data, kind))

        self._node.create_subscription(self._new.type(kind), topic, on_message, qos, raw=True)

    def _on_odometry(self, msg: Any) -> None:
        self.poses.append(sensors.pose_from_msg(msg))

    def _on_marker(self, msg: Any) -> None:
        namespace, count = received.marker_lines(msg)
        if namespace == 'map':
            self.lines = count
        else:
            self._active = count

    def _on_image(self, msg: Any) -> None:
        """Of all debug images, the one with the most lines goes into the figure."""
        if self._active > self._best:
            self._best, self._image = self._active, received.bgr_pixels(msg)

    def _on_diagnostics(self, msg: Any) -> None:
        name = self._slam.rsplit('/', 1)[-1]
        self.diagnosis = received.diagnosis(msg, name) or self.diagnosis
        self.frames_waiting = int(received.diagnosis_values(msg, name).get('frames waiting', self.frames_waiting))

    def _answer(self, executor: Executor, future: Future) -> Any:
        executor.spin_until_future_complete(future, timeout_sec=_ANSWER_S)
        if not future.done():
            raise ValueError(f'{self._slam} does not answer; is it still running?')
        return future.result()
