"""A live node in a process of its own, and ears and hands for the test to deal with it over DDS."""
from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import rclpy
from bag_samples import OFFICE
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from line_slam_ros.cli.bag_reader import open_bag
from line_slam_ros.cli.playing import schedule
from msg_adapters.factories import ros_messages

START_S = 240.0  # a node that finds no compiled code yet compiles
MATCH_S = 0.5  # after a writer knows a reader, until the reader knows the writer
LATCHED = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL)
OFFICE_BAG, OFFICE_CALIBRATION = OFFICE / 'bag', OFFICE / 'calibration.yaml'
OFFICE_ARGS = ('-p', f'calibration_file:={OFFICE_CALIBRATION}', '-p', 'image_transport:=compressed',
               '-r', 'image:=/cam0/image_raw', '-r', 'imu:=/imu0', '-r', 'pose:=/ground_truth/pose')
LOSSLESS = ('-p', 'max_frames:=1000', '-p', 'node.reliability:=reliable')  # however busy the machine
ROOT = Path(__file__).parents[1]


class Process:
    """A child in its own session; what it writes goes to a file."""

    def __init__(self, log: Path, *command: str, env: dict[str, str] | None = None) -> None:
        self._log = log
        path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get('PYTHONPATH'))))
        env = {**os.environ, 'PYTHONPATH': path, **(env or {})}
        with log.open('w') as output:
            self._process = subprocess.Popen([sys.executable, *command], stdout=output, stderr=subprocess.STDOUT,
                                             start_new_session=True, env=env)

    @property
    def text(self) -> str:
        """What it has written so far."""
        return self._log.read_text()

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    def wait(self, timeout: float = 60.0) -> int:
        return self._process.wait(timeout)

    def stop(self, how: int = signal.SIGINT) -> int:
        """The exit code after a signal; it is killed if it does not end."""
        self._process.send_signal(how)
        try:
            return self._process.wait(15.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


@contextmanager
def running(log: Path, *command: str, env: dict[str, str] | None = None) -> Iterator[Process]:
    """A child that does not outlive the block."""
    process = Process(log, *command, env=env)
    try:
        yield process
    finally:
        if process.is_running:
            process.stop(signal.SIGTERM)


def slam_node(log: Path, *ros_args: str, env: dict[str, str] | None = None) -> AbstractContextManager[Process]:
    """line_slam_node in a process."""
    return running(log, '-m', 'line_slam_ros.nodes.line_slam_node', '--ros-args', *ros_args, env=env)


class Peer:
    """A ROS node in the test's own process: hears topics, publishes, calls services."""

    def __init__(self, name: str = 'peer') -> None:
        self.node = rclpy.create_node(name)
        self.new = ros_messages()
        self.heard: dict[str, list[Any]] = defaultdict(list)
        self.hear('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray')
        self._publishers: dict[str, Any] = {}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()

    def hear(self, topic: str, kind: str, qos: QoSProfile | int = 10) -> None:
        """Collect messages in ``heard[topic]``."""
        self.node.create_subscription(self.new.type(kind), topic, self.heard[topic].append, qos)

    def publish(self, topic: str, message: Any) -> None:
        """On a topic that somebody subscribes to; waits for that."""
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(type(message), topic, 100)
            assert self.spin_until(self._publishers[topic].get_subscription_count, START_S), f'nobody hears {topic}'
            self.spin(MATCH_S)
        self._publishers[topic].publish(message)

    def spin_until(self, condition: Callable[[], Any], timeout: float) -> bool:
        """Whether the condition came true in time."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def spin(self, seconds: float) -> None:
        self.spin_until(lambda: False, seconds)

    def call(self, service: str) -> Trigger.Response:
        """The answer of a std_srvs/Trigger."""
        client = self.node.create_client(Trigger, service)
        assert client.wait_for_service(10.0)
        future = client.call_async(Trigger.Request())
        self._executor.spin_until_future_complete(future, timeout_sec=20.0)
        assert future.done(), f'{service} does not answer'
        self.node.destroy_client(client)
        return future.result()

    def diagnosed(self, text: str, timeout: float = 10.0) -> bool:
        """Whether a diagnostic with this text in message or values comes; only those from now on count."""
        before = len(self.heard['/diagnostics'])
        return self.spin_until(lambda: any(text in whole(array)
                                           for array in self.heard['/diagnostics'][before:]), timeout)

    def last_diagnosis(self) -> str:
        """For assertion messages."""
        return whole(self.heard['/diagnostics'][-1]) if self.heard['/diagnostics'] else 'no diagnostics came'

    def play_office(self, seconds: float, rate: float = 1.0, start: float = 0.0) -> None:
        """Messages of the shipped recording, in time."""
        with open_bag(OFFICE_BAG) as bag:
            publishers = {topic: self.node.create_publisher(self.new.type(kind), topic, 100)
                          for topic, kind in bag.types.items()}
            image = publishers['/cam0/image_raw/compressed']
            assert self.spin_until(image.get_subscription_count, START_S), 'nobody hears the images'
            self.spin(MATCH_S)
            for due, topic, _, data in schedule(bag.log(), start, seconds, rate):
                self.spin(due - time.monotonic())
                publishers[topic].publish(data)
        self.spin(1.0)
        for publisher in publishers.values():
            self.node.destroy_publisher(publisher)


def whole(array: Any) -> str:
    """Message and values of all statuses as one text."""
    return '\n'.join([status.message + '\n' + '\n'.join(f'{pair.key} = {pair.value}' for pair in status.values)
                      for status in array.status])
