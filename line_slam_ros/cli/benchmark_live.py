"""The live part of ``line_slam benchmark speed``: a node in one process, a player that hears it in another."""
from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message

from line_slam_ros.benchmark.speed_live import Live, MessageCost, thread_shares, thread_ticks
from line_slam_ros.benchmark.speed_memory import resident_mib
from line_slam_ros.benchmark.speed_motion import Faster, Motion, frames_within, sample_rate, showing
from line_slam_ros.cli.benchmark_runs import IN_ORDER
from line_slam_ros.cli.benchmark_source import Recording, Source, Tape, environment, in_child, marker_maker, opened
from line_slam_ros.types import Estimate
from msg_adapters import outputs, received, sensors
from msg_adapters.factories import MessageFactory, ros_messages

NODE, IMAGE, IMU = '/line_slam', '/benchmark/image', '/benchmark/imu'
READY_S = 300.0  # for a node that compiles first
SETTLE_S = 0.5  # until readers and writers know each other
REST_S = 2.5  # after the last image: what is still to come, and a last diagnosis
LEAD_S = 0.2
MAP_LINES = 20_000


def live(recording: Recording, motion: Motion, speed: float) -> Live:
    """A fresh node hears the recording at so many times its speed."""
    with TemporaryDirectory() as scratch, ros_surroundings(Path(scratch)), opened(recording) as source, \
            _node(source, recording.settings, Path(scratch) / 'node.txt') as (process, began):
        return in_child(play, recording, motion, speed, process.pid, began, threads=2)


def ros_surroundings(scratch: Path) -> AbstractContextManager[None]:
    """Nobody else's nodes: this machine only, and a domain that the user chose or hardly anybody uses."""
    return environment({'ROS_DOMAIN_ID': os.environ.get('ROS_DOMAIN_ID', str(random.randint(215, 232))),
                        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_LOG_DIR': str(scratch)})


@contextmanager
def _node(source: Source, settings: Sequence[str], log: Path) -> Iterator[tuple[subprocess.Popen, float]]:
    """The node's process and when it started (monotonic). ValueError if it ends too early."""
    shell = source.shell
    if not shell.calibration_file:
        raise ValueError('the live part needs a Kalibr calibration file: give one with --calibration')
    parameters = {'calibration_file': shell.calibration_file,
                  'image_transport': 'compressed' if source.topics.compressed else 'raw'}
    parameters |= dict(word.split('=', 1) for word in settings)
    parameters.pop('accel_scale', None)  # the samples come scaled
    words = [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]
    with log.open('w', encoding='utf-8') as stream:
        began = time.monotonic()
        process = subprocess.Popen([sys.executable, '-m', 'line_slam_ros.nodes.line_slam_node', '--ros-args', *words,
                                    '-r', f'image:={IMAGE}', '-r', f'imu:={IMU}'], stdout=stream,
                                   stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, env=os.environ | IN_ORDER)
    try:
        yield process, began
        if process.poll() is not None:
            raise ValueError(f'the node ended: {log.read_text(encoding="utf-8", errors="replace")[-2000:]}')
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(15.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def play(recording: Recording, motion: Motion, speed: float, pid: int, began: float) -> Live:
    """The player's process; pid: the node's, which started at ``began``."""
    with opened(recording) as source:
        tape = Tape.of(source)
        rclpy.init(args=[])
        try:
            return Player(source, tape, motion, speed).play(pid, began)
        finally:
            rclpy.try_shutdown()


class Player:
    """Publishes on time and notes the age of what comes back."""

    def __init__(self, source: Source, tape: Tape, motion: Motion, speed: float) -> None:
        self._source, self._new, self._speed = source, ros_messages(), speed
        within = frames_within(tape.frames_ns, motion)
        self._images = tape.images[within]
        self._schedule = list(showing(tape.imu, tape.frames_ns[within], motion, Faster(speed),
                                      sample_rate(tape.imu.t_ns)))
        self._rate_hz = speed * sample_rate(tape.frames_ns)
        self._ages_ms: list[float] = []
        self._values: dict[str, str] = {}
        self._status = ''
        self._node = rclpy.create_node('line_slam_benchmark')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        kind, topic = (('CompressedImage', f'{IMAGE}/compressed') if source.topics.compressed else ('Image', IMAGE))
        self._image_out = self._node.create_publisher(self._new.type(f'sensor_msgs/msg/{kind}'), topic, 100)
        self._imu_out = self._node.create_publisher(self._new.type('sensor_msgs/msg/Imu'), IMU, 1000)
        self._hear(f'{NODE}/odometry', 'nav_msgs/msg/Odometry', self._on_odometry, 100)
        self._hear('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', self._on_diagnostics, 10)
        latched = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._hear(f'{NODE}/lines', 'visualization_msgs/msg/Marker', lambda _: None, latched, raw=True)

    def play(self, pid: int, began: float) -> Live:
        """ValueError if nobody subscribes in time."""
        while not (self._image_out.get_subscription_count() and self._imu_out.get_subscription_count()):
            if time.monotonic() - began > READY_S:
                raise ValueError(f'the node did not subscribe within {READY_S:g} s')
            self._spin_until(time.time() + 0.05)
        ready_after_s = time.monotonic() - began
        self._spin_until(time.time() + SETTLE_S)
        memory, ticks, start = resident_mib(pid), thread_ticks(pid), time.time() + LEAD_S
        start_ns = round(start * 1e9)
        for shown in self._schedule:
            t_ns = start_ns + shown.t_ns
            if shown.frame < 0:
                publisher, message = self._imu_out, outputs.imu(self._new, t_ns, shown.gyro_B, shown.accel_B, 'imu')
            else:
                publisher, message = self._image_out, self._image(shown.frame, t_ns)
            self._spin_until(t_ns * 1e-9)
            publisher.publish(message)
        seconds = time.time() - start
        shares, memory_after = thread_shares(ticks, thread_ticks(pid), pid, seconds), resident_mib(pid)
        self._spin_until(time.time() + REST_S)
        images = sum(shown.frame >= 0 for shown in self._schedule)
        return Live(self._speed, self._rate_hz, seconds, images, ready_after_s, tuple(self._ages_ms), self._drops(),
                    int(self._values.get('resets', 0)), self._status, shares,
                    (memory, memory_after))

    def _image(self, k: int, t_ns: int) -> Any:
        """The recorded image as a message; its camera's clock is the time offset behind."""
        t_ns -= round(self._source.calibration.time_offset * 1e9)
        return image_message(self._new, self._source, self._images[k], t_ns)

    def _hear(self, topic: str, kind: str, callback: Callable[[Any], None], qos: QoSProfile | int,
              raw: bool = False) -> None:
        self._node.create_subscription(self._new.type(kind), topic, callback, qos, raw=raw)

    def _on_odometry(self, msg: Any) -> None:
        self._ages_ms.append(1e-6 * (time.time_ns() - sensors.stamp_ns(msg)))

    def _on_diagnostics(self, msg: Any) -> None:
        name = NODE.strip('/')
        self._values = received.diagnosis_values(msg, name) or self._values
        self._status = received.diagnosis(msg, name) or self._status

    def _drops(self) -> dict[str, int]:
        prefix = 'dropped: '
        return {name.removeprefix(prefix): int(n) for name, n in self._values.items() if name.startswith(prefix)}

    def _spin_until(self, due: float) -> None:
        while (remaining := due - time.time()) > 0:
            self._executor.spin_once(timeout_sec=remaining)


def image_message(new: MessageFactory, source: Source, image: Any, t_ns: int) -> Any:
    """A recorded image as a live message."""
    if source.topics.compressed:
        return outputs.compressed_image(new, bytes(image.data), 'jpeg', t_ns, 'camera')
    return outputs.image(new, source.frame(image).image, t_ns, 'camera')


def message_costs(recording: Recording) -> list[MessageCost]:
    """Taking and making the node's messages, one by one; in a process of its own, with ROS's surroundings."""
    with opened(recording) as source:
        tape = Tape.of(source)
        new = ros_messages()
        hz, imu_hz = sample_rate(tape.frames_ns), sample_rate(tape.imu.t_ns)
        image = serialize_message(image_message(new, source, tape.images[0], 0))
        kind = new.type(f'sensor_msgs/msg/{"CompressedImage" if source.topics.compressed else "Image"}')
        heard = deserialize_message(image, kind)
        sample = serialize_message(outputs.imu(new, 0, tape.imu.gyro_B[0], tape.imu.accel_B[0], 'imu'))
        estimate = _some_estimate()
        marker, ends = marker_maker(new, serialize_message), np.zeros((MAP_LINES, 2, 3))
        costs = {
            'image deserialised': (lambda: deserialize_message(image, kind), hz),
            'image decoded': (lambda: source.frame(heard), hz),
            'IMU sample read': (lambda: sensors.imu_of_cdr(sample), imu_hz),
            'odometry made and serialised': (
                lambda: serialize_message(outputs.odometry(new, estimate, 'odom', 'imu_link', 0.0)), hz),
            f'map of {MAP_LINES} lines made and serialised': (lambda: marker(0, ends), 0.0),
        }
        found = [MessageCost(what, _microseconds(work), rate) for what, (work, rate) in costs.items()]
        return [*found, MessageCost(f'map of {MAP_LINES} lines given to DDS, one subscriber',
                                    _publishing_us(new, marker(0, ends)[0]), 0.0)]


def _publishing_us(new: MessageFactory, data: bytes) -> float:
    """Time within publish(), median."""
    rclpy.init(args=[])
    try:
        node = rclpy.create_node('line_slam_benchmark')
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        kind, heard = new.type('visualization_msgs/msg/Marker'), []
        node.create_subscription(kind, 'lines', heard.append, 2, raw=True)
        publisher = node.create_publisher(kind, 'lines', 2)
        _spin(executor, publisher.get_subscription_count)
        spent = []
        for k in range(10):
            began = time.perf_counter()
            publisher.publish(data)
            spent.append(time.perf_counter() - began)
            _spin(executor, lambda k=k: len(heard) > k)
        return 1e6 * float(np.median(spent))
    finally:
        rclpy.try_shutdown()


def _spin(executor: SingleThreadedExecutor, until: Callable[[], Any], timeout_s: float = 5.0) -> None:
    """Until something is true, or for so long."""
    deadline = time.monotonic() + timeout_s
    while not until() and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.05)


def _microseconds(work: Callable[[], Any], repeats: int = 100) -> float:
    spent = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        spent.append(time.perf_counter() - began)
    return 1e6 * float(np.median(spent))


def _some_estimate() -> Estimate:
    zero = np.zeros(3)
    return Estimate(0, np.eye(4), zero, zero, zero, zero, np.eye(9), False)
