"""line_slam optimize-lines on small directories in the sources' formats: what it prints, saves and refuses."""
import csv
import json

import numpy as np
import pytest
from line_scene import FOCAL, scene, walk
from matplotlib.figure import Figure

from line_slam_ros.cli.main import main
from line_slam_ros.experiment.files import (
    LANDMARKS,
    OBSERVATIONS,
    POSES,
    LineViews,
    add_noise,
    write_landmarks,
    write_observations,
    write_poses,
)
from line_slam_ros.geometry.lie import rigid_inverse, transform_points

PNG = b'\x89PNG\r\n\x1a\n'


@pytest.fixture
def house(tmp_path):
    """Eight segments seen in 40 frames; line 3 in one frame only, line 5 never."""
    T_WC, segments = walk(40), scene(np.random.default_rng(3), 8)
    frame, line = (a.ravel() for a in np.mgrid[:40, :8])
    seen = (line != 5) & ((line != 3) | (frame == 7))
    p_C = transform_points(rigid_inverse(T_WC)[frame], segments[line])
    views = LineViews(frame[seen], line[seen], (p_C[..., :2] / p_C[..., 2:])[seen])
    folder = tmp_path / 'house'
    folder.mkdir()
    write_poses(folder / POSES, np.arange(40) / 30, T_WC)
    write_landmarks(folder / LANDMARKS, segments)
    write_observations(folder / OBSERVATIONS, views)
    write_observations(folder / 'noisy.txt', add_noise(views, 2.0 / FOCAL, 9))
    return folder


@pytest.fixture
def optimize(house, tmp_path):
    """Runs the command; its exit code and the output directory."""
    def run(*words, figure=False):
        output = tmp_path / 'out'
        words = [*map(str, words), *(() if figure else ('--no-figure',))]
        return main(['optimize-lines', str(house), '--output', str(output), *words]), output
    return run


def rows_of(path):
    with open(path, newline='', encoding='utf-8') as file:
        return list(csv.DictReader(file))


@pytest.mark.row(39)
def test_one_row_per_line_and_every_failure_listed(optimize, capsys):
    code, output = optimize('--observations', 'noisy.txt')
    assert code == 0
    rows = rows_of(output / 'lines.csv')
    assert [int(row['id']) for row in rows] == list(range(8))
    assert [row['views'] for row in rows] == ['40', '40', '40', '1', '40', '0', '40', '40']
    failed = [row for row in rows if row['reason']]
    assert [row['id'] for row in failed] == ['3', '5']
    assert {row['reason'] for row in failed} == {'seen in fewer than 2 frames'}
    assert not any(row[name] for row in failed for name in ('cost', 'x1_m', 'angle_deg', 'endpoint_m'))
    assert not (output / 'errors.png').exists()  # as told
    summary = json.loads((output / 'summary.json').read_text())
    assert summary['failures'] == 2 and [row['id'] for row in summary['failed']] == [3, 5]
    printed = capsys.readouterr().out
    assert 'failed          line 3 (1 views): seen in fewer than 2 frames' in printed
    assert 'failed          line 5 (0 views): seen in fewer than 2 frames' in printed
    assert 'lines           6 of 8' in printed


@pytest.mark.row(39, 40)
def test_saved_figures_are_those_of_the_lines(optimize, house):
    _, output = optimize('--observations', 'noisy.txt', figure=True)
    rows = [row for row in rows_of(output / 'lines.csv') if not row['reason']]
    summary = json.loads((output / 'summary.json').read_text())
    assert sum(float(row['cost']) for row in rows) == pytest.approx(summary['cost'], rel=1e-12)
    for name in ('angle_deg', 'perpendicular_m', 'endpoint_m'):
        values = [float(row[name]) for row in rows]
        assert summary[f'{name}_mean'] == pytest.approx(np.mean(values), rel=1e-12)
        assert summary[f'{name}_max'] == max(values)
    true = np.loadtxt(house / LANDMARKS).reshape(-1, 2, 3)
    for row in rows:
        ends = np.array([[float(row[f'{axis}{k}_m']) for axis in 'xyz'] for k in (1, 2)])
        errors = [np.linalg.norm(e - true[int(row['id'])], axis=1).mean() for e in (ends, ends[::-1])]
        assert float(row['endpoint_m']) == pytest.approx(min(errors), rel=1e-9)
    assert 1.5 < summary['sigma_px'] < 2.5 and summary['solve_s'] > 0 and summary['iterations'] > 0
    assert (output / 'errors.png').read_bytes().startswith(PNG)
    header = (output / 'lines.ply').read_bytes().split(b'end_header')[0]
    assert b'element edge 6\n' in header


@pytest.mark.row(34, 35, 41)
def test_both_modes_through_the_command(optimize):
    cost = {}
    for dof in (2, 4):
        for mode in ('--joint', '--per-line'):
            code, output = optimize('--preset', 'authors', '--observations', 'noisy.txt', '--dof', dof, mode)
            summary = json.loads((output / 'summary.json').read_text())
            assert code == 0 and summary['settings']['joint'] == (mode == '--joint')
            assert summary['settings']['form'] == {2: 'host', 4: 'orthonormal'}[dof]
            assert summary['settings']['use_host'] is False and summary['sigma_px'] == pytest.approx(3.2)
            cost[dof, mode] = summary['cost']
    assert cost[2, '--joint'] == pytest.approx(cost[2, '--per-line'], rel=1e-6)
    assert cost[4, '--joint'] == pytest.approx(cost[4, '--per-line'], rel=1e-6)
    assert cost[4, '--joint'] < cost[2, '--joint']


@pytest.mark.row(41)
def test_a_sweep_tells_cost_iterations_time_and_errors_of_both_modes(optimize, capsys):
    code, output = optimize('--noise-px', 0, 2, '--seeds', 1, 2, '--sigma-px', 2, figure=True)
    assert code == 0
    runs = rows_of(output / 'sweep.csv')
    names = [f'{form} {mode}' for form in ('host', 'orthonormal', 'host_free') for mode in ('joint', 'per line')]
    assert [(row['noise_px'], row['seed'], row['method']) for row in runs] == [
        (px, seed, name) for px, seed in (('0.0', '1'), ('2.0', '1'), ('2.0', '2')) for name in names]
    for row in runs:
        assert (row['lines'], row['failures']) == ('8', '2')
        assert float(row['solve_s']) > 0 and int(row['iterations']) > 0 and float(row['cost']) >= 0
        assert float(row['angle_deg_mean']) <= float(row['angle_deg_max'])
    sweep = json.loads((output / 'sweep.json').read_text())
    assert [run['cost'] for run in sweep['runs']] == [float(row['cost']) for row in runs]
    assert set(sweep['methods']) == set(names) and len(sweep['means']) == 12
    at_2_px = {run['method']: run for run in sweep['means'] if run['noise_px'] == 2.0}
    assert at_2_px['orthonormal joint']['perpendicular_m_mean'] < at_2_px['host joint']['perpendicular_m_mean']
    assert at_2_px['host_free joint']['cost'] == pytest.approx(at_2_px['orthonormal joint']['cost'], rel=1e-5)
    assert (output / 'sweep.png').read_bytes().startswith(PNG)
    printed = capsys.readouterr().out.splitlines()
    table, failures = printed[:13], printed[13:]
    assert len({len(line) for line in table}) == 1  # aligned
    assert failures == [f'failed  {float(row["noise_px"]):g} px, seed {row["seed"]}, {row["method"]}: line {line}: '
                        'seen in fewer than 2 frames' for row in runs for line in (3, 5)]


@pytest.mark.row(38, 41)
def test_the_same_seed_gives_the_same_bytes(optimize):
    saved = []
    for _ in range(2):
        _, output = optimize('--noise-px', 3, '--seeds', 7)
        saved.append((output / 'lines.csv').read_bytes())
    assert saved[0] == saved[1]
    assert optimize('--noise-px', 3, '--seeds', 8)[1].joinpath('lines.csv').read_bytes() != saved[0]


def test_options_change_single_settings_of_a_preset(optimize):
    _, output = optimize('--observations', 'noisy.txt', '--preset', 'authors', '--form', 'pluecker', '--start', 'svd',
                         '--loss', 'l2', '--sigma-px', 2, '--gate', 30, '--focal', 500, '--host', '--iterations', 5,
                         '--tolerance', 0, '--ends', 'quantile', '--end-share', 0.2, '--min-parallax-deg', 0.5,
                         '--loss-scale', 2)
    summary = json.loads((output / 'summary.json').read_text())
    assert summary['iterations'] == 10  # five to find wrong views, and five without them
    assert summary['settings'] == {
        'form': 'pluecker', 'joint': True, 'start': 'svd', 'loss': 'l2', 'loss_scale': 2.0, 'sigma_px': 2.0,
        'gate': 30.0, 'focal': 500.0, 'use_host': True, 'iterations': 5, 'tolerance': 0.0, 'min_parallax_deg': 0.5,
        'ends': 'quantile', 'end_share': 0.2}


def test_lines_of_less_parallax_than_asked_for_are_not_started(optimize):
    _, output = optimize('--observations', 'noisy.txt', '--min-parallax-deg', 89)
    reasons = [row['reason'] for row in rows_of(output / 'lines.csv')]
    few, flat = 'seen in fewer than 2 frames', 'no parallax: all planes within 89 deg'
    assert reasons == [few if i in (3, 5) else flat for i in range(8)]


def test_the_sweep_shows_every_marker_and_plain_numbers(optimize, monkeypatch):
    sheets = []
    monkeypatch.setattr(Figure, 'savefig', lambda sheet, *_, **__: sheets.append(sheet))
    optimize('--noise-px', 1, 2, '--sigma-px', 2, figure=True)
    sheets[0].canvas.draw()
    *errors, trade_off = sheets[0].axes
    low, high = trade_off.get_xlim()
    seconds = [x for line in trade_off.lines for x in line.get_xdata()]
    assert low == 0.0 < min(seconds) and max(seconds) == pytest.approx(high / 1.1)
    for axes in (*errors, trade_off):
        texts = [label.get_text() for label in axes.get_yticklabels(which='both') if label.get_text()]
        assert axes.get_yscale() == 'log' and len(texts) > 1 and all(float(text) > 0.0 for text in texts)


def test_several_forms_are_compared_without_noise_too(optimize):
    code, output = optimize('--form', 'host', 'orth4', '--observations', 'noisy.txt')
    assert code == 0
    assert [row['method'] for row in rows_of(output / 'sweep.csv')] == ['host per line', 'orth4 per line']


@pytest.mark.parametrize(('words', 'message'), [
    (('--observations', 'none.txt'), 'none.txt'), (('--sigma-px', '0'), 'sigma_px must be positive and finite'),
    (('--noise-px', '-1'), 'noise must be'), (('--noise-px', '1e308'), 'noise must be'),
    (('--seeds', '-1'), 'seed must be 0 or more, got -1'), (('--iterations', '0'), 'at least one iteration is needed'),
    (('--end-share', '0.9'), 'end_share must lie in')])
def test_bad_settings_and_files_give_one_line_and_exit_code_2(optimize, capsys, words, message):
    code, _ = optimize(*words)
    told = capsys.readouterr().err
    assert code == 2 and told.count('\n') == 1
    assert told.startswith('line_slam optimize-lines: ') and message in told


def test_bad_rows_are_named_by_file_and_line(optimize, house, capsys):
    text = (house / OBSERVATIONS).read_text().splitlines()
    (house / OBSERVATIONS).write_text('\n'.join([*text[:4], '0 99 0 0 1 1', *text[4:]]) + '\n')
    code, _ = optimize()
    assert code == 2 and f'{OBSERVATIONS}:5: unknown line 99' in capsys.readouterr().err


def test_a_problem_without_any_answer_is_told_not_crashed(optimize, house, capsys):
    views = np.loadtxt(house / OBSERVATIONS)
    np.savetxt(house / 'few.txt', views[:6], fmt=['%d', '%d'] + ['%.17g'] * 4)
    code, output = optimize('--observations', 'few.txt', '--noise-px', 1)
    assert code == 0 and 'lines           0 of 8' in capsys.readouterr().out
    summary = json.loads((output / 'summary.json').read_text())
    assert summary['failures'] == 8 and summary['angle_deg_mean'] is None
    assert len(rows_of(output / 'lines.csv')) == 8


@pytest.mark.row(37)
def test_swapped_ends_and_long_quaternions_in_the_files_change_nothing(optimize, house):
    _, output = optimize('--observations', 'noisy.txt')
    before = [float(row['angle_deg']) for row in rows_of(output / 'lines.csv') if not row['reason']]
    table = np.loadtxt(house / 'noisy.txt')
    table[::2, 2:] = table[::2][:, [4, 5, 2, 3]]
    views = LineViews(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:].reshape(-1, 2, 2))
    write_observations(house / 'noisy.txt', views)
    poses = np.loadtxt(house / POSES)
    poses[:, 4:] *= 1.001
    np.savetxt(house / POSES, poses, fmt='%.17g')
    _, output = optimize('--observations', 'noisy.txt')
    after = [float(row['angle_deg']) for row in rows_of(output / 'lines.csv') if not row['reason']]
    np.testing.assert_allclose(after, before, rtol=1e-6)
