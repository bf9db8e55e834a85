"""The ASL dataset format: mav0/<sensor>/{sensor.yaml,data.csv}, stamps in nanoseconds.

https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets
"""
from __future__ import annotations

import csv
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from line_slam_ros.calibration import checked_calibration, checked_rigid, read_imu_noise, read_mapping
from line_slam_ros.geometry.lie import matrix_from_quaternion, rigid
from line_slam_ros.types import F64, Calibration

Row = tuple[int, tuple[float, ...]]  # t_ns, numbers


@dataclass(frozen=True)
class AslFolder:
    """One camera, the IMU and the ground truth of a recording; stamps increase."""

    calibration: Calibration
    imu_rate: float  # Hz
    images: list[tuple[int, Path]]  # that exist
    missing_images: int  # listed in data.csv without a file
    imu: list[Row]  # gyro_B rad/s, accel_B m/s^2
    truth: list[tuple[int, F64]]  # t_ns, T_WB; empty if the recording has none


def read_asl(folder: Path, camera: str, margin_s: float = 1.0) -> AslFolder:
    """The recording under ``folder``; IMU and truth are cut to the images and margin_s around them.

    Raises OSError, or ValueError that names the file and what is wrong with it.
    """
    root = folder / 'mav0' if (folder / 'mav0').is_dir() else folder
    for sensor in (camera, 'imu0'):
        if not (root / sensor / 'data.csv').is_file():
            raise ValueError(f'{folder} is no EuRoC/ASL folder: {root / sensor / "data.csv"} is missing')
    listed = [(t, root / camera / 'data' / name) for t, (name,) in _rows(root / camera / 'data.csv', 1)]
    images = [(t, path) for t, path in listed if path.is_file()]
    if not images:
        raise ValueError(f'{root / camera / "data"} holds none of the {len(listed)} images that data.csv lists')
    margin = round(margin_s * 1e9)
    span = images[0][0] - margin, images[-1][0] + margin
    imu_settings = read_mapping(root / 'imu0' / 'sensor.yaml')
    return AslFolder(_calibration(root, camera, imu_settings), float(imu_settings.get('rate_hz', 0.0)), images,
                     len(listed) - len(images), _cut(_numbers(root / 'imu0' / 'data.csv', 6), span),
                     _cut(_truth(root / 'state_groundtruth_estimate0' / 'data.csv'), span))


def _calibration(root: Path, camera: str, imu_settings: dict[str, Any]) -> Calibration:
    path, imu_path = root / camera / 'sensor.yaml', root / 'imu0' / 'sensor.yaml'
    settings = read_mapping(path)
    for key in ('T_BS', 'resolution', 'intrinsics', 'distortion_model', 'distortion_coefficients'):
        if key not in settings:
            raise ValueError(f'{path}: {key} is missing; take the sensor.yaml of the dataset')
    T_BI = checked_rigid(imu_settings.get('T_BS', {}).get('data', np.eye(4)), f'{imu_path}: T_BS')
    if np.abs(T_BI - np.eye(4)).max() > 1e-9:
        raise ValueError(f'{imu_path}: T_BS is not the identity; only recordings whose body is the IMU are supported')
    return checked_calibration(settings['distortion_model'], settings['resolution'], settings['intrinsics'],
                               settings['distortion_coefficients'], settings['T_BS']['data'], str(path),
                               imu_noise=read_imu_noise(imu_path))


def _truth(path: Path) -> list[tuple[int, F64]]:
    """T_WB from rows t, p, q_wxyz, ...; none if there is no file."""
    if not path.is_file():
        return []
    poses = []
    for t_ns, (x, y, z, qw, qx, qy, qz, *_) in _numbers(path, 7):
        norm = (qw * qw + qx * qx + qy * qy + qz * qz) ** 0.5
        poses.append((t_ns, rigid(matrix_from_quaternion(np.array([qx, qy, qz, qw]) / norm), np.array([x, y, z]))))
    return poses


def _numbers(path: Path, count: int) -> list[Row]:
    rows = []
    for t_ns, texts in _rows(path, count):
        try:
            rows.append((t_ns, tuple(map(float, texts))))
        except ValueError:
            raise ValueError(f'{path}: not all numbers at stamp {t_ns}: {texts}') from None
    return rows


def _rows(path: Path, count: int) -> Iterator[tuple[int, list[str]]]:
    """(t_ns, further columns) of a data.csv with at least ``count`` of them, in increasing time."""
    last = -1
    with path.open(newline='', encoding='utf-8') as file:
        for number, row in enumerate(csv.reader(file), 1):
            if not row or row[0].startswith('#'):
                continue
            texts = [text.strip() for text in row if text.strip()]
            if len(texts) <= count or not texts[0].isdigit():
                raise ValueError(f'{path}:{number}: expected a stamp in ns and {count} columns, got {row}')
            if int(texts[0]) <= last:
                raise ValueError(f'{path}:{number}: stamps must increase, {texts[0]} does not')
            last = int(texts[0])
            yield last, texts[1:]


def _cut(rows: Sequence[Any], span: tuple[int, int]) -> list[Any]:
    stamps = [row[0] for row in rows]
    return list(rows[bisect_left(stamps, span[0]):bisect_right(stamps, span[1])])
