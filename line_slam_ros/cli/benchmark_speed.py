"""The measurements behind ``line_slam benchmark speed`` that need a recording, each for a process of its own."""
from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from line_slam_ros.benchmark.speed_memory import MIB, Memory, resident_mib
from line_slam_ros.benchmark.speed_motion import Motion, ToAndFro, frames_within, sample_rate, showing
from line_slam_ros.benchmark.speed_stages import Cost, ProfiledSlam, Stopwatch, kernel_cost
from line_slam_ros.cli.benchmark_runs import IN_ORDER
from line_slam_ros.cli.benchmark_source import Recording, Source, Tape, bag_marker_maker, opened, surroundings
from line_slam_ros.cli.results import Results
from line_slam_ros.slam import Slam
from line_slam_ros.types import Estimate

KERNEL_EVERY = 50  # frames: the machine's speed changes while it is measured
MEMORY_EVERY_S = 5.0  # of data
MAP_EVERY_S = 1.0  # of data


@dataclass
class Profile:
    """Of one replay."""

    threads: int
    frames: list[dict[str, Cost]] = field(default_factory=list)  # by stage
    kernel: list[Cost] = field(default_factory=list)
    seconds: float = 0.0  # of data, between the first and the last frame
    resets: int = 0
    motion: Motion | None = None  # None: no pose was estimated


def profile(recording: Recording, threads: int) -> Profile:
    """Replays a recording as ``line_slam replay`` does, a stopwatch in hand; kernels are compiled before."""
    cv2.setRNGSeed(0)
    found, watch, estimates, stamps = Profile(threads), Stopwatch(), [], []
    kernel_cost()
    with opened(recording) as source, TemporaryDirectory() as scratch:
        slam, inbox = ProfiledSlam(source.config, source.calibration), source.inbox()
        slam.warm_up()
        with Results(Path(scratch), source.shell, {}, slam, inbox, with_figure=False) as results:
            for frame, imu in _pairs(source, inbox, watch):
                try:
                    estimate = slam.process(frame, imu)
                except ValueError as error:  # as in a replay
                    inbox.reject('image not usable', str(error), frame.t_ns)
                    continue
                for stage, cost in slam.costs().items():
                    watch.add(stage, cost)
                with watch.stage('publish'):
                    results.add(frame.t_ns, imu, estimate)
                watch.end_frame()
                stamps.append(frame.t_ns)
                estimates += [estimate] if estimate is not None else []
                if len(watch.frames) % KERNEL_EVERY == 1:
                    found.kernel.append(kernel_cost())
    found.seconds = (stamps[-1] - stamps[0]) * 1e-9 if stamps else 0.0
    found.frames, found.resets, found.motion = watch.frames, slam.resets, motion_of(estimates)
    return found


def _pairs(source: Source, inbox: Any, watch: Stopwatch) -> Iterator[tuple[Any, Any]]:
    """Frames with their inertial samples; reading and decoding are timed."""
    messages = source.messages()
    while True:
        with watch.stage('read'):
            item = next(messages, None)
        if item is None:
            inbox.close()
        elif item[0] == source.topics.image:
            with watch.stage('decode'):
                frame = source.frame(item[1])
            inbox.frame(frame)
        else:
            with watch.stage('read'):
                inbox.imu(*source.sample(item[1]))
        while (pair := inbox.take()) is not None:
            yield pair
        if item is None:
            return


def motion_of(estimates: Sequence[Estimate]) -> Motion | None:
    """The biases are medians over all of them; None without any."""
    if not estimates:
        return None
    columns = ([getattr(e, name) for e in estimates] for name in ('t_ns', 'T_WB', 'v_W', 'gyro_bias', 'accel_bias'))
    t_ns, T_WB, v_W, gyro_bias, accel_bias = map(np.array, columns)
    return Motion(t_ns, T_WB, v_W, np.median(gyro_bias, axis=0), np.median(accel_bias, axis=0))


@dataclass(frozen=True)
class Command:
    """One run of ``line_slam replay`` as a user starts it."""

    wall_s: float
    cpu_s: float
    peak_mib: float
    log: str

    def used(self) -> dict[str, float]:
        """For JSON."""
        return {'wall_s': self.wall_s, 'cpu_s': self.cpu_s, 'peak_mib': self.peak_mib}


def replay_command(recording: Recording, cores: int = 1, **variables: str) -> Command:
    """On so many cores, figure and all. ValueError, with what it said, if it fails; variables: of the environment."""
    with TemporaryDirectory() as scratch:
        words = ['replay', recording.bag, '--output', scratch, *(w for s in recording.settings for w in ('--set', s))]
        words += ['--calibration', recording.calibration] if recording.calibration else []
        words += ['--duration', recording.duration_s] if recording.duration_s is not None else []
        log = Path(scratch) / 'log.txt'
        with surroundings(cores, **IN_ORDER, **variables), log.open('w', encoding='utf-8') as stream:
            began = time.perf_counter()
            process = subprocess.Popen([sys.executable, '-m', 'line_slam_ros.cli.main', *map(str, words)],
                                       stdout=stream, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        wall_s, text = time.perf_counter() - began, log.read_text(encoding='utf-8', errors='replace')
    if process.returncode != 0 and 'no pose was estimated' not in text:  # a clip may be too short for a pose
        raise ValueError(f'line_slam replay failed: {text[-2000:]}')
    return Command(wall_s, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / MIB, text)


def memory(recording: Recording, motion: Motion, minutes: float) -> Memory:
    """Shows the recording to and fro to a Slam, as the node has it, for minutes of data."""
    cv2.setRNGSeed(0)
    with opened(recording) as source:
        tape = Tape.of(source)
        slam, inbox, make_marker = Slam(source.config, source.calibration), source.inbox(), bag_marker_maker()
        slam.warm_up()
        within = frames_within(tape.frames_ns, motion)
        images, frames_ns = tape.images[within], tape.frames_ns[within]
        pace = ToAndFro((frames_ns[-1] - frames_ns[0]) * 1e-9)
        began, due_s, map_due_s, frames, samples = time.monotonic(), 0.0, 0.0, 0, [(0.0, resident_mib(), 0)]
        for shown in showing(tape.imu, frames_ns, motion, pace, sample_rate(tape.imu.t_ns)):
            t_s = shown.t_ns * 1e-9
            if t_s > 60.0 * minutes:
                break
            source.put(inbox, shown, images)
            while (pair := inbox.take()) is not None:
                try:
                    slam.process(*pair)
                except ValueError as error:  # as in a replay
                    inbox.reject('image not usable', str(error), pair[0].t_ns)
                frames += 1
            if t_s >= map_due_s:
                make_marker(shown.t_ns, slam.line_map.segments().ends)
                map_due_s += MAP_EVERY_S
            if t_s >= due_s + MEMORY_EVERY_S:
                due_s += MEMORY_EVERY_S
                samples.append((t_s, resident_mib(), len(slam.line_map.segments())))
        held = sum(len(image.data) for image in images) / MIB
    return Memory(*zip(*samples, strict=True), frames, slam.resets, time.monotonic() - began, held)
