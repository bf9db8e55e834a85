"""Camera and IMU calibration from Kalibr files, and the checks shared with CameraInfo.

Kalibr: ``T_cam_imu`` maps IMU coordinates into the camera, ``timeshift_cam_imu`` is t_imu - t_cam in seconds, noise
densities are continuous-time. https://github.com/ethz-asl/kalibr/wiki/yaml-formats
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from line_slam_ros.geometry.lie import rigid_inverse
from line_slam_ros.types import F64, Calibration, ImuNoise

# name in Kalibr or CameraInfo -> our model and the numbers of coefficients it may have
_MODELS = {
    '': ('radtan', (0,)), 'none': ('radtan', (0,)),
    'plumb_bob': ('radtan', (0, 4, 5)), 'radtan': ('radtan', (4, 5, 8)), 'radial-tangential': ('radtan', (4, 5)),
    'rational_polynomial': ('radtan', (8,)),
    'equidistant': ('equidistant', (4,)), 'fisheye': ('equidistant', (4,)),
}
_NOISE_KEYS = {'gyro_density': 'gyroscope_noise_density', 'gyro_walk': 'gyroscope_random_walk',
               'accel_density': 'accelerometer_noise_density', 'accel_walk': 'accelerometer_random_walk'}


def read_kalibr(path: Path | str, imu_path: Path | str = '', camera: str = '') -> Calibration:
    """Calibration of one camera of a camchain(-imucam).yaml.

    IMU noise comes from ``imu_path`` if given, else from imu0 in ``path``, else defaults. ``camera`` names the camera
    (cam0, ...) and may stay empty if there is only one. Raises OSError, or ValueError naming file, key and remedy.
    """
    chain = read_mapping(path)
    cameras = sorted(key for key, value in chain.items() if isinstance(value, dict) and 'intrinsics' in value)
    name = camera or (cameras[0] if len(cameras) == 1 else '')
    if name not in cameras:
        raise ValueError(f'{path}: {_which_camera(camera, cameras)}')
    where = f'{path}: {name}'
    block = chain[name]
    if _need(block, 'camera_model', where) != 'pinhole':
        raise ValueError(f'{where}.camera_model is {block["camera_model"]!r}; only pinhole is supported: '
                         'calibrate with pinhole-radtan or pinhole-equi')
    return checked_calibration(
        str(_need(block, 'distortion_model', where)), _numbers(block, 'resolution', 2, where),
        _numbers(block, 'intrinsics', 4, where), _numbers(block, 'distortion_coeffs', None, where),
        _camera_in_body(block, where), where, time_offset=_time_offset(block, where),
        imu_noise=read_imu_noise(imu_path) if imu_path else _noise(chain.get('imu0', {}), f'{path}: imu0'))


def read_imu_noise(path: Path | str) -> ImuNoise:
    """Noise densities of a Kalibr imu.yaml, plain or under imu0; ValueError if one is missing."""
    document = read_mapping(path)
    block = document.get('imu0', document)
    for key in _NOISE_KEYS.values():
        _need(block, key, str(path))
    return _noise(block, str(path))


def checked_calibration(model: str, size: Sequence[float], intrinsics: Sequence[float], coefficients: Sequence[float],
                        T_BC: F64, where: str, *, time_offset: float = 0.0,
                        imu_noise: ImuNoise | None = None) -> Calibration:
    """Calibration from plain numbers; ``where`` (file and key, or topic) opens the message of every ValueError.

    size is (width, height), intrinsics fx fy cx cy in px, coefficients in the order of OpenCV.
    """
    if model not in _MODELS:
        raise ValueError(f'{where}: unknown distortion model {model!r}; use plumb_bob (radtan), rational_polynomial, '
                         'equidistant or fisheye')
    if not (intrinsics[0] > 0 and intrinsics[1] > 0):
        raise ValueError(f'{where}: focal length is {intrinsics[0]}, {intrinsics[1]}: the camera is not calibrated; '
                         'run a camera calibration, or give a Kalibr file (calibration_file, --calibration)')
    ours, lengths = _MODELS[model]
    d = _without_zero_tail(coefficients, max(lengths))
    if len(d) not in lengths:
        raise ValueError(f'{where}: {len(d)} distortion coefficients for model {model!r}, which has '
                         f'{" or ".join(map(str, lengths))}; check distortion model and coefficients')
    if not all(math.isfinite(v) for v in (*intrinsics, *d)):
        raise ValueError(f'{where}: intrinsics or distortion hold NaN or infinity; calibrate the camera again')
    if min(size) < 1:
        raise ValueError(f'{where}: image size is {size[0]}x{size[1]}; write the size of the calibrated images')
    return Calibration(ours, int(size[0]), int(size[1]), tuple(map(float, intrinsics)), d or (0.0,) * 4,
                       checked_rigid(T_BC, f'{where}: camera in body'), float(time_offset), imu_noise or ImuNoise())


def checked_rigid(matrix: Any, where: str) -> F64:
    """(4, 4) float64 rigid transform from 16 numbers or nested rows; ValueError if it is not rigid to 1e-3."""
    try:
        T = np.array(matrix, np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        raise ValueError(f'{where}: expected 4x4 numbers, row by row') from None
    R = T[:3, :3]
    proper = np.abs(R @ R.T - np.eye(3)).max() < 1e-3 and np.linalg.det(R) > 0
    if not (np.isfinite(T).all() and proper and np.allclose(T[3], [0, 0, 0, 1])):
        raise ValueError(f'{where}: is no rigid transform: rotation must be orthonormal, last row 0 0 0 1; '
                         f'got {np.round(T, 4).tolist()}')
    u, _, vt = np.linalg.svd(R)
    T[:3, :3] = u @ vt
    return T


def read_mapping(path: Path | str) -> dict[str, Any]:
    """A YAML mapping; tolerates the %YAML:1.0 line of OpenCV and EuRoC files."""
    try:
        text = Path(path).read_text(encoding='utf-8')
        document = yaml.safe_load('\n'.join(line for line in text.splitlines() if not line.startswith('%YAML')))
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f'{path}: not readable as YAML: {" ".join(str(error).split())}') from None
    if type(document) is not dict:
        raise ValueError(f'{path}: is no calibration file; expected a Kalibr camchain-imucam.yaml or imu.yaml')
    return document


def _which_camera(wanted: str, cameras: Sequence[str]) -> str:
    if not cameras:
        return 'holds no camera; expected a Kalibr camchain with cam0: {intrinsics: ...}'
    problem = f'has no camera {wanted!r}' if wanted else 'has several cameras'
    return f'{problem}; choose one of {", ".join(cameras)} (camera_name)'


def _need(block: Mapping[str, Any], key: str, where: str) -> Any:
    if key not in block:
        raise ValueError(f'{where}.{key} is missing; add it as in the Kalibr file format')
    return block[key]


def _numbers(block: Mapping[str, Any], key: str, count: int | None, where: str) -> tuple[float, ...]:
    values = _need(block, key, where)
    try:
        numbers = tuple(float(v) for v in values)
    except (TypeError, ValueError):
        raise ValueError(f'{where}.{key} must be a list of numbers, got {values!r}') from None
    if count is not None and len(numbers) != count:
        raise ValueError(f'{where}.{key} must hold {count} numbers, got {values!r}')
    return numbers


def _camera_in_body(block: Mapping[str, Any], where: str) -> F64:
    if 'T_cam_imu' not in block:
        raise ValueError(f'{where}.T_cam_imu is missing: give the camchain-imucam.yaml of kalibr_calibrate_imu_camera '
                         '(a plain camchain.yaml does not know the IMU)')
    return rigid_inverse(checked_rigid(block['T_cam_imu'], f'{where}.T_cam_imu'))


def _time_offset(block: Mapping[str, Any], where: str) -> float:
    value = block.get('timeshift_cam_imu', 0.0)
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f'{where}.timeshift_cam_imu must be seconds, got {value!r}')
    return float(value)


def _noise(block: Mapping[str, Any], where: str) -> ImuNoise:
    given = {name: block[key] for name, key in _NOISE_KEYS.items() if key in block}
    for name, value in given.items():
        if not isinstance(value, (int, float)) or not value > 0:
            raise ValueError(f'{where}.{_NOISE_KEYS[name]} must be a positive number, got {value!r}; '
                             'YAML needs a dot in 1.0e-4')
    return ImuNoise(**{name: float(value) for name, value in given.items()})


def _without_zero_tail(coefficients: Sequence[float], longest: int) -> tuple[float, ...]:
    """Some drivers pad with zeros (5 for none, 8 for plumb_bob, 14 for rational_polynomial): cut what says nothing."""
    d = tuple(map(float, coefficients))
    return d[:longest] if len(d) > longest and not any(d[longest:]) else d


def kalibr_text(calibration: Calibration, camera: str, image_topic: str, imu_topic: str, imu_rate: float) -> str:
    """The calibration as a camchain-imucam.yaml with the IMU's noise under imu0, as read_kalibr reads it."""
    noise = calibration.imu_noise
    block = {
        'camera_model': 'pinhole', 'intrinsics': list(calibration.intrinsics), 'distortion_model': calibration.model,
        'distortion_coeffs': list(calibration.distortion), 'resolution': [calibration.width, calibration.height],
        'rostopic': image_topic, 'timeshift_cam_imu': calibration.time_offset,
        'T_cam_imu': rigid_inverse(calibration.T_BC).tolist()}
    imu = {'rostopic': imu_topic, 'update_rate': float(imu_rate),
           **{key: getattr(noise, name) for name, key in _NOISE_KEYS.items()}}
    return yaml.safe_dump({camera: block, 'imu0': imu}, sort_keys=False, default_flow_style=None)
