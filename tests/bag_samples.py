"""Small bags for tests: a textured still scene, and excerpts of the shipped recording."""
from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import message_samples as samples
import numpy as np
import pytest

from msg_adapters.factories import MessageFactory

IMAGE, INFO, IMU, POSE = '/camera/image_raw', '/camera/camera_info', '/imu/data', '/ground_truth/pose'
START_NS = 1_700_000_000_000_000_000
SIZE = (320, 240)
IDENTITY = 'T_body_camera=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]'
OFFICE = Path(__file__).parents[1] / 'bags' / 'office'


class Stamped(NamedTuple):
    """A message as a bag holds it."""

    t_ns: int
    topic: str
    message: Any


@lru_cache(maxsize=1)
def texture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, SIZE[::-1], dtype=np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX)


def still_scene(new: MessageFactory, seconds: float = 0.5) -> list[Stamped]:
    """Images and camera_info at 20 Hz, IMU at 200 Hz, nothing moves."""
    scene = []
    for i in range(round(seconds * 200) + 1):
        t_ns = START_NS + i * 5_000_000
        scene.append(Stamped(t_ns, IMU, samples.imu(new, t_ns, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))))
        if i % 10 == 5:
            picture = samples.image(new, 'mono8', SIZE[1], SIZE[0], SIZE[0], texture().tobytes(), t_ns)
            scene.append(Stamped(t_ns, IMAGE, picture))
            scene.append(Stamped(t_ns, INFO, samples.camera_info(
                new, (250.0, 0.0, 160.0, 0.0, 250.0, 120.0, 0.0, 0.0, 1.0), size=SIZE)))
    return scene


def write(directory: Path, messages: Iterable[Stamped]) -> Path:
    """A rosbag2 directory; log times increase in the order given, whatever the headers say."""
    from line_slam_ros.cli.bag_writer import BagWriter
    with BagWriter(directory) as writer:
        for i, (_, topic, message) in enumerate(messages):
            writer.write(topic, START_NS + i, message)
    return directory


def mcap_of(bag: Path) -> Path:
    return next(bag.glob('*.mcap'))


def office_excerpt(directory: Path, start_s: float, seconds: float,
                   change: Callable[[Stamped], Iterable[Stamped]] = lambda stamped: (stamped,)) -> Path:
    """Part of the shipped recording with its calibration, every message passed through ``change``."""
    reader = pytest.importorskip('rosbags.highlevel', reason='rosbags is not installed')
    if not (OFFICE / 'bag').is_dir():
        pytest.skip(f'the shipped bag {OFFICE / "bag"} is missing')
    with reader.AnyReader([OFFICE / 'bag']) as bag:
        begin = bag.start_time + round(start_s * 1e9)
        messages = [Stamped(t_ns, c.topic, bag.deserialize(raw, c.msgtype))
                    for c, t_ns, raw in bag.messages(start=begin, stop=begin + round(seconds * 1e9))]
    write(directory, (changed for stamped in messages for changed in change(stamped)))
    (directory / 'calibration.yaml').write_text((OFFICE / 'calibration.yaml').read_text())
    return directory


def line_slam(*arguments: object) -> tuple[int, str, str]:
    """Runs the command line in this process: exit code, standard output, standard error."""
    from line_slam_ros.cli.main import main
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(list(map(str, arguments)))
    return code, out.getvalue(), err.getvalue()
