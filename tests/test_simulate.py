"""line_slam simulate: files that read back, the same bytes each time, and what it refuses."""
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from bag_samples import line_slam

from line_slam_ros.cli import main as command_line
from line_slam_ros.experiment.files import read_experiment, read_poses, write_poses
from line_slam_ros.geometry.lie import rigid
from line_slam_ros.simulation.house import Effects, Pinhole, closed_loop, observe, random_house

NAMES = ['cam_pose_tum.txt', 'house.txt', 'observations.txt', 'simulation.json']
KALIBR = """\
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [450.0, 440.0, 370.0, 250.0]
  resolution: [752, 480]
  T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""


def simulated(folder: Path, *options: object) -> str:
    """Standard output of a successful run."""
    code, out, err = line_slam('simulate', 'house', folder, '--frames', 60, *options)
    assert (code, err) == (0, '')
    return out


def settings(folder: Path) -> dict:
    return json.loads((folder / 'simulation.json').read_text())


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_files_read_back_and_the_summary_counts_them(tmp_path):
    out = simulated(tmp_path / 'new' / 'house', '--lines', 50)
    experiment = read_experiment(tmp_path / 'new' / 'house')
    assert experiment.T_WC.shape == (60, 4, 4) and experiment.segments.shape == (50, 2, 3)
    unseen = 50 - len(np.unique(experiment.views.line))
    assert out == (f'{tmp_path / "new" / "house"}: 50 lines, 60 frames, {len(experiment.views.line)} observations, '
                   f'{unseen} lines never seen\n')


def test_every_setting_is_recorded(tmp_path):
    simulated(tmp_path, '--seed', 7, '--lines', 30, '--width', 752, '--height', 480, '--focal', 450, '--noise-px', 1.5,
              '--no-fov-limit', '--partial', 0.2, '--outliers', 0.05, '--swapped', 0.5)
    assert settings(tmp_path) == {
        'world': 'house', 'seed': 7, 'lines': 30, 'frames': 60, 'trajectory': None,
        'camera': {'width': 752, 'height': 480, 'fx': 450.0, 'fy': 450.0, 'cx': 376.0, 'cy': 240.0},
        'effects': {'noise_px': 1.5, 'fov_limit': False, 'partial': 0.2, 'outliers': 0.05, 'swapped': 0.5}}


def test_the_defaults_are_those_of_the_line_code_base(tmp_path):
    assert line_slam('simulate', 'house', tmp_path)[0] == 0
    found = settings(tmp_path)
    assert (found['lines'], found['frames'], found['seed']) == (80, 600, 0)
    assert found['camera'] == {'width': 640, 'height': 640, 'fx': 460.0, 'fy': 460.0, 'cx': 320.0, 'cy': 320.0}
    assert found['effects'] == {'noise_px': 1.0, 'fov_limit': True, 'partial': 0.0, 'outliers': 0.0, 'swapped': 0.0}


def test_the_same_settings_give_the_same_bytes(tmp_path):
    options = ('--seed', 3, '--partial', 0.3, '--outliers', 0.1, '--swapped', 0.5)
    for name in 'ab':
        simulated(tmp_path / name, *options)
    simulated(tmp_path / 'c', '--seed', 4, *options[2:])
    a, b, c = (contents(tmp_path / name) for name in 'abc')
    assert a == b and sorted(a) == NAMES
    assert all(a[name] != c[name] for name in NAMES)
    keys = list(settings(tmp_path / 'a'))
    assert keys == sorted(keys)


def test_the_files_hold_the_simulated_numbers(tmp_path):
    simulated(tmp_path, '--seed', 3, '--noise-px', 2, '--outliers', 0.1)
    experiment = read_experiment(tmp_path)
    segments, (stamps, T_WC) = random_house(3), closed_loop(3, 60)
    frame, line, ends = observe(segments, T_WC, Pinhole(), Effects(noise_px=2.0, outliers=0.1), 3)
    assert np.array_equal(experiment.segments, segments) and np.array_equal(experiment.stamps, stamps)
    assert np.abs(experiment.T_WC - T_WC).max() < 2e-15
    assert np.array_equal(experiment.views.frame, frame) and np.array_equal(experiment.views.line, line)
    assert np.array_equal(experiment.views.ends, ends)


def test_options_reach_the_views(tmp_path):
    simulated(tmp_path / 'clean', '--noise-px', 0)
    simulated(tmp_path / 'noisy', '--noise-px', 2)
    clean, noisy = (read_experiment(tmp_path / name) for name in ('clean', 'noisy'))
    assert np.array_equal(clean.views.line, noisy.views.line) and np.array_equal(clean.segments, noisy.segments)
    assert 460 * np.std(noisy.views.ends - clean.views.ends) == pytest.approx(2.0, rel=0.05)
    simulated(tmp_path / 'all', '--noise-px', 0, '--no-fov-limit')
    assert len(read_experiment(tmp_path / 'all').views.line) > len(clean.views.line)


def test_any_trajectory_can_be_given(tmp_path):
    forward = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # camera looks along x, level
    write_poses(tmp_path / 'mine.txt', np.arange(5) / 10, rigid(forward, np.linspace([-1, 0, 1.5], [1, 0, 1.5], 5)))
    code, out, _ = line_slam('simulate', 'house', tmp_path / 'made', '--trajectory', tmp_path / 'mine.txt')
    assert code == 0 and ' 5 frames' in out
    stamps, T_WC = read_poses(tmp_path / 'made' / 'cam_pose_tum.txt')
    assert np.allclose(stamps, np.arange(5) / 10) and np.allclose(T_WC, read_poses(tmp_path / 'mine.txt')[1])
    assert settings(tmp_path / 'made')['trajectory'] == str(tmp_path / 'mine.txt')
    assert settings(tmp_path / 'made')['frames'] == 5


def test_the_camera_can_come_from_a_calibration_file(tmp_path):
    (tmp_path / 'calibration.yaml').write_text(KALIBR)
    simulated(tmp_path / 'made', '--camera', tmp_path / 'calibration.yaml')
    assert settings(tmp_path / 'made')['camera'] == {'width': 752, 'height': 480, 'fx': 450.0, 'fy': 440.0,
                                                     'cx': 370.0, 'cy': 250.0}


@pytest.mark.parametrize('options, complaint', [
    (['--outliers', '1.5'], 'outliers is a share and must lie from 0 to 1, got 1.5'),
    (['--partial', 'nan'], 'partial is a share and must lie from 0 to 1, got nan'),
    (['--swapped', '-0.1'], 'swapped is a share and must lie from 0 to 1, got -0.1'),
    (['--noise-px', '-1'], 'noise must lie from 0 to 1e+06 px, got -1'),
    (['--noise-px', '1e308'], 'noise must lie from 0 to 1e+06 px, got 1e+308'),
    (['--seed', '-1'], 'seed must be 0 or more, got -1'),
    (['--lines', '21'], 'a house needs at least 22 lines, got 21'),
    (['--frames', '1'], 'a trajectory needs at least 2 frames, got 1'),
    (['--width', '0'], 'image size must be at least 1x1 px, got 0x640'),
    (['--focal', '0'], 'focal length must be a positive number of px, got 0.0, 0.0'),
    (['--camera', 'none.yaml', '--focal', '450', '--width', '640'],
     '--camera already says what --width and --focal would; give either'),
    (['--trajectory', 'none.txt'], 'none.txt: No such file or directory, expected a text file with rows t x y z')])
def test_nonsense_is_one_line_and_writes_nothing(tmp_path, options, complaint):
    code, out, err = line_slam('simulate', 'house', tmp_path / 'made', *options)
    assert (code, out) == (2, '') and err.startswith(f'line_slam simulate: {complaint}') and err.count('\n') == 1
    assert not (tmp_path / 'made').exists()


def test_a_trajectory_that_sees_nothing_is_refused(tmp_path):
    (tmp_path / 'far.txt').write_text('0 0 0 100 0 0 0 1\n1 0 0 101 0 0 0 1\n')
    code, _, err = line_slam('simulate', 'house', tmp_path / 'made', '--trajectory', tmp_path / 'far.txt')
    assert code == 2 and 'no line is in view of any camera; put the camera into the house' in err
    assert not (tmp_path / 'made').exists()


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / 'made').write_text('')
    code, _, err = line_slam('simulate', 'house', tmp_path / 'made')
    assert code == 2 and str(tmp_path / 'made') in err


@pytest.mark.parametrize('arguments', [['simulate'], ['simulate', 'castle', 'x'], ['simulate', 'house'],
                                       ['simulate', 'house', 'x', '--lines', 'many'],
                                       ['simulate', 'house', 'x', '--frames', '9', '--trajectory', 'poses.txt']])
def test_wrong_usage_is_explained(arguments, capsys):
    with pytest.raises(SystemExit) as done:
        command_line.main(arguments)
    assert done.value.code == 2 and 'usage: line_slam simulate' in capsys.readouterr().err


def test_help_names_all_options(capsys):
    with pytest.raises(SystemExit) as done:
        command_line.main(['simulate', 'house', '--help'])
    assert done.value.code == 0
    text = capsys.readouterr().out
    for option in ('seed', 'lines', 'frames', 'trajectory', 'width', 'height', 'focal', 'camera', 'noise-px',
                   'fov-limit', 'no-fov-limit', 'partial', 'outliers', 'swapped'):
        assert f'--{option}' in text
