"""line_slam evaluate on trajectories whose errors are known."""
import argparse
import json

import numpy as np
import pytest

from line_slam_ros.cli import evaluate
from line_slam_ros.geometry.lie import quaternion_from_matrix, rigid, rigid_inverse, so3_exp, transform_points
from line_slam_ros.mapping.io import write_csv
from line_slam_ros.types import LineSegments

TRUE_LINES = np.array([[[0, 0, 0], [0, 0, 2]], [[1, 0, 0], [1, 3, 0]]], float)
T_TE = rigid(so3_exp([0.1, -0.2, 2.0]), [3.0, -1.0, 0.5])  # the estimate's world in the true one


def run(*words):
    parser = argparse.ArgumentParser()
    evaluate.add_parser(parser.add_subparsers())
    args = parser.parse_args(['evaluate', *map(str, words)])
    return args.run(args)


def write_tum(path, stamps, poses):
    rows = np.column_stack([stamps, poses[:, :3, 3], quaternion_from_matrix(poses[:, :3, :3])])
    np.savetxt(path, rows, fmt='%.9f')


def motion(stamps):
    """Poses (N, 4, 4) that move for ten seconds and then stand still."""
    t = np.minimum(stamps, 10.0)
    positions = np.stack([np.sin(t), np.cos(0.7 * t), 0.3 * np.sin(1.3 * t)], axis=1)
    return rigid(so3_exp(np.stack([0.2 * np.sin(t), 0.1 * t, 0 * t], axis=1)), positions)


@pytest.fixture
def results(tmp_path):
    """Writes truth and estimate; change (N, 4, 4) -> (N, 4, 4) disturbs the estimate in the true world."""
    def write(change=lambda poses: poses, lines=TRUE_LINES, frames=slice(None)):
        stamps = np.arange(0, 15, 0.005)
        write_tum(tmp_path / 'truth.tum', 100 + stamps, motion(stamps))
        stamps = stamps[::10][frames]
        poses = rigid_inverse(T_TE) @ change(motion(stamps))
        write_tum(tmp_path / 'trajectory.tum', 100 + stamps, poses)
        ends = transform_points(rigid_inverse(T_TE), lines)
        count = len(lines)
        write_csv(tmp_path / 'lines.csv', LineSegments(np.arange(count), np.zeros((count, 6)), ends,
                                                       np.full(count, 5), np.zeros(count)))
        np.savetxt(tmp_path / 'gt_1.csv', TRUE_LINES[:1].reshape(-1, 6), delimiter=',', header='x1 [m],y1 [m],...')
        np.savetxt(tmp_path / 'gt_2.csv', TRUE_LINES[1:].reshape(-1, 6), delimiter=',')
        return tmp_path
    return write


def evaluated(folder):
    assert run(folder, '--truth', folder / 'truth.tum', '--lines', folder / 'gt_1.csv', folder / 'gt_2.csv') == 0
    return json.loads((folder / 'evaluation.json').read_text())


def test_a_perfect_result_in_another_world_has_no_error(results, capsys):
    result = evaluated(results())
    trajectory = result['trajectory']
    assert trajectory['matched'] == trajectory['poses'] == 300
    for name in ('ate_rmse_m', 'ate_max_m', 'rpe_1s_translation_rmse_m', 'rpe_10pct_translation_rmse_m'):
        assert trajectory[name] < 1e-6, name
    assert trajectory['rotation_max_deg'] < 1e-4 and trajectory['scale'] == pytest.approx(1.0, abs=1e-6)
    assert trajectory['still']['drift_m'] < 1e-6 and trajectory['still']['duration_s'] == pytest.approx(5, abs=0.6)
    assert result['lines']['precision'] == result['lines']['recall'] == [1.0] * 4
    assert 'ATE' in capsys.readouterr().out


def test_known_errors_are_measured(results):
    def disturbed(poses):
        poses = poses.copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ so3_exp([0, np.radians(2), 0])
        poses[:, :3, 3] *= 1.02
        poses[250:, 0, 3] += 0.03 * np.linspace(0, 1, 50)
        return poses
    trajectory = evaluated(results(disturbed))['trajectory']
    assert trajectory['rotation_rmse_deg'] == pytest.approx(2.0, abs=0.1)
    assert trajectory['scale'] == pytest.approx(1 / 1.02, abs=2e-3)
    assert trajectory['still']['drift_m'] == pytest.approx(0.03, rel=0.05)
    assert 0.005 < trajectory['ate_rmse_m'] < trajectory['ate_max_m'] < 0.04


def test_relative_error_leaves_out_pairs_across_a_gap(results):
    def jump(poses):
        poses = poses.copy()
        poses[100:, :3, 3] += 0.5
        return poses
    frames = np.r_[0:100, 140:300]
    trajectory = evaluated(results(jump, frames=frames))['trajectory']
    assert trajectory['rpe_1s_translation_rmse_m'] < 1e-6 and trajectory['ate_max_m'] > 0.2


def test_relative_error_over_a_tenth_of_the_path_grows_with_the_path(results):
    """A scale error of 2 % is 2 % of the distance between the ends of any stretch, which is at most its length."""
    def swollen(poses):
        poses = poses.copy()
        poses[:, :3, 3] *= 1.02
        return poses
    trajectory = evaluated(results(swollen))['trajectory']
    stretch = 0.1 * trajectory['length_m']
    assert 0.85 * 0.02 * stretch < trajectory['rpe_10pct_translation_rmse_m'] < 1.1 * 0.02 * stretch
    assert trajectory['rpe_10pct_rotation_rmse_deg'] < 1e-4


def test_relative_error_over_path_is_not_known_from_few_poses(results):
    trajectory = evaluated(results(frames=[0, 50, 110, 170]))['trajectory']
    assert trajectory['matched'] == 4 and trajectory['rpe_10pct_translation_rmse_m'] is None


def test_an_empty_map_has_null_precision(results):
    lines = evaluated(results(lines=np.empty((0, 2, 3))))['lines']
    assert lines['count'] == 0 and lines['precision'] == [None] * 4 and lines['recall'] == [0.0] * 4


@pytest.mark.parametrize('spoil, complaint', [
    (lambda d: (d / 'trajectory.tum').unlink(), 'trajectory.tum: no such file'),
    (lambda d: (d / 'trajectory.tum').write_text(''), 'trajectory.tum'),
    (lambda d: (d / 'trajectory.tum').write_text('1 2 3\n'), 'trajectory.tum'),
    (lambda d: (d / 'truth.tum').write_text(''.join(f'{t} {t} 0 {t * t} 0 0 0 1\n' for t in range(9))), 'compared'),
    (lambda d: (d / 'gt_1.csv').write_text('a,b\n'), 'gt_1.csv: rows of x1'),
    (lambda d: (d / 'lines.csv').unlink(), 'lines.csv: No such file')])
def test_bad_input_is_named_and_fails(results, capsys, spoil, complaint):
    folder = results()
    spoil(folder)
    assert run(folder, '--truth', folder / 'truth.tum', '--lines', folder / 'gt_1.csv') == 1
    assert complaint in capsys.readouterr().err and not (folder / 'evaluation.json').exists()
