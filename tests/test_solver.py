"""The optimiser's normal equations against the cost itself: the slope they predict is the slope there is."""
import numpy as np
import pytest

from line_slam_ros.estimation.landmarks import back_substitute, column, gather, retract_landmarks
from line_slam_ros.estimation.solver import Solver, SolverOptions, retract_rig, retract_states
from line_slam_ros.estimation.window import RIG, Window, state_row
from line_slam_ros.geometry.lie import so3_exp
from line_slam_ros.geometry.line_forms import store_lines
from line_slam_ros.geometry.lines import line_from_points
from line_slam_ros.types import ImuNoise, LineForm

STATES, POINTS, LINES, SIGMA, NOISE, SPREAD = 4, 20, 10, 0.02, 0.05, 0.3
RIG_SIGMA = np.array([0.1, 0.1, 0.1, 0.02, 0.02, 0.02, 0.01, 0.1, 0.1])
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
    rows = window.rows
    A = rng.normal(size=(rows, rows))
    window.prior_H[:rows, :rows], window.prior_g[:rows] = A @ A.T, rng.normal(size=rows)
    _fill_points(window, rng)
    _fill_lines(window, rng, request.param)
    return Solver(window, SolverOptions(np.array([0.0, 0.0, -9.81]), 4.0, 4.0, request.param, SPREAD))


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
    w = solver.window
    solver.linearise(np.ones(POINTS, bool), np.ones(LINES, bool))
    dx = np.concatenate([RIG_SIGMA, np.tile(np.repeat([0.1, 0.01], [9, 6]), STATES)])
    dx *= np.random.default_rng(seed).normal(size=len(dx))
    columns = np.zeros(column(w.n))
    gather(w.n, dx, columns)
    t = solver._s + solver._S[:, :len(columns)] @ columns
    for kind in (solver.points, solver.lines):
        back_substitute(kind.use, kind.size, kind.L, kind.first, t, kind.step)
    predicted = solver.g[:w.rows] @ dx - solver._s @ solver._s
    before = solver._save()

    def cost(part):
        solver._restore(before)
        retract_states(w.n, w.R, w.p, w.v, w.b, part * dx)
        retract_rig(w.R_BC, w.p_BC, w.delay, w.lean, part * dx[:RIG])
        retract_landmarks(solver.points.use, w.points.abr, part * solver.points.step, solver.lines.use,
                          int(solver.options.line_form), w.lines.values, part * solver.lines.step)
        return solver.cost()

    assert (cost(1e-5) - cost(-1e-5)) / 2e-5 == pytest.approx(predicted, rel=1e-6)


def test_covariance_of_a_line_is_that_of_the_joint_equations_with_the_newest_pose_fixed(solver):
    w = solver.window
    solver.linearise(np.ones(POINTS, bool), np.ones(LINES, bool))
    kept = np.setdiff1d(np.arange(w.rows), state_row(w.n - 1) + np.arange(6))
    scale = np.linspace(0.4, 2.0, LINES)  # of the noise: what is better than it was said to be is not believed to be
    given = solver.line_covariances(np.arange(LINES))
    w.lines.scale[:LINES] = scale
    np.testing.assert_array_equal(solver.line_covariances(np.arange(LINES)), given)  # learned since
    solver.linearise(np.ones(POINTS, bool), np.ones(LINES, bool))
    found = solver.line_covariances(np.arange(LINES))
    seen = np.zeros((column(w.n), w.rows))
    gather_rows = np.concatenate([np.arange(RIG), *(state_row(k) + np.arange(6) for k in range(w.n))])
    seen[np.arange(len(seen)), gather_rows] = 1.0
    for i in range(LINES):
        L = np.tril(solver.lines.L[i])
        W = L @ solver._S[solver.lines.first[i]:][:4, :len(seen)] @ seen
        states = solver.H[:w.rows, :w.rows] + W.T @ np.linalg.inv(L @ L.T) @ W  # the line not eliminated
        joint = np.block([[states, W.T], [W, L @ L.T]])
        free = np.append(kept, w.rows + np.arange(4))
        expected = np.linalg.inv(joint[np.ix_(free, free)])[-4:, -4:]
        np.testing.assert_allclose(given[i], expected, atol=1e-6 * np.abs(expected).max())
        more = np.linalg.inv(L @ L.T) * max(scale[i]**-2.0 - 1.0, 0.0)
        np.testing.assert_allclose(found[i], expected + more, atol=1e-6 * np.abs(expected).max())


def test_a_rig_that_is_not_estimated_stays_and_the_others_do_not_see_it(solver):
    """Its equations are those without its rows; part of a rig can be held, too."""
    w, free = solver.window, np.array([0, 1, 2, 6, 7, 8])
    use = np.ones(POINTS, bool), np.ones(LINES, bool)
    solver.linearise(*use)
    kept = np.concatenate([free, np.arange(RIG, w.rows)])
    expected, g = solver.H[np.ix_(kept, kept)], solver.g[kept]
    w.rig_sigma[3:6] = 0.0
    solver.linearise(*use)
    np.testing.assert_allclose(solver.H[np.ix_(kept, kept)], expected, rtol=1e-12)
    np.testing.assert_allclose(solver.g[kept], g, rtol=1e-12)
    before = w.p_BC.copy()
    solver.optimise(2)
    assert (w.p_BC == before).all()


@pytest.mark.parametrize('held', [slice(3, 6), slice(7, 9)])
def test_what_is_held_adds_nothing_to_the_covariance_of_lines(solver, held):
    w, use = solver.window, (np.ones(POINTS, bool), np.ones(LINES, bool))
    w.prior_H[held, held] += 1e12 * np.eye(held.stop - held.start)
    solver.linearise(*use)
    expected = solver.line_covariances(np.arange(LINES))
    w.rig_sigma[held] = 0.0
    solver.linearise(*use)
    np.testing.assert_allclose(solver.line_covariances(np.arange(LINES)), expected, rtol=1e-4,
                               atol=1e-6 * np.abs(expected).max())


def test_a_line_that_lost_its_direction_takes_no_part(solver):
    w = solver.window
    w.lines.values[0] = np.nan
    assert np.isfinite(solver.cost())
    before = solver.cost()
    assert solver.optimise(4) < before


def test_equations_without_a_solution_are_told(solver):
    solver.linearise(np.ones(POINTS, bool), np.ones(LINES, bool))
    solver.H[:] = -solver.H
    for ask in (lambda: solver.covariance(STATES - 1), lambda: solver.line_covariances(np.arange(LINES))):
        with pytest.raises(np.linalg.LinAlgError, match='positive definite'):
            ask()
