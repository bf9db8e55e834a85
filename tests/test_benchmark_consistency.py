"""NEES of known errors is what it should be; a small Monte Carlo run end to end."""
import json
from dataclasses import replace

import numpy as np
import pytest
from bag_samples import line_slam
from scipy.stats import chi2

from line_slam_ros.benchmark.consistency import World, simulate
from line_slam_ros.benchmark.consistency_report import level_of
from line_slam_ros.benchmark.nees import bounds, end_errors, gauge, line_nees, nees, state_nees
from line_slam_ros.config import Estimator as Options
from line_slam_ros.geometry.lie import rigid, rigid_inverse, so3_exp, so3_log
from line_slam_ros.geometry.lines import line_from_points, point_distance, unit_direction
from line_slam_ros.geometry.orthonormal import (
    jacobian_right,
    orthonormal_from_pluecker,
    pluecker_from_orthonormal,
    plus_right,
)


def spd(rng, size, scale):
    A = rng.normal(size=(size, size))
    return scale**2 * (A @ A.T + 0.1 * np.eye(size))


def pose(rng):
    return rigid(so3_exp(rng.normal(size=3)), rng.normal(size=3))


def test_errors_drawn_from_their_covariance_have_the_mean_nees_of_their_freedom():
    rng = np.random.default_rng(0)
    P = spd(rng, 6, 0.3)
    errors = rng.multivariate_normal(np.zeros(6), P, 4000)
    low, high = bounds(6, 4000, 0.9999)
    assert low < nees(errors, np.broadcast_to(P, (4000, 6, 6))).mean() / 6 < high


def test_bounds_hold_the_given_share_of_the_means():
    low, high = bounds(3, 20)
    assert 0.6 < low < 1.0 < high < 1.5
    means = np.random.default_rng(1).chisquare(3, (20000, 20)).mean(axis=1) / 3
    assert np.mean((means > low) & (means < high)) == pytest.approx(0.95, abs=0.01)
    assert low == pytest.approx(chi2.ppf(0.025, 60) / 60)


def test_the_gauge_is_heading_and_position_and_nothing_else():
    rng = np.random.default_rng(2)
    T_WB = pose(rng)
    T_EW = rigid(so3_exp(np.array([0.0, 0.0, 2.5])), [3.0, -1.0, 0.5])
    np.testing.assert_allclose(gauge(T_EW @ T_WB, T_WB), T_EW, atol=1e-12)
    tilted = T_EW @ T_WB
    tilted[:3, :3] = so3_exp(np.array([0.02, -0.03, 0.0])) @ tilted[:3, :3]
    found = gauge(tilted, T_WB)
    np.testing.assert_allclose(found[2], [0, 0, 1, tilted[2, 3] - T_WB[2, 3]], atol=1e-12)
    left = so3_log(tilted[:3, :3] @ (found[:3, :3] @ T_WB[:3, :3]).T)
    np.testing.assert_allclose(left, [0.02, -0.03, 0.0], atol=1e-12)


def test_nees_of_a_state_follows_the_convention_of_its_covariance():
    """Errors: rotation on the right, position and velocity additive; each block against its part of the covariance."""
    rng = np.random.default_rng(3)
    T, v, P = pose(rng), rng.normal(size=3), spd(rng, 9, 1e-3)
    e = rng.normal(size=9) * 1e-3
    moved = rigid(T[:3, :3] @ so3_exp(e[:3]), T[:3, 3] + e[3:6])
    found = state_nees(moved, v + e[6:], P, T, v)
    for name, s in {'orientation': slice(0, 3), 'position': slice(3, 6), 'pose': slice(0, 6),
                    'velocity': slice(6, 9)}.items():
        assert found[name] == pytest.approx(e[s] @ np.linalg.inv(P[s, s]) @ e[s], rel=1e-6)


def disturbed_lines(rng, count, scale):
    """True segments (L, 2, 3), estimates (L, 6) with |d| = 1 off by draws from their covariance (L, 6, 6)."""
    segments = rng.normal(size=(count, 2, 3)) * 3
    U, phi = orthonormal_from_pluecker(line_from_points(segments[:, 0], segments[:, 1]))
    P = np.stack([spd(rng, 4, scale) for _ in range(count)])
    delta = np.stack([rng.multivariate_normal(np.zeros(4), p) for p in P])
    U, phi = plus_right(U, phi, delta)
    L, J = pluecker_from_orthonormal(U, phi), jacobian_right(U, phi)
    length = np.linalg.norm(L[:, 3:], axis=1)[:, None, None]
    d = L[:, 3:] / length[:, 0]
    J = (J - L[:, :, None] / length * np.einsum('li,lij->lj', d, J[:, 3:])[:, None]) / length
    return segments, unit_direction(L), J @ P @ J.transpose(0, 2, 1)


def test_lines_drawn_from_their_covariance_have_mean_nees_four():
    segments, L, cov = disturbed_lines(np.random.default_rng(4), 3000, 1e-5)
    values = line_nees(L, cov, segments)
    low, high = bounds(4, 3000, 0.9999)
    assert low < values.mean() / 4 < high
    np.testing.assert_allclose(line_nees(-L, cov, segments[:, ::-1]), values, rtol=1e-6)  # whichever way it runs
    assert line_nees(L, cov / 4.0, segments).mean() == pytest.approx(4.0 * values.mean(), rel=1e-9)


def test_offsets_at_the_ends_are_distances_and_as_large_as_their_covariance_says():
    rng = np.random.default_rng(5)
    segments, L, cov = disturbed_lines(rng, 3000, 1e-4)
    offset, P = end_errors(L, cov, segments)
    np.testing.assert_allclose(np.linalg.norm(offset.reshape(-1, 2, 2), axis=-1), point_distance(L[:, None], segments),
                               atol=1e-12)
    both = np.stack([np.trace(P[:, :2, :2], axis1=1, axis2=2), np.trace(P[:, 2:, 2:], axis1=1, axis2=2)], axis=1)
    assert np.mean(np.sum(offset**2, axis=1) / both.sum(axis=1)) == pytest.approx(1.0, abs=0.06)


@pytest.fixture(scope='module')
def traces():
    return [simulate(World(seed, 5.0, 0.3, True)) for seed in (0, 1)]


def test_a_run_starts_and_knows_its_error(traces):
    for trace in traces:
        assert trace.failure == '' and trace.t_s[0] < 3.0 and trace.t_s[-1] == pytest.approx(4.95)
        assert all(len(values) == len(trace.t_s) for values in trace.nees.values())
        error = np.array([(rigid_inverse(a) @ b)[:3, 3] for a, b in zip(trace.T_EB, trace.true_T_EB, strict=True)])
        assert np.linalg.norm(error, axis=1).max() < 0.2
        assert 0.05 < np.mean(trace.nees['pose']) / 6 < 20.0
        assert np.isfinite(trace.nees['line in the world']).sum() >= 2


def test_the_same_seed_gives_the_same_numbers(traces):
    again = simulate(traces[0].world)
    np.testing.assert_array_equal(again.T_EB, traces[0].T_EB)
    np.testing.assert_array_equal(again.nees['pose'], traces[0].nees['pose'])


def test_a_run_that_never_starts_is_counted_not_hidden(traces):
    world = replace(traces[0].world, seconds=2.0, options=Options(init_window_s=10.0), lines=True)
    lost = simulate(world)
    assert lost.failure == 'never started' and lost.t_s == []
    level = level_of([replace(traces[0], world=replace(traces[0].world, seconds=2.0)), lost])
    assert level.failures == ('never started',) and len(level.ate_m) == 1 and level.runs == 2
    assert level.bounds['pose'] == bounds(6, 1)


def test_the_command_writes_json_tables_and_plot(tmp_path):
    code, out, err = line_slam('benchmark', 'consistency', '--runs', 2, '--seconds', 4, '--pixel-sigma', 0.3, 1,
                               '--no-lines', '--output', tmp_path, '--markdown', tmp_path / 'page.md')
    assert code == 0, err
    levels = json.loads((tmp_path / 'consistency.json').read_text())['levels']
    assert [v['pixel_sigma'] for v in levels] == [0.3, 1.0] and not any(v['lines'] for v in levels)
    for v in levels:
        assert v['runs'] == 2 and v['failures'] == [] and 0.0 < max(v['ate_m']) < 0.1
        assert set(v['at_end']) == {'position', 'orientation', 'pose', 'velocity'} and v['at_end']['pose'] > 0.0
        assert len(v['over_time']['pose']) == len(v['t_s']) == 4
    assert '| 1 | points | pose | 6 |' in out and '| 1 | points | pose | 6 |' in (tmp_path / 'page.md').read_text()
    assert (tmp_path / 'consistency.png').stat().st_size > 10_000


def test_lines_that_noise_alone_would_start_do_not_lose_a_walk_along_a_corridor():
    """Most lines there are short in the image or parallel to the motion."""
    trace = simulate(World(2, 8.0, 0.5, True, 'corridor', points=1500, in_view=25))
    assert not trace.failure
    error = [estimated[:3, 3] - true[:3, 3] for estimated, true in zip(trace.T_EB, trace.true_T_EB, strict=True)]
    assert np.linalg.norm(error, axis=1).max() < 0.15
