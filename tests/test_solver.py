"""The optimiser's normal equations against the cost itself: the slope they predict is the slope there is."""
import numpy as np
import pytest

from line_slam_ros.estimation.landmarks import back_substitute, retract_landmarks
from line_slam_ros.estimation.solver import Solver, SolverOptions, retract_rig, retract_states
from line_slam_ros.estimation.window import STATE, Window
from line_slam_ros.geometry.lie import so3_exp
from line_slam_ros.geometry.line_forms import store_lines
from line_slam_ros.geometry.lines import line_from_points
from line_slam_ros.types import ImuNoise, LineForm

STATES, POINTS, LINES, SIGMA, NOISE = 4, 20, 10, 0.02, 0.05
RIG_SIGMA = np.array([0.1, 0.1, 0.1, 0.02, 0.02, 0.02, 0.01])
R_BC, p_BC = so3_exp([0.1, 0.2, 0.3]), np.array([0.1, 0.0, 0.05])


@pytest.fixture(params=LineForm, ids=lambda form: form.name.lower())
def solver(request):
    """A window in which nothing agrees: random states, links, prior, points and lines, outliers among them."""
    rng, window = np.random.default_rng(0), Window(STATES + 2, ImuNoise(), POINTS, LINES)
    window.set_rig(R_BC, p_BC, RIG_SIGMA)
    for k in range(STATES):
        t = np.linspace(0.0, 0.2, 41)
        samples = t, 0.1 * rng.normal(size=(41, 3)), 0.1 * rng.normal(size=(41, 3)) + [0, 0, 9.81]
        window.append(k * 200_000_000, so3_exp(0.1 * rng.normal(size=3)), [0.2 * k, 0, 0] + 0.05 * rng.normal(size=3),
                      0.1 * rng.normal(size=3), 0.01 * rng.normal(size=6), samples if k else None)
    window.still[1:3] = True
    rows = window.rows()
    A = rng.normal(size=(len(rows), len(rows)))
    window.prior_H[np.ix_(rows, rows)], window.prior_g[rows] = A @ A.T, rng.normal(size=len(rows))
    _fill_points(window, rng)
    _fill_lines(window, rng, request.param)
    return Solver(window, SolverOptions(np.array([0.0, 0.0, -9.81]), 4.0, 4.0, request.param))


def _fill_points(window, rng):
    table, n = window.points, STATES
    table.count, table.solved[:] = POINTS, True
    table.R_WA[:], table.p_WA[:] = window.R[0] @ R_BC, window.p[0] + window.R[0] @ p_BC
    table.abr[:] = np.column_stack([0.3 * rng.normal(size=(POINTS, 2)), rng.uniform(0.1, 0.4, POINTS)])
    table.seen[:, :n] = rng.random((POINTS, n)) < 0.8
    table.z[:, :n] = table.abr[:, None, :2] + NOISE * rng.normal(size=(POINTS, n, 2))
    table.sigma[:] = SIGMA


def _fill_lines(window, rng, form):
    table, n = window.lines, STATES
    table.count, table.solved[:] = LINES, True
    p_C = rng.normal(size=(LINES, 2, 3)) * [1, 1, 0.3] + [0, 0, 5]
    p_W = p_C @ (window.R[0] @ R_BC).T + window.R[0] @ p_BC + window.p[0]
    table.origin[:] = window.p[0]
    pluecker = line_from_points(*np.moveaxis(p_W - window.p[0], 1, 0))
    stored = np.zeros(LINES, bool)
    store_lines(int(form), pluecker, np.tile(window.R[0] @ R_BC, (LINES, 1, 1)), p_C[..., :2] / p_C[..., 2:],
                table.values, stored)
    assert stored.all()
    table.seen[:, :n] = rng.random((LINES, n)) < 0.8
    table.z[:, :n] = (p_C[..., :2] / p_C[..., 2:])[:, None] + NOISE * rng.normal(size=(LINES, n, 2, 2))
    table.sigma[:] = SIGMA


@pytest.mark.parametrize('seed', range(4))
def test_eliminated_normal_equations_predict_the_slope_of_the_cost(solver, seed):
    """Along any step of the states, the landmarks following: g dx - sum a' A^-1 a, exactly, robust weights and all."""
    w, use_points, use_lines = solver.window, np.ones(POINTS, bool), np.ones(LINES, bool)
    solver.linearise(use_points, use_lines)
    dx, rig = np.zeros(len(solver.g)), STATE * w.slots
    dx[:STATE * STATES] = np.tile(np.repeat([0.1, 0.01], [9, 6]), STATES)
    dx[rig:] = RIG_SIGMA
    dx *= np.random.default_rng(seed).normal(size=len(dx))
    predicted = solver.g @ dx
    for use, seen, size, E, B, A, a, step in (
            (use_points, w.points.seen, 3, solver._E_p, solver._B_p, solver._A_p, solver._a_p, solver._step_p),
            (use_lines, w.lines.seen, 4, solver._E_l, solver._B_l, solver._A_l, solver._a_l, solver._step_l)):
        back_substitute(w.n, use, seen, size, rig, E, B, A, a, dx, step)
        predicted -= np.einsum('ij,ijk,ik->', a, A, a)
    before = solver._save()

    def cost(part):
        solver._restore(before)
        retract_states(w.n, w.R, w.p, w.v, w.b, part * dx)
        retract_rig(w.R_BC, w.p_BC, w.delay, part * dx[rig:])
        retract_landmarks(use_points, w.points.abr, part * solver._step_p, use_lines,
                          int(solver.options.line_form), w.lines.values, part * solver._step_l)
        return solver.cost()

    assert (cost(1e-5) - cost(-1e-5)) / 2e-5 == pytest.approx(predicted, rel=1e-6)


def test_covariance_of_a_line_is_that_of_the_joint_equations_with_the_newest_pose_fixed(solver):
    w = solver.window
    solver.linearise(np.ones(POINTS, bool), np.ones(LINES, bool))
    rows, newest = w.rows(), STATE * (w.n - 1)
    kept = np.flatnonzero((rows < newest) | (rows >= newest + 6))
    found = solver.line_covariances(np.arange(LINES))
    for i in range(LINES):
        W = np.zeros((4, len(solver.g)))
        for slot in np.flatnonzero(w.lines.seen[i, :w.n]):
            W[:, STATE * slot:STATE * slot + 6] = solver._E_l[i, slot]
        W[:, STATE * w.slots:] = solver._B_l[i]
        A_inverse, W = solver._A_l[i], W[:, rows]
        states = solver.H[np.ix_(rows, rows)] + W.T @ A_inverse @ W  # the line not eliminated
        joint = np.block([[states, W.T], [W, np.linalg.inv(A_inverse)]])
        free = np.append(kept, len(rows) + np.arange(4))
        expected = np.linalg.inv(joint[np.ix_(free, free)])[-4:, -4:]
        np.testing.assert_allclose(found[i], expected, atol=1e-6 * np.abs(expected).max())
