"""Runs of the recordings' benchmark, each in a process of its own, so that none can take the others down."""
from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from line_slam_ros.benchmark.rows import FAILED, Row, finished_row, timeout_row
from line_slam_ros.benchmark.suite import Recording, Variant
from line_slam_ros.cli.bag_reader import open_bag
from line_slam_ros.cli.results import TumWriter
from msg_adapters import sensors

ONE_THREAD = dict.fromkeys(('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS', 'NUMBA_NUM_THREADS'), '1')
IN_ORDER = {'PYTHONUNBUFFERED': '1'}  # of what a command says on both streams, the last word comes last


def run_recording(recording: Recording, output: Path, timeout_s: float) -> Iterator[Row]:
    """One row per variant, as they end."""
    directory = output / _file_name(recording.name)
    directory.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix='line_slam_benchmark_') as scratch:
        try:
            bag, truth = prepared(recording, Path(scratch), directory, timeout_s)
        except (OSError, ValueError) as error:
            yield from (Row(recording.name, v.name, recording.copy_of, FAILED, str(error)) for v in recording.variants)
            return
        for variant in recording.variants:
            yield _run(recording, variant, bag, truth, directory / _file_name(variant.name), timeout_s)


def _run(recording: Recording, variant: Variant, bag: Path, truth: Path | None, directory: Path,
         timeout_s: float) -> Row:
    directory.mkdir(exist_ok=True)
    for stale in ('metrics.json', 'trajectory.tum'):
        (directory / stale).unlink(missing_ok=True)
    words = ['replay', bag, '--output', directory, '--no-figure', '--start', recording.start_s,
             *_each('--set', recording.settings | variant.settings),
             *_each('--degrade', recording.degradation.changes())]
    words += ['--duration', recording.duration_s] if recording.duration_s is not None else []
    words += ['--calibration', recording.calibration] if recording.calibration else []
    try:
        code, last_words = _line_slam(words, directory / 'log.txt', timeout_s)
    except subprocess.TimeoutExpired:
        return timeout_row(recording, variant, timeout_s)
    return finished_row(recording, variant, directory, code, last_words, truth)


def prepared(recording: Recording, scratch: Path, directory: Path, timeout_s: float) -> tuple[Path, Path | None]:
    """The bag to replay and the TUM file of the truth; ValueError if either cannot be made."""
    if recording.asl is not None:
        bag = scratch / 'bag'
        words = ['convert', recording.asl, bag, '--camera', recording.camera]
        try:
            code, last_words = _line_slam(words, directory / 'convert.txt', timeout_s)
        except subprocess.TimeoutExpired:
            raise ValueError(f'{recording.asl} was not converted within {timeout_s:g} s') from None
        if code != 0:
            raise ValueError(f'{recording.asl} cannot be converted: {last_words}')
        own_truth = bag / 'groundtruth.tum'
        return bag, recording.truth or (own_truth if own_truth.is_file() else None)
    if recording.truth_topic:
        return recording.bag, _truth_of(recording.bag, recording.truth_topic, scratch / 'groundtruth.tum')
    return recording.bag, recording.truth


def _truth_of(path: Path, topic: str, tum: Path) -> Path:
    """The poses of a topic, written as a TUM file."""
    with open_bag(path) as bag, TumWriter(tum) as file:
        if topic not in bag.types:
            raise ValueError(f'{path} has no topic {topic} (truth_topic); it has {", ".join(sorted(bag.types))}')
        for _, message in bag.messages((topic,)):
            file.add(*sensors.pose_from_msg(message))
    return tum


def _line_slam(words: Sequence[Any], log: Path, timeout_s: float) -> tuple[int, str]:
    """Exit code and the last line of a command's output, which goes to the log."""
    command = [sys.executable, '-m', 'line_slam_ros.cli.main', *map(str, words)]
    with log.open('w', encoding='utf-8') as stream:
        done = subprocess.run(command, stdout=stream, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, check=False,
                              env=os.environ | ONE_THREAD | IN_ORDER, timeout=timeout_s)
    lines = [line for line in re.split(r'[\r\n]+', log.read_text(encoding='utf-8', errors='replace')) if line.strip()]
    return done.returncode, lines[-1] if lines else ''


def _each(option: str, values: dict[str, Any]) -> list[str]:
    return [word for name, value in values.items() for word in (option, f'{name}={json.dumps(value)}')]


def _file_name(name: str) -> str:
    """The name as a directory's: letters, digits, dots, hyphens and underscores."""
    return re.sub(r'[^\w.-]+', '_', name).strip('_.') or '_'
