"""The recording that the benchmark of the speed runs on, opened as replay does; and work in processes of its own."""
from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from rosbags.typesys import Stores, get_typestore

from line_slam_ros.benchmark.degrade import Degradation, degraded_calibration, degraded_image
from line_slam_ros.benchmark.speed_motion import Shown
from line_slam_ros.cli.bag_calibration import find_calibration, with_calibration_beside
from line_slam_ros.cli.bag_reader import Bag, open_bag
from line_slam_ros.cli.bag_topics import Topics, choose_topics
from line_slam_ros.cli.benchmark_runs import ONE_THREAD
from line_slam_ros.cli.replaying import IMU_CAPACITY, WAITING, Clip
from line_slam_ros.config import Config
from line_slam_ros.config_file import load
from line_slam_ros.imu_buffer import Vector
from line_slam_ros.inbox import Inbox
from line_slam_ros.shell_config import ShellConfig
from line_slam_ros.types import F64, Calibration, Frame, ImuBatch
from msg_adapters import sensors
from msg_adapters.factories import MessageFactory, bag_messages
from msg_adapters.marker_bytes import LineMarkers, Serialiser

Result = TypeVar('Result')


@dataclass(frozen=True)
class Recording:
    """What is measured; can be sent to another process."""

    bag: Path
    calibration: Path | None = None
    settings: tuple[str, ...] = ()  # NAME=VALUE
    duration_s: float | None = None  # None: to the end
    resize: float = 1.0  # of the images

    def name(self) -> str:
        """For people, and to know it again."""
        with opened(self) as source:
            c, images = source.calibration, source.bag.counts[source.topics.image]
        part = '' if self.duration_s is None else f', {self.duration_s:g} s of it'
        changed = f', {", ".join(self.settings)}' if self.settings else ''
        return f'{images} images of {c.width}x{c.height}{part}{changed}'


@dataclass(frozen=True)
class Source:
    """An open recording."""

    bag: Bag
    topics: Topics
    calibration: Calibration
    config: Config
    shell: ShellConfig
    wanted: Degradation
    duration_s: float | None

    def inbox(self) -> Inbox:
        """As replay has it; samples come scaled."""
        c = self.calibration
        return Inbox(WAITING, c.time_offset, (c.width, c.height), imu_capacity=IMU_CAPACITY)

    def messages(self) -> Iterator[tuple[str, Any]]:
        """(topic, message) of images, (topic, fields) of inertial data."""
        wanted = self.topics.image, self.topics.motion
        return Clip(self.topics.image, 0.0, self.duration_s).of(self.bag.messages(wanted, self.topics.motion))

    def frame(self, message: Any) -> Frame:
        """Decoded. ValueError if it cannot be."""
        frame = sensors.compressed_to_frame(message) if self.topics.compressed else sensors.image_to_frame(message)
        return replace(frame, image=degraded_image(frame.image, frame.t_ns, self.wanted))

    def sample(self, fields: tuple[int, Vector, Vector]) -> tuple[int, Vector, Vector]:
        """(t_ns, gyro_B rad/s, accel_B m/s^2) of sensors.imu_fields."""
        t_ns, gyro_B, (x, y, z) = fields
        scale = self.shell.accel_scale
        return t_ns, gyro_B, (scale * x, scale * y, scale * z)

    def put(self, inbox: Inbox, shown: Shown, images: Sequence[Any]) -> None:
        """What is shown next; images: those that its frames count."""
        if shown.frame < 0:
            inbox.imu(shown.t_ns, shown.gyro_B, shown.accel_B)
        else:
            stamp_ns = shown.t_ns - round(self.calibration.time_offset * 1e9)
            inbox.frame(replace(self.frame(images[shown.frame]), t_ns=stamp_ns))


@contextmanager
def opened(recording: Recording) -> Iterator[Source]:
    """OSError or ValueError if the recording cannot be used."""
    config, shell = load([], list(recording.settings))
    if recording.calibration:
        shell = replace(shell, calibration_file=str(recording.calibration))
    with open_bag(recording.bag) as bag:
        named = dict.fromkeys(('image', 'imu', 'camera_info', 'pose'), '')
        topics = choose_topics(bag.types, named, shell.image_transport, 'imu')
        shell = with_calibration_beside(shell, recording.bag)
        wanted = Degradation(resize=recording.resize)
        calibration = degraded_calibration(find_calibration(bag, topics, shell)[0], wanted)
        yield Source(bag, topics, calibration, config, shell, wanted, recording.duration_s)


@dataclass(frozen=True)
class Tape:
    """A recording in memory, its images as they were received (and perhaps compressed)."""

    imu: ImuBatch
    frames_ns: np.ndarray  # (K,) int64, on the clock of the IMU
    images: list[Any]  # messages

    @staticmethod
    def of(source: Source) -> Tape:
        samples, stamps, images = [], [], []
        offset_ns = round(source.calibration.time_offset * 1e9)
        for topic, message in source.messages():
            if topic == source.topics.image:
                stamps.append(sensors.stamp_ns(message) + offset_ns)
                images.append(message)
            else:
                samples.append(source.sample(message))
        t_ns, gyro_B, accel_B = zip(*samples, strict=True)
        return Tape(ImuBatch(np.array(t_ns), np.array(gyro_B), np.array(accel_B)), np.array(stamps), images)


def marker_maker(new: MessageFactory, serialise: Serialiser) -> Callable[[int, F64], tuple[bytes, bytes]]:
    """(t_ns, ends (L, 2, 3)) to the serialised markers of the map and of no active lines, as the node makes them."""
    make, none = LineMarkers(new, serialise, 'odom', 0.01), np.empty((0, 2, 3))
    return lambda t_ns, ends: make(t_ns, ends, none)


def bag_marker_maker() -> Callable[[int, F64], tuple[bytes, bytes]]:
    """The same where ROS is not installed."""
    typestore = get_typestore(Stores.ROS2_JAZZY)
    return marker_maker(bag_messages(typestore), lambda m: typestore.serialize_cdr(m, m.__msgtype__))


def in_child(work: Callable[..., Result], *args: Any, threads: int = 1) -> Result:
    """work(*args) in a new process that has so many cores, and so many threads for OpenCV and BLAS."""
    with surroundings(threads), ProcessPoolExecutor(1, mp_context=get_context('spawn'), initializer=cv2.setNumThreads,
                                                    initargs=(threads,)) as pool:
        return pool.submit(work, *args).result()


@contextmanager
def surroundings(threads: int, **variables: str) -> Iterator[None]:
    """What processes started in here inherit: so many cores, threads of the libraries, and environment variables."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(cores)[:threads])
    try:
        with environment(dict.fromkeys(ONE_THREAD, str(threads)) | variables):
            yield
    finally:
        os.sched_setaffinity(0, cores)


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Environment variables, as long as it takes."""
    before = dict(os.environ)
    os.environ.update(variables)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
