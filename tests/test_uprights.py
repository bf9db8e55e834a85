"""The belief in upright lines: its Jacobian, whom it concerns, and what it does to roll and pitch."""
from dataclasses import replace

import numpy as np
import pytest

from line_slam_ros.benchmark.consistency import MAX_LINES, MAX_POINTS
from line_slam_ros.config import Estimator as Options
from line_slam_ros.estimation.bootstrap import drive
from line_slam_ros.estimation.estimator import Estimator
from line_slam_ros.estimation.uprights import upright_residuals
from line_slam_ros.factors.upright import upright
from line_slam_ros.geometry.lie import so3_exp
from line_slam_ros.geometry.line_forms import VALUES, move_line, store_lines, world_line
from line_slam_ros.geometry.lines import line_from_points
from line_slam_ros.kernel_cache import kernel
from line_slam_ros.simulation.features import Room, Sequence, Trajectory, calibration
from line_slam_ros.types import LineForm

SPREAD, LEAN = 0.01, np.array([0.02, -0.01])  # rad


@kernel
def residual(d_W, C, lean, spread, r, J):
    """For Python."""
    return upright(d_W, C, lean, spread, r, J)


def of(form, values, lean=LEAN):
    """Residual and Jacobian of a stored line about the origin."""
    n, d, C, r, J = np.empty(3), np.empty(3), np.empty((6, 4)), np.empty(2), np.empty((2, 4))
    world_line(int(form), values, np.zeros(3), n, d, C)
    assert residual(d, C, lean, SPREAD, r, J)
    return r, J


def stored(form, a, b):
    """Values of the line through points a, b (3,) in the host camera's frame, which is the world's."""
    a, b, values, ok = np.asarray(a, float), np.asarray(b, float), np.empty((1, VALUES)), np.zeros(1, bool)
    ends = np.stack([a[:2] / a[2], b[:2] / b[2]])[None]
    store_lines(int(form), line_from_points(a, b)[None], np.eye(3)[None], ends, values, ok)
    assert ok[0]
    return values[0]


@pytest.mark.parametrize('form', LineForm, ids=lambda form: form.name.lower())
@pytest.mark.parametrize('end', [(0.7, 0.6, 5.0), (0.5, 0.5, 0.6)])  # up, and down
def test_jacobian_is_the_derivative(form, end):
    values, eps = stored(form, (0.5, 0.4, 2.0), end), 1e-6
    J = of(form, values)[1]
    for j in range(form.freedom):
        step, moved = np.zeros(4), []
        for sign in (1.0, -1.0):
            step[j] = sign * eps
            out = np.empty(VALUES)
            move_line(int(form), values, step, out)
            moved.append(of(form, out)[0])
        np.testing.assert_allclose(J[:, j], (moved[0] - moved[1]) / (2.0 * eps), rtol=1e-5, atol=1e-5 / SPREAD)


def test_a_line_may_run_up_or_down():
    up, down = (of(LineForm.ORTHONORMAL, stored(LineForm.ORTHONORMAL, *ends))[0]
                for ends in (((0.5, 0.4, 2.0), (0.6, 0.4, 5.0)), ((0.6, 0.4, 5.0), (0.5, 0.4, 2.0))))
    np.testing.assert_allclose(up, down, atol=1e-9)


def test_a_line_along_the_lean_pulls_at_nothing_and_a_level_one_hardly():
    form, n = LineForm.ORTHONORMAL, 3
    along = np.array([*LEAN, np.sqrt(1.0 - LEAN @ LEAN)])
    start = 0.5, 0.4, 2.0
    lines = [(start, np.add(start, direction)) for direction in (along, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))]
    values = np.stack([stored(form, *line) for line in lines])
    pull, weight, a = np.ones((n, 2)), np.ones(n), np.zeros((n, 4))
    upright_residuals(np.array([True, True, True]), int(form), values, np.zeros((n, 3)), LEAN, SPREAD, pull, weight, a)
    assert weight[0] == pytest.approx(1.0) and np.abs(pull[0]).max() < 1e-9
    assert weight[1] < 2e-4
    np.testing.assert_allclose(pull[2], weight[2] * -LEAN / SPREAD)
    assert np.abs(a[2]).max() > 50.0 * np.abs(a[1]).max()
    upright_residuals(np.zeros(n, bool), int(form), values, np.zeros((n, 3)), LEAN, SPREAD, pull, weight, a)
    assert not (pull.any() or weight.any())


def tilts(room, options, seconds=4.0, seed=3):
    """Roll and pitch error (N, 2) rad, in the world, over a straight walk with a biased accelerometer, and the lean."""
    still = Trajectory.walk(seed)
    motion = replace(still, amplitude=0.3 * still.amplitude)
    sequence = Sequence(motion, room, calibration(), seconds, seed=seed, accel_bias=(0.08, -0.09, 0.05))
    estimator, errors = Estimator(options, sequence.calibration, 450.0, MAX_POINTS, MAX_LINES), []
    for seen, _ in drive(estimator, sequence.calibration, sequence.steps()):
        assert not estimator.failure
        R = estimator.window.R[estimator.window.n - 1]
        up, true = R.T[:, 2], motion.at(np.array([seen.t_ns * 1e-9]))[0][0].T[:, 2]
        errors.append(np.linalg.norm(up - true))
    return np.array(errors), estimator.window.lean.copy()


def test_upright_lines_tell_the_tilt_that_the_bias_hides():
    room = Room.corridor(5, 600)
    believed, without = (tilts(room, replace(Options(), upright_spread_deg=spread))[0] for spread in (0.5, 0.0))
    assert len(believed) > 20 and len(without) > 20
    assert believed[-20:].mean() < np.radians(0.3)
    assert believed[-20:].mean() < 0.6 * without[-20:].mean()


def test_a_building_that_leans_is_found_out():
    """Once the body has turned a lot, gravity is known better than the building."""
    seed, lean = 4, np.radians([0.6, -0.8])
    room, turn = Room.random(seed), so3_exp(np.array([-lean[1], lean[0], 0.0]))
    room = Room(room.points, room.lines @ turn.T)
    sequence = Sequence(Trajectory.random(seed), room, calibration(), 15.0, seed=seed)
    estimator = Estimator(replace(Options(), lean_sigma_deg=1.0), sequence.calibration, 450.0, MAX_POINTS, MAX_LINES)
    frames = sum(1 for _ in drive(estimator, sequence.calibration, sequence.steps()))
    assert frames > 200
    w = estimator.window
    R = sequence.trajectory.at(np.array([w.t_ns[w.n - 1] * 1e-9]))[0][0]
    assert np.linalg.norm(w.R[w.n - 1].T[:, 2] - R.T[:, 2]) < np.radians(0.1)
    heading = w.R[w.n - 1] @ R.T
    np.testing.assert_allclose(w.lean, heading[:2, :2] @ lean, atol=np.radians(0.1))


def test_a_building_that_is_exactly_upright_has_no_lean():
    errors, lean = tilts(Room.corridor(5, 600), replace(Options(), lean_sigma_deg=0.0), seconds=3.0)
    assert len(errors) > 5 and not lean.any()
