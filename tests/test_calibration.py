"""Kalibr files, combined and separate, and what is said about broken ones."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from line_slam_ros.calibration import read_imu_noise, read_kalibr
from line_slam_ros.types import ImuNoise

CAMERA = '''
cam0:
  camera_model: pinhole
  intrinsics: [458.0, 457.0, 367.0, 248.0]
  distortion_model: radtan
  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]
  resolution: [752, 480]
  timeshift_cam_imu: -0.013
  T_cam_imu:
  - [0.0, -1.0, 0.0, 0.1]
  - [0.0, 0.0, -1.0, 0.2]
  - [1.0, 0.0, 0.0, 0.3]
  - [0.0, 0.0, 0.0, 1.0]
'''
NOISE = '''accelerometer_noise_density: 0.01
accelerometer_random_walk: 0.0002
gyroscope_noise_density: 0.005
gyroscope_random_walk: 4.0e-06
rostopic: /imu0
update_rate: 200.0
'''


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_combined_file(tmp_path):
    noise = 'imu0:\n' + ''.join(f'  {line}\n' for line in NOISE.splitlines())
    calibration = read_kalibr(write(tmp_path / 'both.yaml', CAMERA + noise))
    assert (calibration.model, calibration.width, calibration.height) == ('radtan', 752, 480)
    assert calibration.intrinsics == (458.0, 457.0, 367.0, 248.0)
    assert calibration.distortion == (-0.28, 0.07, 0.0002, 0.00002)
    assert calibration.time_offset == -0.013
    assert calibration.imu_noise == ImuNoise(0.005, 4e-6, 0.01, 2e-4)


def test_T_cam_imu_is_inverted_to_camera_in_body(tmp_path):
    T_BC = read_kalibr(write(tmp_path / 'c.yaml', CAMERA)).T_BC
    np.testing.assert_allclose(T_BC[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-15)  # optical axis along the body's x
    np.testing.assert_allclose(T_BC[:3, 3], [-0.3, 0.1, 0.2], atol=1e-15)


@pytest.mark.parametrize('under_imu0', [True, False])
def test_separate_imu_file(tmp_path, under_imu0):
    text = 'imu0:\n' + ''.join(f'  {line}\n' for line in NOISE.splitlines()) if under_imu0 else NOISE
    calibration = read_kalibr(write(tmp_path / 'c.yaml', CAMERA), write(tmp_path / 'imu.yaml', text))
    assert calibration.imu_noise == ImuNoise(0.005, 4e-6, 0.01, 2e-4)


def test_noise_defaults_without_any(tmp_path):
    assert read_kalibr(write(tmp_path / 'c.yaml', CAMERA)).imu_noise == ImuNoise()


def test_a_yaml_header_of_opencv_is_tolerated(tmp_path):
    assert read_imu_noise(write(tmp_path / 'imu.yaml', '%YAML:1.0\n' + NOISE)).gyro_density == 0.005


def test_camera_is_chosen_by_name(tmp_path):
    both = write(tmp_path / 'c.yaml', CAMERA + CAMERA.replace('cam0', 'cam1').replace('458.0', '500.0'))
    assert read_kalibr(both, camera='cam1').intrinsics[0] == 500.0
    with pytest.raises(ValueError, match=r'c\.yaml: has several cameras; choose one of cam0, cam1'):
        read_kalibr(both)
    with pytest.raises(ValueError, match="has no camera 'cam7'; choose one of cam0, cam1"):
        read_kalibr(both, camera='cam7')


@pytest.mark.parametrize(('model', 'coefficients', 'ours'), [
    ('equidistant', '[0.1, 0.2, 0.3, 0.4]', ('equidistant', (0.1, 0.2, 0.3, 0.4))),
    ('none', '[]', ('radtan', (0.0, 0.0, 0.0, 0.0)))])
def test_other_distortion_models(tmp_path, model, coefficients, ours):
    text = CAMERA.replace('radtan', model).replace('[-0.28, 0.07, 0.0002, 0.00002]', coefficients)
    calibration = read_kalibr(write(tmp_path / 'c.yaml', text))
    assert (calibration.model, calibration.distortion) == ours


@pytest.mark.parametrize(('old', 'new', 'says'), [
    ('camera_model: pinhole', 'camera_model: omni', "camera_model is 'omni'; only pinhole"),
    ('  intrinsics: [458.0,', '  intrinsics: [0.0,', 'cam0: focal length is 0.0'),
    ('458.0, 457.0, ', '', r'cam0.intrinsics must hold 4 numbers'),
    ('[752, 480]', 'wide', 'cam0.resolution must be a list of numbers'),
    ('radtan', 'fov', "unknown distortion model 'fov'"),
    ('-0.28, ', '', '3 distortion coefficients'),
    ('distortion_model: radtan', 'x: y', 'cam0.distortion_model is missing'),
    ('T_cam_imu', 'T_cn_cnm1', 'T_cam_imu is missing: give the camchain-imucam.yaml'),
    ('- [0.0, -1.0', '- [0.0, -2.0', 'T_cam_imu: is no rigid transform'),
    ('- [0.0, -1.0', '- [0.0, 1.0', 'T_cam_imu: is no rigid transform'),  # a reflection
    ('- [0.0, -1.0, 0.0, 0.1]', '- []', 'T_cam_imu: expected 4x4 numbers'),
    ('-0.013', 'soon', 'timeshift_cam_imu must be seconds'),
    ('cam0:', '{', 'not readable as YAML')])
def test_broken_camera_files_say_what_to_do(tmp_path, old, new, says):
    assert old in CAMERA
    with pytest.raises(ValueError, match=f'c.yaml.*{says}'):
        read_kalibr(write(tmp_path / 'c.yaml', CAMERA.replace(old, new)))


@pytest.mark.parametrize(('text', 'says'), [
    ('just words', 'is no calibration file'), ('imu0: {}', 'holds no camera'), ('', 'is no calibration file')])
def test_files_without_cameras_say_what_to_do(tmp_path, text, says):
    with pytest.raises(ValueError, match=says):
        read_kalibr(write(tmp_path / 'c.yaml', text))


@pytest.mark.parametrize(('old', 'new', 'says'), [
    ('gyroscope_random_walk', 'walk', 'gyroscope_random_walk is missing'),
    ('0.005', '5e-3', 'YAML needs a dot'), ('0.005', '0.0', 'must be a positive number')])
def test_broken_imu_files_say_what_to_do(tmp_path, old, new, says):
    with pytest.raises(ValueError, match=f'imu.yaml.*{says}'):
        read_imu_noise(write(tmp_path / 'imu.yaml', NOISE.replace(old, new)))


def test_a_binary_file_is_named(tmp_path):
    (tmp_path / 'c.yaml').write_bytes(b'\xff\xfe\x00cam0')
    with pytest.raises(ValueError, match=r"c\.yaml: not readable as YAML: 'utf-8' codec can't decode byte 0xff"):
        read_kalibr(tmp_path / 'c.yaml')


def test_a_missing_file_is_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_kalibr(tmp_path / 'none.yaml')
