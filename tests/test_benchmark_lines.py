"""The calibration kernel, and the speed of the line solver measured against it."""
import json
import subprocess
import sys

import numpy as np
import pytest
from bag_samples import line_slam

from line_slam_ros.benchmark import calibration_kernel as kernel
from line_slam_ros.benchmark.line_speed import FORMS, problem


def solutions(data):
    """The kernel's sum for one sweep, by NumPy."""
    blocks = data[:len(data) // 8 * 8].reshape(-1, 8, kernel.WIDTH)
    weight = 1.0 / np.sqrt(1.0 + blocks[..., 8] * blocks[..., 9])
    A = blocks[..., :4]
    H = np.einsum('bk,bki,bkj->bij', weight, A, A) + np.eye(4)
    g = np.einsum('bk,bki,bki->bi', weight, A, blocks[..., 4:8])
    return np.linalg.solve(H, g[..., None]).sum()


def test_the_kernel_does_the_same_work_every_time():
    data = kernel.rows()
    assert data.shape == (kernel.ROWS, kernel.WIDTH) and 0.5 <= data.min() < data.max() < 1.5
    np.testing.assert_array_equal(data, kernel.rows())
    once = kernel.calibration_kernel(data)
    assert kernel.calibration_kernel(data) == once
    assert once == pytest.approx(kernel.SWEEPS * solutions(data), rel=1e-9)


def test_works_are_taken_in_turns_and_the_first_turn_does_not_count():
    calls = []

    def work(name, seconds):
        def done():
            calls.append(name)
            return seconds if len(calls) > 2 else 1e9
        return done

    seconds = kernel.in_turns([work('a', 1.0), work('b', 2.0)], 3)
    assert calls == ['a', 'b'] * 4
    np.testing.assert_array_equal(seconds, [[1.0, 2.0]] * 3)


def test_the_simulated_house_has_about_thirty_thousand_observations():
    lines = problem(None)
    assert 27_000 < len(lines.poses) < 33_000 and len(lines.segments) == 90


def test_an_experiment_is_timed_against_the_kernel(tmp_path):
    assert line_slam('simulate', 'house', tmp_path / 'house', '--lines', 24, '--frames', 40)[0] == 0
    code, out, err = line_slam('benchmark', 'lines', tmp_path / 'house', '--repeats', 2, '--output', tmp_path / 'out',
                               '--markdown', tmp_path / 'page.md')
    assert code == 0, err
    speed = json.loads((tmp_path / 'out' / 'lines.json').read_text())
    assert speed['lines'] == 24 and speed['observations'] > 100 and speed['iterations'] == 10
    assert set(speed['solver_s']) == set(speed['ratio']) == set(FORMS)
    assert all(value > 0.0 for value in (*speed['solver_s'].values(), *speed['ratio'].values(), speed['kernel_s']))
    assert '| 4 parameters | ' in out and '| 2 parameters | ' in (tmp_path / 'page.md').read_text()


def test_a_directory_without_an_experiment_is_named(tmp_path):
    code, _, err = line_slam('benchmark', 'lines', tmp_path, '--output', tmp_path / 'out')
    assert code == 2 and 'cam_pose_tum.txt' in err


@pytest.mark.parametrize('words', [('--runs', '0'), ('--runs', 'many')])
def test_numbers_that_make_no_sense_are_refused(words, tmp_path):
    with pytest.raises(SystemExit) as caught:
        line_slam('benchmark', 'consistency', *words, '--output', tmp_path)
    assert caught.value.code == 2


@pytest.mark.parametrize('kind', ['recordings', 'consistency', 'lines', 'speed'])
def test_help_is_quick_to_load(kind):
    code = ('import sys; from line_slam_ros.cli.main import main\n'
            f'try: main(["benchmark", "{kind}", "--help"])\nexcept SystemExit: pass\n'
            'sys.exit(bool({"numpy", "numba", "evo", "matplotlib", "rosbags"} & set(sys.modules)))')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert '--output' in done.stdout and '--markdown' in done.stdout
