"""The run behind ``line_slam replay``."""
from __future__ import annotations

import argparse
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
from tqdm import tqdm

from line_slam_ros.benchmark.degrade import Degradation, DegradedStream, degraded_calibration
from line_slam_ros.cli.bag_calibration import find_calibration, with_calibration_beside
from line_slam_ros.cli.bag_reader import Bag, open_bag
from line_slam_ros.cli.bag_topics import Topics, choose_topics
from line_slam_ros.cli.results import Results, settings_of
from line_slam_ros.config import Config
from line_slam_ros.config_file import load, settings
from line_slam_ros.estimation.line_mapper import LineMapper
from line_slam_ros.inbox import Inbox, PoseInbox
from line_slam_ros.shell_config import ShellConfig
from line_slam_ros.slam import Slam
from line_slam_ros.types import Calibration, Estimate, Frame, ImuBatch
from msg_adapters import sensors

WAITING = 300  # frames that may wait for data recorded late; 110 MB at 752x480
IMU_CAPACITY = 100_000  # samples; a bag may hold minutes of them before its first image


def replay(args: argparse.Namespace) -> int:
    """0 if at least one pose was estimated, 1 if none; ValueError or OSError if the input cannot be used at all."""
    config, shell = load(args.config, args.set)
    if args.calibration:
        shell = replace(shell, calibration_file=str(args.calibration))
    wanted = Degradation.of(settings(args.degrade, '--degrade'), '--degrade')
    cv2.setRNGSeed(0)
    cv2.setNumThreads(args.threads)
    with open_bag(args.bag) as bag:
        named = {name: getattr(args, f'{name}_topic') for name in ('image', 'imu', 'camera_info', 'pose')}
        topics = choose_topics(bag.types, named, shell.image_transport, shell.pose_source)
        shell = with_calibration_beside(shell, args.bag)
        calibration, calibration_note = find_calibration(bag, topics, shell)
        for note in filter(None, (bag.note, *topics.notes, calibration_note)):
            _tell(note)
        stream = DegradedStream(wanted, calibration.imu_noise)
        calibration = degraded_calibration(calibration, wanted)
        run = (PoseRun if shell.pose_source == 'topic' else ImuRun)(config, shell, calibration, topics, stream)
        run.slam.warm_up(_tell)
        record = settings_of(config, shell) | {f'degrade.{name}': v for name, v in wanted.changes().items()}
        with Results(args.output, shell, record, run.slam, run.inbox, args.figure) as results:
            _run_through(bag, Clip(topics.image, args.start, args.duration), topics, run, results)
    return _conclude(args.output, results)


@dataclass(frozen=True)
class Clip:
    """The part of a recording that is used, by the stamps of its images."""

    image_topic: str
    start_s: float  # since the first image
    duration_s: float | None  # None: to the end

    def of(self, messages: Iterable[tuple[str, Any]]) -> Iterator[tuple[str, Any]]:
        """The messages but for the images before the start; ends at the first image past the end."""
        first: int | None = None
        for topic, message in messages:
            if topic == self.image_topic:
                t_ns = sensors.stamp_ns(message)
                first = t_ns if first is None else first
                since_start_s = (t_ns - first) * 1e-9 - self.start_s
                if self.duration_s is not None and since_start_s > self.duration_s:
                    return
                if since_start_s < 0.0 < self.start_s:
                    continue
            yield topic, message


class Run(ABC):
    """One pass: messages in, estimates out, through the same inbox and SLAM as in the node."""

    slam: Slam | LineMapper
    inbox: Inbox | PoseInbox
    imu_topic = ''

    def __init__(self, topics: Topics, stream: DegradedStream) -> None:
        self._topics, self._stream = topics, stream
        self._to_frame = sensors.compressed_to_frame if topics.compressed else sensors.image_to_frame

    def feed(self, topic: str, message: Any) -> None:
        """A message of the bag; one that cannot be used is counted and told."""
        try:
            if topic == self._topics.image:
                frame = self._stream.frame(self._to_frame(message))
                if frame is not None:
                    self.inbox.frame(frame)
            else:
                self._motion(message)
        except ValueError as error:
            what = 'image' if topic == self._topics.image else 'pose'
            self.inbox.reject(f'{what} not usable', str(error), sensors.stamp_ns(message))

    def ready(self) -> Iterator[tuple[Frame, ImuBatch | None, Estimate | None]]:
        """Every frame that has become ready, with its inertial samples (if any) and what the SLAM made of it."""
        while (pair := self.inbox.take()) is not None:
            if self.inbox.jumped:
                self.slam.reset('time jumped back')
            try:
                processed = self._process(*pair)
            except ValueError as error:  # as the node does: a frame that cannot be used does not end the run
                self.inbox.reject('image not usable', str(error), pair[0].t_ns)
            else:
                yield processed

    @abstractmethod
    def _motion(self, message: Any) -> None:
        """A pose message, or the fields of an inertial sample."""

    @abstractmethod
    def _process(self, frame: Frame, companion: Any) -> tuple[Frame, ImuBatch | None, Estimate | None]: ...


class ImuRun(Run):
    """Poses estimated from images and inertial data."""

    def __init__(self, config: Config, shell: ShellConfig, calibration: Calibration, topics: Topics,
                 stream: DegradedStream) -> None:
        super().__init__(topics, stream)
        self.imu_topic = topics.motion
        self.slam = Slam(config, calibration)
        self.inbox = Inbox(WAITING, calibration.time_offset, (calibration.width, calibration.height),
                           shell.accel_scale, IMU_CAPACITY)

    def _motion(self, message: Any) -> None:
        self.inbox.imu(*self._stream.imu(*message))

    def _process(self, frame: Frame, imu: ImuBatch) -> tuple[Frame, ImuBatch | None, Estimate | None]:
        return frame, imu, self.slam.process(frame, imu)


class PoseRun(Run):
    """Poses taken from a topic; only lines are mapped."""

    def __init__(self, config: Config, shell: ShellConfig, calibration: Calibration, topics: Topics,
                 stream: DegradedStream) -> None:
        super().__init__(topics, stream)
        self.slam = LineMapper(config, calibration)
        self.inbox = PoseInbox(WAITING, calibration.time_offset, (calibration.width, calibration.height))

    def _motion(self, message: Any) -> None:
        self.inbox.pose(*sensors.pose_from_msg(message))

    def _process(self, frame: Frame, T_WB: Any) -> tuple[Frame, ImuBatch | None, Estimate | None]:
        return frame, None, self.slam.process_with_pose(frame, T_WB)


def _run_through(bag: Bag, clip: Clip, topics: Topics, run: Run, results: Results) -> None:
    """The whole bag through the SLAM, with a progress bar and the inbox's remarks."""
    wanted = (topics.image, topics.motion)
    total = sum(bag.counts[topic] for topic in wanted)
    with closing(tqdm(total=total, unit='msg', desc='replay', dynamic_ncols=True, mininterval=0.5)) as progress:
        for topic, message in clip.of(bag.messages(wanted, run.imu_topic)):
            progress.update()
            run.feed(topic, message)
            _collect(run, results)
        run.inbox.close()
        _collect(run, results)
    for topic, count in sorted(bag.undecodable.items()):
        run.inbox.drops[f'{topic} not decodable'] = count


def _collect(run: Run, results: Results) -> None:
    for frame, imu, estimate in run.ready():
        results.add(frame.t_ns, imu, estimate)
    for note in run.inbox.notes():
        results.notes.append(note)
        _tell(note)


def _conclude(output: Path, results: Results) -> int:
    """Says how it went."""
    print(results.summary())
    if results.estimates == 0:
        _tell(f'no pose was estimated: {results.reason()}')
        return 1
    print(f'written to {output}/')
    return 0


def _tell(sentence: str) -> None:
    tqdm.write(f'line_slam replay: {sentence}', file=sys.stderr)
