"""The calibration for a replay: from the user, from beside the bag, or from its camera_info."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from line_slam_ros.calibration import checked_rigid, read_imu_noise, read_kalibr
from line_slam_ros.cli.bag_reader import Bag
from line_slam_ros.cli.bag_topics import Topics
from line_slam_ros.shell_config import ShellConfig
from line_slam_ros.types import Calibration, ImuNoise
from msg_adapters import sensors


def with_calibration_beside(shell: ShellConfig, bag: Path) -> ShellConfig:
    """If the user gave none: calibration.yaml in the bag's directory or beside it, where ``convert`` leaves it."""
    if shell.calibration_file or shell.T_body_camera:
        return shell
    for directory in (bag, bag.resolve().parent):
        if (directory / 'calibration.yaml').is_file():
            return replace(shell, calibration_file=str(directory / 'calibration.yaml'))
    return shell


def find_calibration(bag: Bag, topics: Topics, shell: ShellConfig) -> tuple[Calibration, str]:
    """From the Kalibr file, else from the first camera_info and T_body_camera, with a note for the human ('' if none).

    Raises OSError, or ValueError that says what is missing.
    """
    if shell.calibration_file:
        calibration = read_kalibr(shell.calibration_file, shell.imu_calibration_file, shell.camera_name)
        return calibration, (_difference_to_camera_info(bag, topics, calibration)
                             or f'using the calibration {shell.calibration_file}')
    if not topics.camera_info:
        raise ValueError('the bag has no camera_info and no calibration was given; give a Kalibr camchain-imucam.yaml '
                         'with --calibration')
    if not shell.T_body_camera:
        raise ValueError('where the camera sits on the body is unknown; give a Kalibr camchain-imucam.yaml with '
                         '--calibration, or T_body_camera (16 numbers) in a parameter file')
    message = _first_camera_info(bag, topics)
    if message is None:
        raise ValueError(f'{topics.camera_info} holds no message; give a Kalibr file with --calibration')
    noise = read_imu_noise(shell.imu_calibration_file) if shell.imu_calibration_file else ImuNoise()
    T_BC = checked_rigid(shell.T_body_camera, 'T_body_camera')
    return sensors.camera_info_to_calibration(message, T_BC, shell.time_offset, noise), ''


def _first_camera_info(bag: Bag, topics: Topics) -> Any | None:
    if not topics.camera_info:
        return None
    return next((message for _, message in bag.messages((topics.camera_info,))), None)


def _difference_to_camera_info(bag: Bag, topics: Topics, calibration: Calibration) -> str:
    """The file is believed; this says so if the bag's own calibration is another one, since files get mixed up."""
    message = _first_camera_info(bag, topics)
    if message is None:
        return ''
    try:
        other = sensors.camera_info_to_calibration(message, calibration.T_BC)
    except ValueError:  # a camera_info that says nothing is what the file is for
        return ''
    if all(abs(a - b) <= 0.02 * b for a, b in zip(calibration.intrinsics, other.intrinsics, strict=True)):
        return ''
    return (f'the calibration file says fx fy cx cy = {calibration.intrinsics}, {topics.camera_info} says '
            f'{other.intrinsics}: using the file; check that it belongs to this camera')
