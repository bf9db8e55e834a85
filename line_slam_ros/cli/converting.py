"""The work behind ``line_slam convert``."""
from __future__ import annotations

import sys
from collections.abc import Iterator
from heapq import merge
from pathlib import Path
from typing import Any

import cv2
from tqdm import tqdm

from line_slam_ros.calibration import kalibr_text
from line_slam_ros.cli.asl_folder import AslFolder, read_asl
from line_slam_ros.cli.bag_writer import BagWriter
from line_slam_ros.cli.results import TumWriter
from msg_adapters import outputs
from msg_adapters.factories import MessageFactory

_IMU_TOPIC, _TRUTH_TOPIC = '/imu0', '/ground_truth/pose'
Stamped = tuple[int, str, Any]  # t_ns, topic, message


def convert(folder: Path, bag: Path, camera: str, images: str, quality: int) -> int:
    """Writes the bag, its calibration.yaml and groundtruth.tum; ValueError or OSError if the folder cannot be used."""
    recording = read_asl(folder, camera)
    topic = f'/{camera}/image_raw' + ('' if images == 'raw' else '/compressed')
    with BagWriter(bag) as writer:
        new = writer.new
        streams = merge(_image_messages(new, recording, camera, topic, images, quality), _imu_messages(new, recording),
                        _truth_messages(new, recording), key=lambda stamped: stamped[0])
        total = 2 * len(recording.images) + len(recording.imu) + len(recording.truth)
        for t_ns, name, message in tqdm(streams, total=total, unit='msg', desc='convert', dynamic_ncols=True):
            writer.write(name, t_ns, message)
    text = kalibr_text(recording.calibration, camera, f'/{camera}/image_raw', _IMU_TOPIC, recording.imu_rate)
    (bag / 'calibration.yaml').write_text(text, encoding='utf-8')
    if recording.truth:
        with TumWriter(bag / 'groundtruth.tum') as file:
            for t_ns, T_WB in recording.truth:
                file.add(t_ns, T_WB)
    _report(recording, bag)
    return 0


def _image_messages(new: MessageFactory, recording: AslFolder, camera: str, topic: str, images: str,
                    quality: int) -> Iterator[Stamped]:
    """Each image, followed by its camera_info."""
    for t_ns, path in recording.images:
        if images == 'raw':
            message = outputs.image(new, _pixels(path), t_ns, camera)
        else:
            message = outputs.compressed_image(new, _encoded(path, images, quality), images, t_ns, camera)
        yield t_ns, topic, message
        yield t_ns, f'/{camera}/camera_info', outputs.camera_info(new, recording.calibration, t_ns, camera)


def _imu_messages(new: MessageFactory, recording: AslFolder) -> Iterator[Stamped]:
    for t_ns, values in recording.imu:
        yield t_ns, _IMU_TOPIC, outputs.imu(new, t_ns, values[:3], values[3:6], 'imu0')


def _truth_messages(new: MessageFactory, recording: AslFolder) -> Iterator[Stamped]:
    for t_ns, T_WB in recording.truth:
        yield t_ns, _TRUTH_TOPIC, outputs.pose_stamped(new, t_ns, T_WB, 'world')


def _encoded(path: Path, images: str, quality: int) -> bytes:
    """The file as it is if it has the wanted form already, else encoded anew."""
    if path.suffix.lower() in {'png': ('.png',), 'jpeg': ('.jpg', '.jpeg')}[images]:
        return path.read_bytes()
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if images == 'jpeg' else []
    return cv2.imencode('.jpg' if images == 'jpeg' else '.png', _pixels(path), options)[1].tobytes()


def _pixels(path: Path) -> Any:
    pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise ValueError(f'{path} cannot be decoded as an image')
    return pixels


def _report(recording: AslFolder, bag: Path) -> None:
    print(f'{len(recording.images)} images, {len(recording.imu)} IMU samples, {len(recording.truth)} true poses '
          f'written to {bag}/')
    if recording.missing_images:
        print(f'line_slam convert: {recording.missing_images} images of data.csv have no file and were left out; '
              'IMU and truth are cut to what is left', file=sys.stderr)
