"""The estimator on simulated features with exact truth: starts, accuracy, marginalisation, rest, failure."""
import copy
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

from line_slam_ros.benchmark.consistency import World, simulate
from line_slam_ros.config import Estimator as Options
from line_slam_ros.estimation import solver as solver_module
from line_slam_ros.estimation.bootstrap import MAX_UNSETTLED, Bootstrap, drive
from line_slam_ros.estimation.estimator import Estimator
from line_slam_ros.estimation.initialisation import upright
from line_slam_ros.estimation.marginalisation import drop_state, eliminate
from line_slam_ros.estimation.window import state_row
from line_slam_ros.geometry.imu import between
from line_slam_ros.geometry.lie import rigid, so3_exp, so3_log
from line_slam_ros.simulation.features import GRAVITY_W, Room, Sequence, Trajectory, calibration
from line_slam_ros.types import LINE_FORMS, ImuNoise, LineObservations, PointObservations

NO_LINES = LineObservations(np.empty(0, np.int64), np.empty((0, 2, 2)), np.empty((0, 2)))
NO_POINTS = PointObservations(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2)))


def run(sequence, options=None, change=lambda k, seen: seen, given=None):
    """Feeds a sequence; returns the estimator, times (s) and positions (N, 3), covariances of position, failures."""
    given = given or sequence.calibration
    estimator = Estimator(options or Options(), given, 450.0, 700, 150)
    w, out, failures = estimator.window, [], []

    def steps():
        previous = None
        for k, (seen, imu) in enumerate(sequence):
            seen = change(k, seen)
            yield seen, None if previous is None else between(imu, previous, seen.t_ns)
            previous = seen.t_ns

    for seen, _ in drive(estimator, given, steps()):
        out.append((seen.t_ns * 1e-9, *w.p[w.n - 1], *np.diag(estimator.covariance())[3:6]))
        failures.append(estimator.failure)
    out = np.array(out)
    return estimator, out[:, 0], out[:, 1:4], out[:, 4:7], failures


def aligned_error(sequence, t, p):
    """RMS position error (m) after the best rigid alignment in heading and position."""
    truth = sequence.trajectory.at(t)[1]
    a, b = p - p.mean(axis=0), truth - truth.mean(axis=0)
    heading = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum())
    return float(np.sqrt(np.mean(np.sum((a @ so3_exp(np.array([0, 0, heading])).T - b) ** 2, axis=1))))


@pytest.fixture(scope='module')
def moving():
    return Sequence(Trajectory.random(2), Room.random(2), calibration(), 10.0)


@pytest.mark.parametrize('representation', LINE_FORMS)
def test_starts_in_motion_and_tracks_to_a_centimetre_per_metre(moving, representation):
    _, t, p, _, failures = run(moving, Options(line_representation=representation))
    assert t[0] <= 3.0
    assert not any(failures)
    assert aligned_error(moving, t, p) < 0.03


def test_points_alone_and_lines_with_few_points_both_work(moving):
    _, t, p, *_ = run(moving, change=lambda k, s: replace(s, lines=NO_LINES))
    assert aligned_error(moving, t, p) < 0.03

    def few(k, s):
        kept = (s.points.ids % 12 == 0) | (k <= 60)
        return replace(s, points=PointObservations(s.points.ids[kept], s.points.uv[kept], s.points.x[kept]))

    _, t, p, *_ = run(moving, change=few)
    assert aligned_error(moving, t, p) < 0.05


def test_a_wrong_rig_is_refined():
    """Camera turned by 1 degree and moved by 1 cm against its calibration, images stamped 5 ms too early."""
    wrong, given = calibration(), calibration()
    moved = given.T_BC @ rigid(so3_exp(np.radians([0.6, -0.64, 0.48])), [0.006, -0.008, 0.0])
    moving = Sequence(Trajectory.random(2), Room.random(2), replace(wrong, T_BC=moved), 20.0)
    stamped_early = lambda k, seen: replace(seen, t_ns=seen.t_ns - 5_000_000)  # noqa: E731
    estimator, t, p, _, failures = run(moving, change=stamped_early, given=given)
    assert not any(failures)
    assert aligned_error(moving, t, p) < 0.03
    w = estimator.window
    assert np.degrees(np.linalg.norm(so3_log(moved[:3, :3].T @ w.R_BC))) < 0.1
    assert w.delay[0] == pytest.approx(0.005, abs=3e-4)
    rig = estimator.rig()
    assert rig.rotation_deg == pytest.approx(1.0, abs=0.1) and rig.delay_s == w.delay[0]
    off = Options(extrinsic_sigma_deg=0.0, extrinsic_sigma_m=0.0, time_offset_sigma_s=0.0)
    estimator, t, p, *_ = run(moving, off, stamped_early, given)
    np.testing.assert_array_equal(estimator.window.R_BC, given.T_BC[:3, :3])
    assert estimator.window.delay[0] == 0.0


def test_biases_said_to_be_constant_leave_equations_that_can_be_solved(moving):
    constant = replace(calibration(), imu_noise=ImuNoise(gyro_walk=1e-12, accel_walk=1e-12))
    _, t, p, _, failures = run(moving, given=constant)
    assert t[0] <= 3.0 and not any(failures)
    assert aligned_error(moving, t, p) < 0.03


def test_biases_are_found(moving):
    estimator, *_ = run(moving)
    b = estimator.window.b[estimator.window.n - 1]
    np.testing.assert_allclose(b[:3], moving.gyro_bias, atol=2e-3)
    np.testing.assert_allclose(b[3:], moving.accel_bias, atol=5e-2)


def test_at_rest_it_starts_within_a_second_and_does_not_drift():
    sequence = Sequence(Trajectory.random(3, rest=30.0), Room.random(3), calibration(), 12.0)
    _, t, p, *_ = run(sequence)
    assert t[0] <= 1.0
    assert np.linalg.norm(p - p[0], axis=1).max() < 0.005


def test_rest_then_motion_keeps_metric_scale():
    sequence = Sequence(Trajectory.random(4, rest=2.0), Room.random(4), calibration(), 12.0)
    _, t, p, *_ = run(sequence)
    assert t[0] <= 1.0
    assert aligned_error(sequence, t, p) < 0.04


def test_blindness_longer_than_allowed_is_a_failure_that_says_so(moving):
    def blind(k, seen):
        return replace(seen, points=NO_POINTS, lines=NO_LINES) if k >= 120 else seen

    _, t, p, _, failures = run(moving, Options(max_blind_m=0.1), blind)
    assert not any(failures[:70])
    assert 'nothing followed' in failures[-1]
    _, t, p, _, failures = run(moving, Options(max_blind_m=1000.0), blind)
    assert not any(failures) and aligned_error(moving, t, p) < 0.5


def test_new_tracks_serve_at_once_when_nearly_all_corners_were_lost(moving):
    """An image that is wrong nearly everywhere takes them; the few that are left must not put off a keyframe."""
    steps = list(moving.steps())[85:94]
    lasting = np.intersect1d(steps[0][0].points.ids, steps[-1][0].points.ids)[:12]
    patient = Options(keyframe_parallax_px=200.0)
    estimator, *_ = run(replace(moving, seconds=4.5), patient, lambda k, s: replace(s, lines=NO_LINES))
    w = estimator.window
    w.points.keep(np.isin(w.points.ids[:w.points.count], lasting))
    for seen, samples in steps[5:]:
        ids = np.where(np.isin(seen.points.ids, lasting), seen.points.ids, seen.points.ids + 10_000)
        estimator.step(replace(seen, points=replace(seen.points, ids=ids), lines=NO_LINES), samples, still=False)
        estimator.marginalise()
    assert (w.points.solved & w.points.seen[:, w.n - 1])[:w.points.count].sum() > 50


def test_covariance_grows_with_distance_and_bounds_the_error(moving):
    _, t, p, cov, _ = run(moving)
    sigma = np.sqrt(cov.sum(axis=1))
    assert sigma[-1] > sigma[0] > 0.0
    assert aligned_error(moving, t, p) < 4.0 * sigma[-1]


def test_upright_takes_the_measured_up_direction_to_z():
    for up in np.random.default_rng(0).normal(size=(20, 3)).tolist() + [[0, 0, 9.8], [0, 0, -9.8]]:
        np.testing.assert_allclose(upright(np.array(up)) @ up, [0, 0, np.linalg.norm(up)], atol=1e-12)


def test_steps_with_jacobians_taken_once_end_where_steps_with_fresh_ones_do(moving, monkeypatch):
    estimator, _, _, _, _ = run(moving)
    rng, w = np.random.default_rng(0), estimator.window
    w.p[w.n - 3:w.n] += rng.normal(0.0, 0.005, (3, 3))
    w.points.abr[:, 2] *= rng.uniform(0.97, 1.03, len(w.points.abr))
    monkeypatch.setattr(solver_module, 'CONVERGED', 1e-6)
    ends = []
    for trusted in (solver_module.TRUSTED, 0.0):
        monkeypatch.setattr(solver_module, 'TRUSTED', trusted)
        solver = copy.deepcopy(estimator.solver)
        with mock.patch.object(solver, '_take_jacobians', wraps=solver._take_jacobians) as taken:
            ends.append((solver.optimise(30), solver.window.p[:w.n].copy(), taken.call_count))
    (cost, p, few), (exact_cost, exact_p, many) = ends
    assert few < 0.75 * many
    assert cost == pytest.approx(exact_cost, rel=1e-4)
    np.testing.assert_allclose(p, exact_p, atol=2e-4)


def test_an_estimate_that_another_step_would_change_is_unsettled(moving):
    """Which is what a start is refused for."""
    estimator, _, _, _, _ = run(moving)
    estimator.solver.optimise(30)
    estimator.linearise()
    assert 0.0 <= estimator.solver.unsettled() < 3.0
    w = estimator.window
    w.p[:w.n] *= 0.9  # a wrong scale
    estimator.linearise()
    assert estimator.solver.unsettled() > MAX_UNSETTLED


def test_a_start_reaches_the_right_scale_through_a_flat_valley():
    """Noise of a pixel and little acceleration: undamped steps overshoot, and damped ones creep."""
    world = World(18, 3.0, 1.0, False, 'room', 600, 700)
    trace = simulate(world)
    moved, true = (np.linalg.norm(T[-1][:3, 3] - T[0][:3, 3]) for T in (trace.T_EB, trace.true_T_EB))
    assert moved == pytest.approx(true, rel=0.05)


def test_a_start_that_disagrees_with_corners_or_inertial_data_is_refused_and_says_so(moving):
    estimator, *_ = run(replace(moving, seconds=1.05))
    bootstrap = Bootstrap(estimator, moving.calibration)
    assert bootstrap._refuse() == ''
    estimator.window.points.sigma /= 10.0
    estimator.solver.cost()
    assert 'agreement of motion and corners' in bootstrap._refuse()
    estimator.window.W *= 20.0
    assert 'calibrate the noise of the IMU' in bootstrap._refuse()


def test_a_state_that_the_prior_knows_can_be_dropped(moving):
    """Its part of the prior is passed on to the others, and nothing else is."""
    estimator, _, _, _, _ = run(moving)
    w = estimator.window
    slot = int(np.flatnonzero(w.frozen[:w.n])[-1])
    own = slice(state_row(slot), state_row(slot + 1))
    others = np.setdiff1d(np.arange(w.rows), np.arange(own.start, own.stop))
    expected, _ = eliminate(w.prior_H[:w.rows, :w.rows], w.prior_g[:w.rows], np.arange(own.start, own.stop), others)
    points = w.points.count
    assert slot and w.prior_H[own, own].any()
    drop_state(estimator.solver, slot)
    np.testing.assert_allclose(w.prior_H[:w.rows, :w.rows], expected, rtol=1e-9, atol=1e-6)
    assert w.points.count == points


def test_eliminating_a_state_leaves_the_solution_of_the_others():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(30, 12))
    H, g = A.T @ A, rng.normal(size=12)
    gone, kept = np.arange(4, 7), np.r_[0:4, 7:12]
    H_r, g_r = eliminate(H, g, gone, kept)
    np.testing.assert_allclose(np.linalg.solve(H_r, g_r), np.linalg.solve(H, g)[kept], rtol=1e-8)


def test_eliminating_an_unobserved_direction_adds_no_information():
    H = np.diag([1.0, 0.0, 2.0, 3.0])
    H_r, _ = eliminate(H, np.zeros(4), np.array([0, 1]), np.array([2, 3]))
    np.testing.assert_allclose(H_r, np.diag([2.0, 3.0]), atol=1e-12)


def test_simulated_inertial_data_is_the_derivative_of_the_trajectory():
    trajectory, t, h = Trajectory.random(5, rest=1.0), np.linspace(0.5, 6.0, 50), 1e-4
    R, _, v, _, force = trajectory.at(t)
    (_, p1, v1, *_), (_, p0, v0, *_) = trajectory.at(t + h), trajectory.at(t - h)
    np.testing.assert_allclose((p1 - p0) / (2 * h), v, atol=1e-6)
    np.testing.assert_allclose(np.einsum('nji,nj->ni', R, (v1 - v0) / (2 * h) - GRAVITY_W), force, atol=1e-5)


def test_a_long_rest_costs_neither_memory_nor_certainty():
    """Tracks live two seconds, so thousands of corners come and go; rows and samples stay bounded, nothing wanders."""
    sequence = Sequence(Trajectory.random(8, rest=99.0), Room.random(8), calibration(), 30.0, frame_rate=10.0)

    def renewed(k, seen):
        epoch = (k + seen.points.ids) // 20
        return replace(seen, points=replace(seen.points, ids=seen.points.ids + 1000 * epoch))

    estimator, _, p, _, failures = run(sequence, change=renewed)
    window = estimator.window
    assert not any(failures)
    assert max(len(s[0]) for s in window.samples) < 1300
    assert window.points.count < len(window.points.ids)
    assert np.linalg.norm(p - p[0], axis=1).max() < 0.005
    assert np.linalg.norm(window.b[window.n - 1, 3:]) < 0.2
