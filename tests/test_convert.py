"""EuRoC/ASL folders to bags: made up ones, and an excerpt of a real one where it is at hand."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from bag_samples import line_slam

from line_slam_ros.calibration import read_kalibr
from line_slam_ros.cli.bag_reader import open_bag
from msg_adapters import sensors

EUROC = Path(__file__).parents[1].parent / 'shared' / 'data' / 'euroc_v101_asl'
START = 1_403_715_273_262_142_976
CAMERA = '''%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, 0.0, 1.0, 0.1,
         -1.0, 0.0, 0.0, 0.2,
         0.0, -1.0, 0.0, 0.3,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [50.0, 51.0, 32.0, 24.0]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]
'''
IMU = '''%YAML:1.0
rate_hz: 200
gyroscope_noise_density: 1.7e-04
gyroscope_random_walk: 1.9e-05
accelerometer_noise_density: 2.0e-3
accelerometer_random_walk: 3.0e-3
'''


def picture(i: int) -> np.ndarray:
    return np.random.default_rng(i).integers(0, 256, (48, 64), dtype=np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Ten images listed, the last three without file; IMU and truth for three seconds."""
    root = tmp_path / 'asl' / 'mav0'
    (root / 'cam0' / 'data').mkdir(parents=True)
    (root / 'imu0').mkdir()
    (root / 'state_groundtruth_estimate0').mkdir()
    (root / 'cam0' / 'sensor.yaml').write_text(CAMERA)
    (root / 'imu0' / 'sensor.yaml').write_text(IMU)
    stamps = [START + i * 50_000_000 for i in range(10)]
    for i, t in enumerate(stamps[:7]):
        cv2.imwrite(str(root / 'cam0' / 'data' / f'{t}.png'), picture(i))
    listed = ''.join(f'{t},{t}.png\r\n' for t in stamps)
    (root / 'cam0' / 'data.csv').write_text('#timestamp [ns],filename\r\n' + listed)
    (root / 'imu0' / 'data.csv').write_text('#timestamp [ns],w,w,w,a,a,a\n' + ''.join(
        f'{START + i * 5_000_000},0.1,0.2,0.3,1.0,2.0,{9 + i / 1000}\n' for i in range(600)))
    (root / 'state_groundtruth_estimate0' / 'data.csv').write_text('#time(ns),p,q,v,b\n' + ''.join(
        f'{START + i * 50_000_000},{i},2.0,3.0,0.5,0.5,-0.5,0.5,0,0,0,0,0,0,0,0,0\n' for i in range(60)))
    return tmp_path / 'asl'


@pytest.mark.parametrize('images', ['png', 'jpeg', 'raw'])
def test_images_survive(folder, tmp_path, images):
    code, out, err = line_slam('convert', folder, tmp_path / 'bag', '--images', images)
    assert code == 0, err
    assert '7 images' in out
    topic = '/cam0/image_raw' if images == 'raw' else '/cam0/image_raw/compressed'
    decode = sensors.image_to_frame if images == 'raw' else sensors.compressed_to_frame
    with open_bag(tmp_path / 'bag') as bag:
        frames = [decode(m) for _, m in bag.messages((topic,))]
    assert [f.t_ns for f in frames] == [START + i * 50_000_000 for i in range(7)]
    for i, frame in enumerate(frames):
        difference = np.abs(frame.image.astype(int) - picture(i)).mean()
        assert difference < 12 if images == 'jpeg' else difference == 0  # JPEG at 90 of white noise


def test_missing_images_are_counted_and_reported(folder, tmp_path):
    _, _, err = line_slam('convert', folder, tmp_path / 'bag')
    assert '3 images of data.csv have no file' in err


def test_imu_and_truth_are_kept_around_the_images(folder, tmp_path):
    line_slam('convert', folder, tmp_path / 'bag')
    with open_bag(tmp_path / 'bag') as bag:
        imu = [sensors.imu_fields(m) for _, m in bag.messages(('/imu0',))]
        poses = [sensors.pose_from_msg(m) for _, m in bag.messages(('/ground_truth/pose',))]
        stamps = [sensors.stamp_ns(m) for _, m in bag.messages(tuple(bag.types))]
    assert stamps == sorted(stamps)
    assert imu[3] == (START + 15_000_000, (0.1, 0.2, 0.3), (1.0, 2.0, 9.003))
    assert imu[-1][0] == poses[-1][0] == START + 1_300_000_000  # a second after the last image
    np.testing.assert_allclose(poses[4][1][:3, 3], [4.0, 2.0, 3.0])
    np.testing.assert_allclose(poses[4][1][:3, :3], rotation_xyzw(0.5, -0.5, 0.5, 0.5), atol=1e-12)
    truth = np.loadtxt(tmp_path / 'bag' / 'groundtruth.tum')
    assert len(truth) == len(poses)
    np.testing.assert_allclose(truth[4, 1:], [4.0, 2.0, 3.0, 0.5, -0.5, 0.5, 0.5], atol=1e-9)


def rotation_xyzw(x: float, y: float, z: float, w: float) -> np.ndarray:
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def test_calibration_is_written_for_replay(folder, tmp_path):
    line_slam('convert', folder, tmp_path / 'bag')
    calibration = read_kalibr(tmp_path / 'bag' / 'calibration.yaml')
    assert (calibration.width, calibration.height) == (64, 48)
    assert calibration.intrinsics == (50.0, 51.0, 32.0, 24.0)
    assert calibration.imu_noise.accel_walk == 3e-3
    np.testing.assert_allclose(calibration.T_BC[:3], [[0, 0, 1, 0.1], [-1, 0, 0, 0.2], [0, -1, 0, 0.3]], atol=1e-12)
    with open_bag(tmp_path / 'bag') as bag:
        info = next(iter(bag.messages(('/cam0/camera_info',))))[1]
    again = sensors.camera_info_to_calibration(info, calibration.T_BC)
    assert (again.intrinsics, again.distortion) == (calibration.intrinsics, calibration.distortion)


@pytest.mark.parametrize(('path', 'content', 'says'), [
    ('imu0/data.csv', None, 'is no EuRoC/ASL folder'),
    ('imu0/data.csv', f'{START},1,2\n', 'data.csv:1: expected a stamp in ns and 6 columns'),
    ('imu0/data.csv', f'{START},1,2,3,4,5,x\n', 'not all numbers at stamp'),
    ('imu0/data.csv', f'{START},1,2,3,4,5,6\n' * 2, 'data.csv:2: stamps must increase'),
    ('cam0/data.csv', '#timestamp,filename\n1,none.png\n', 'holds none of the 1 images'),
    ('cam0/sensor.yaml', 'rate_hz: 20', 'sensor.yaml: T_BS is missing'),
    ('cam0/sensor.yaml', CAMERA.replace('radial-tangential', 'omni'), "unknown distortion model 'omni'"),
    ('imu0/sensor.yaml', IMU + 'T_BS: {data: [1,0,0,1, 0,1,0,0, 0,0,1,0, 0,0,0,1]}', 'T_BS is not the identity')])
def test_broken_folders_say_what_is_wrong(folder, tmp_path, path, content, says):
    if content is None:
        (folder / 'mav0' / path).unlink()
    else:
        (folder / 'mav0' / path).write_text(content)
    code, _, err = line_slam('convert', folder, tmp_path / 'bag')
    assert code == 2 and says in err


def test_an_existing_bag_is_not_overwritten(folder, tmp_path):
    (tmp_path / 'bag').mkdir()
    code, _, err = line_slam('convert', folder, tmp_path / 'bag')
    assert code == 2 and 'exists already; remove it or choose another place' in err


def test_a_real_excerpt(tmp_path):
    if not EUROC.is_dir():
        pytest.skip(f'needs {EUROC}: an excerpt of EuRoC V1_01_easy in ASL form')
    code, out, err = line_slam('convert', EUROC, tmp_path / 'bag')
    assert code == 0 and '50 images' in out and 'have no file' in err
    with open_bag(tmp_path / 'bag') as bag:
        assert bag.counts['/cam0/image_raw/compressed'] == bag.counts['/cam0/camera_info'] == 50
        assert bag.counts['/imu0'] > 400
