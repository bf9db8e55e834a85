"""Frames between keyframes: only the newest state moves, against the landmarks as they stand."""
import copy

import numpy as np
import pytest

from line_slam_ros.config import Estimator as Options
from line_slam_ros.estimation.bootstrap import drive
from line_slam_ros.estimation.estimator import Estimator
from line_slam_ros.estimation.solver import retract_states
from line_slam_ros.estimation.window import RIG, STATE, state_row
from line_slam_ros.factors.line_reprojection import line_residual
from line_slam_ros.factors.point_reprojection import inverse_depth_point, point_residual
from line_slam_ros.geometry.line_forms import move_line, world_line
from line_slam_ros.simulation.features import Room, Sequence, Trajectory, calibration
from line_slam_ros.types import LINE_FORMS


def followed(options=None, seconds=6.0):
    """An estimator that has just followed a frame, and what it was before that frame, with the frame."""
    sequence = Sequence(Trajectory.random(2), Room.random(2), calibration(), seconds)
    estimator = Estimator(options or Options(), sequence.calibration, 450.0, 700, 150)
    given, last = [], None

    def steps():
        for seen, samples in sequence.steps():
            given[:] = copy.deepcopy(estimator), (seen, samples, False)
            yield seen, samples

    for _ in drive(estimator, sequence.calibration, steps()):
        if estimator._followed:
            last = copy.deepcopy(estimator), *given
    return last


@pytest.fixture(scope='module')
def frame():
    return followed()


@pytest.fixture
def follower(frame):
    return copy.deepcopy(frame[0])._follower


def evaluation(follower):
    """The cost as a function of a step (30,) from here, with what the newest state sees weighed once."""
    w = follower._solver.window
    follower._look()
    states = [a[w.n - 2:w.n] for a in (w.R, w.p, w.v, w.b)]
    start = [a.copy() for a in states]

    def cost(dx):
        for a, s in zip(states, start, strict=True):
            a[:] = s
        retract_states(2, *states, np.concatenate([np.zeros(RIG), dx]))
        return follower._evaluate()

    return cost


SCALE = np.tile(np.repeat([0.003, 0.01, 0.01, 0.001, 0.01], 3), 2)  # of a step


@pytest.mark.parametrize('form', LINE_FORMS)
def test_gradient_is_the_slope_of_the_cost(form):
    follower = followed(Options(line_representation=form), 4.0)[0]._follower
    w = follower._solver.window
    dx = np.concatenate([np.zeros(RIG), SCALE * np.random.default_rng(0).normal(size=2 * STATE)])
    retract_states(2, *(a[w.n - 2:w.n] for a in (w.R, w.p, w.v, w.b)), dx)
    cost = evaluation(follower)
    cost(np.zeros(2 * STATE))
    g = SCALE * follower._equations()[1]
    slopes = [(cost(1e-3 * s * e) - cost(-1e-3 * s * e)) / 2e-3 for s, e in zip(SCALE, np.eye(2 * STATE), strict=True)]
    np.testing.assert_allclose(slopes, g, rtol=2e-3, atol=2e-4 * np.abs(g).max())


def test_hessian_is_how_the_gradient_changes():
    """Near the least cost, where the curvature of the residuals does not matter, and without robust weights."""
    follower = followed(Options(loss_scale=100.0), 4.0)[0]._follower
    cost, step = evaluation(follower), 1e-3 * SCALE
    cost(np.zeros(2 * STATE))
    H = follower._equations()[0] * np.outer(step, step)

    def gradient(dx):
        cost(dx)
        return follower._equations()[1].copy()

    change = np.array([(gradient(s * e) - gradient(-s * e)) / 2.0 * step
                       for s, e in zip(step, np.eye(2 * STATE), strict=True)])
    own = np.sqrt(np.diag(H))
    np.testing.assert_allclose(change / np.outer(own, own), H / np.outer(own, own), atol=0.02)


def test_what_is_left_unknown_of_a_landmark_is_noise(follower):
    """Against numerical derivatives of the residuals by the landmark."""
    w, solver, k = follower._solver.window, follower._solver, follower._solver.window.n - 1
    follower._look()
    _, points, point_sigma, _, lines, line_sigma = follower._seen
    R, p = solver.exposed()
    r, found = np.zeros(2), np.zeros(2)

    def point(i, dx):
        C, p_W = np.empty((3, 3)), np.empty(3)
        inverse_depth_point(w.points.R_WA[i], w.points.p_WA[i], w.points.abr[i] + dx, p_W, C)
        assert point_residual(R[k], p[k], w.R_BC, w.p_BC, p_W, w.points.z[i, k], r)

    def line(i, dx):
        value, n_W, d_W, C = np.zeros_like(w.lines.values[i]), np.empty(3), np.empty(3), np.empty((6, 4))
        move_line(int(solver.options.line_form), w.lines.values[i], dx, value)
        world_line(int(solver.options.line_form), value, w.lines.origin[i], n_W, d_W, C)
        assert line_residual(R[k], p[k], w.R_BC, w.p_BC, n_W, d_W, w.lines.z[i, k], r)

    for table, seen, sigma, residual in ((w.points, points, point_sigma, point), (w.lines, lines, line_sigma, line)):
        rows = np.flatnonzero(seen[:, k])
        assert len(rows) > 10 and (sigma[rows, k] >= table.sigma[rows, k]).all()
        for i in rows[:20]:
            d = table.L.shape[1]
            J = np.zeros((2, d))
            for j in range(d):
                for sign in (1.0, -1.0):
                    residual(i, sign * 1e-5 * np.eye(d)[j])
                    J[:, j] += sign * r / 2e-5
            L = np.tril(table.L[i])
            found[:] = table.sigma[i, k]**2 + np.diag(J @ np.linalg.inv(L @ L.T) @ J.T)
            np.testing.assert_allclose(sigma[i, k]**2, found, rtol=1e-3)


def test_landmarks_without_an_estimate_say_nothing(follower):
    """Whatever was in their rows of the solver's buffers before."""
    w, solver = follower._solver.window, follower._solver
    for table in (w.points, w.lines):
        table.solved[table.count // 2:table.count] = False
    evaluation(follower)(np.zeros(2 * STATE))
    H, g = (a.copy() for a in follower._equations())
    for table, kind in ((w.points, solver.points), (w.lines, solver.lines)):
        kind.weight[table.count // 2:], kind.pull[table.count // 2:] = 1.0, 9.0
    for after, before in zip(follower._equations(), (H, g), strict=True):
        np.testing.assert_array_equal(after, before)


def test_only_the_last_two_states_move(frame):
    after, before, (seen, samples, still) = frame
    before = copy.deepcopy(before)
    held = {name: getattr(before.window, name)[:before.window.n].copy() for name in ('R', 'p', 'v', 'b', 't_ns')}
    before.step(seen, samples, still)
    w = before.window
    assert before._followed and not before.newest_is_keyframe
    for name, values in held.items():
        np.testing.assert_array_equal(getattr(w, name)[:w.n - 2], values[:w.n - 2])
        np.testing.assert_array_equal(getattr(w, name)[:w.n], getattr(after.window, name)[:w.n])  # and always so


def test_it_puts_the_newest_state_where_the_whole_window_would(frame):
    """Against the state before it; how well that stands in the world is another matter."""
    after = copy.deepcopy(frame[0])
    w, k = after.window, after.window.n - 1
    moved, turned = w.R[k - 1].T @ (w.p[k] - w.p[k - 1]), w.R[k - 1].T @ w.R[k]
    sigma = np.sqrt(np.diag(np.linalg.inv(after._follower._pair)))[STATE:]
    after.solver.optimise(20)
    np.testing.assert_allclose(w.R[k - 1].T @ (w.p[k] - w.p[k - 1]), moved, atol=2.0 * sigma[3:6].max())
    np.testing.assert_allclose(w.R[k - 1].T @ w.R[k], turned, atol=2.0 * sigma[:3].max())


def test_covariance_is_that_of_the_whole_window(frame):
    after = copy.deepcopy(frame[0])
    mine = after.covariance()
    after.linearise()
    whole = after.solver.covariance(after.window.n - 1)[:9, :9]
    ratio = np.sqrt(np.diag(mine) / np.diag(whole))
    assert (ratio > 0.9).all() and (ratio < 1.5).all(), ratio
    given = np.linalg.inv(after._follower._pair)[STATE:, STATE:]
    assert np.sqrt(np.trace(given[3:6, 3:6])) < 0.5 * np.sqrt(np.trace(mine[3:6, 3:6]))  # what landmarks do not know


def test_lines_are_told_after_a_followed_frame_as_after_another(frame):
    after = copy.deepcopy(frame[0])
    told = after.lines()
    assert len(told.ids) and np.isfinite(told.cov).all()
    assert told.seen.shape[1] == after.window.n
    fresh = copy.deepcopy(frame[0])
    fresh.linearise()
    fresh._followed = False
    np.testing.assert_array_equal(told.cov, fresh.lines().cov)


def test_information_is_all_there_is_where_no_landmark_is(frame):
    after = copy.deepcopy(frame[0])
    w, solver = after.window, after.solver
    solver.linearise(np.zeros(w.points.count, bool), np.zeros(w.lines.count, bool))
    for slot in (w.n - 1, w.n - 2):
        cut = solver.H[:state_row(slot + 1), :state_row(slot + 1)]
        if slot < w.n - 1:  # without the link that follows it
            solver.linearise(np.zeros(w.points.count, bool), np.zeros(w.lines.count, bool), links=(0, slot))
            cut = solver.H[:state_row(slot + 1), :state_row(slot + 1)]
        expected = np.linalg.inv(np.linalg.inv(cut)[-STATE:, -STATE:])
        np.testing.assert_allclose(solver.information(slot), expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize('from_newest', [0, 1, 4])
def test_landmarks_that_are_given_can_only_add_information(frame, from_newest):
    after = copy.deepcopy(frame[0])
    after.linearise()
    owed = after.solver.owed_to_landmarks(after.window.n - 1 - from_newest)
    own = np.sqrt(np.diag(owed))
    assert np.linalg.eigvalsh(owed / np.outer(own, own)).min() > -1e-6


def test_what_is_owed_to_landmarks_is_the_rest_of_the_newest_covariance(frame):
    after = copy.deepcopy(frame[0])
    after.linearise()
    newest, solver = after.window.n - 1, after.solver
    rest = np.linalg.inv(solver.information(newest)) + solver.owed_to_landmarks(newest)
    np.testing.assert_allclose(rest, solver.covariance(newest), rtol=1e-6, atol=1e-9 * np.abs(rest).max())


def test_what_does_not_settle_moves_nothing(follower):
    w = follower._solver.window
    w.p[w.n - 1] += 0.5
    before = {name: getattr(w, name).copy() for name in ('R', 'p', 'v', 'b')}
    assert not follower.follow(1)
    for name, values in before.items():
        np.testing.assert_array_equal(getattr(w, name), values)


def test_few_known_landmarks_take_the_whole_window(frame):
    _, before, (seen, samples, still) = frame
    before = copy.deepcopy(before)
    for table in (before.window.points, before.window.lines):
        table.solved[10:table.count] = False
    before.step(seen, samples, still)
    assert not before._followed


def test_another_state_before_the_newest_is_no_anchor(follower):
    assert follower.anchored
    follower._solver.window.t_ns[follower._solver.window.n - 2] += 1
    assert not follower.anchored
    follower._solver.window.t_ns[follower._solver.window.n - 2] -= 1
    for slot in (1, 2):
        follower._solver.window.still[follower._solver.window.n - slot] = True  # at rest the window is optimised
        assert not follower.anchored
        follower._solver.window.still[follower._solver.window.n - slot] = False
    assert follower.anchored
    follower.clear()
    assert not follower.anchored


def test_landmarks_culled_afterwards_do_not_change_the_covariance(frame):
    after = copy.deepcopy(frame[0])
    expected = after.covariance()
    after.window.points.keep(np.arange(after.window.points.count) % 2 == 0)
    np.testing.assert_array_equal(after.covariance(), expected)


def test_equations_without_a_solution_move_nothing(follower):
    follower._information[:] = -1e12 * np.eye(STATE)
    before = follower._solver.window.p.copy()
    assert not follower.follow(4)
    np.testing.assert_array_equal(follower._solver.window.p, before)
