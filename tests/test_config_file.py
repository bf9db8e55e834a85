"""One parameter file for node and replay, in both forms."""
from __future__ import annotations

from pathlib import Path

import pytest

from line_slam_ros.config_file import load, read


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize('text', [
    'estimator: {window: 9}\nuse_lines: false\nbody_frame: imu\n',
    '/**:\n  ros__parameters:\n    estimator: {window: 9}\n    use_lines: false\n    body_frame: imu\n',
    'line_slam:\n  ros__parameters:\n    estimator.window: 9\n    use_lines: false\n    body_frame: imu\n',
    ('/**: {ros__parameters: {estimator: {window: 5}, use_lines: false, use_sim_time: true}}\n'
     'other_node: {ros__parameters: {nonsense: 1}}\n'
     '/line_slam: {ros__parameters: {estimator: {window: 9}, body_frame: imu}}')])
def test_ros_and_plain_forms_say_the_same(tmp_path, text):
    config, shell = load([write(tmp_path / 'p.yaml', text)])
    assert (config.estimator.window, config.use_lines, shell.body_frame) == (9, False, 'imu')


def test_later_files_and_settings_win(tmp_path):
    first = write(tmp_path / 'a.yaml', 'estimator: {window: 9, point_sigma_px: 2.0}')
    second = write(tmp_path / 'b.yaml', 'estimator: {window: 8}')
    config, shell = load([first, second], ['points.max_count=50', 'pose_source=topic', 'use_lines=false'])
    assert (config.estimator.window, config.estimator.point_sigma_px) == (8, 2.0)
    assert (config.points.max_count, shell.pose_source, config.use_lines) == (50, 'topic', False)


@pytest.mark.parametrize(('value', 'becomes'), [('2', 2.0), ('1e-1', 0.1), ('0.5', 0.5)])
def test_numbers_for_floats_in_every_spelling(tmp_path, value, becomes):
    config, _ = load([write(tmp_path / 'p.yaml', f'estimator: {{point_sigma_px: {value}}}')])
    assert config.estimator.point_sigma_px == becomes and type(config.estimator.point_sigma_px) is float


def test_lists_become_tuples(tmp_path):
    _, shell = load([write(tmp_path / 'p.yaml', 'T_body_camera: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]')])
    assert shell.T_body_camera[:2] == (1, 0) and len(shell.T_body_camera) == 16


@pytest.mark.parametrize(('text', 'says'), [
    ('estimator: {windw: 9}', "unknown parameter 'estimator.windw'; did you mean 'estimator.window'"),
    ('window: 9', "unknown parameter 'window'; did you mean 'estimator.window'"),
    ('zzz: 9', "unknown parameter 'zzz'; see config/line_slam.yaml"),
    ('estimator: {window: 1000}', r'window must lie in \[4'),
    ('estimator: {window: 9.5}', 'window must be int'),
    ('pose_source: gps', 'pose_source must be one of imu, topic'),
    ('other: {ros__parameters: {a: 1}}', "has parameters of other, none of 'line_slam'"),
    ('- a\n- b', 'holds no parameters'), ('', 'holds no parameters'), ('a: [', 'not readable as YAML')])
def test_bad_files_say_what_to_do(tmp_path, text, says):
    with pytest.raises(ValueError, match=f'p.yaml: .*{says}'):
        load([write(tmp_path / 'p.yaml', text)])


def test_a_binary_file_is_not_yaml(tmp_path):
    (tmp_path / 'p.yaml').write_bytes(b'\xff\xfe\x00\x01')
    with pytest.raises(ValueError, match='not readable as YAML'):
        read(tmp_path / 'p.yaml')


@pytest.mark.parametrize('setting', ['use_lines', 'use_lines=[', 'use_line=1'])
def test_bad_settings_are_named(setting):
    with pytest.raises(ValueError, match='--set'):
        load((), [setting])
