"""Between keyframes: the newest state against landmarks held where the last optimisation of the window left them.

A frame that is no keyframe leaves the window, and its observations with it, as soon as the next one comes, so it need
not move anything but itself. The state that stays before it, the anchor, takes part with what the window knows of it,
given the landmarks: Gauss-Newton over two states, a Kalman filter's update in information form. What is left unknown of
each landmark, given the poses, counts as noise of its observation.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.estimation.dense import cholesky, solve
from line_slam_ros.estimation.solver import (
    Solver,
    add_link_gradients,
    add_link_hessians,
    link_residuals,
    retract_states,
)
from line_slam_ros.estimation.window import POSE, RIG, STATE, state_difference, state_row
from line_slam_ros.factors.line_reprojection import line_reprojection
from line_slam_ros.factors.point_reprojection import inverse_depth_point, point_reprojection
from line_slam_ros.geometry.lie import hat
from line_slam_ros.geometry.line_forms import world_line
from line_slam_ros.kernel_cache import inner, kernel
from line_slam_ros.types import F64

PAIR = slice(RIG, RIG + 2 * STATE)  # rows of both states in equations of their own
SETTLED = 0.4  # change of the cost below which iterating ends: of thirty numbers, a sixth of a standard deviation each


class Follower:
    """Works on the solver's window and options; owns the anchor."""

    def __init__(self, solver: Solver):
        self._solver, window = solver, solver.window
        self._t_ns = -1  # of the anchor; -1: there is none
        self._state = tuple(np.zeros((1, *a.shape[1:])) for a in (window.R, window.p, window.v, window.b))
        self._information, self._common = np.zeros((STATE, STATE)), np.zeros((STATE, STATE))
        self._delta, self._seen = np.zeros(RIG + STATE), tuple(np.zeros(0) for _ in range(6))
        self._pair = np.eye(2 * STATE)
        self._H, self._g = np.zeros_like(solver.H), np.zeros_like(solver.g)
        self._J, self._r = np.zeros((window.slots, 2, STATE, STATE)), np.zeros((window.slots, STATE))

    def clear(self) -> None:
        """No anchor."""
        self._t_ns = -1

    def anchor(self, slot: int) -> None:
        """Keep what the window, just optimised, says of a slot's state: one that stays when the next frame comes.

        LinAlgError when the equations have no solution.
        """
        w = self._solver.window
        self._information = self._solver.information(slot)
        self._common = self._solver.owed_to_landmarks(slot)
        for mine, theirs in zip(self._state, (w.R, w.p, w.v, w.b), strict=True):
            mine[0] = theirs[slot]
        for table, kind in ((w.points, self._solver.points), (w.lines, self._solver.lines)):
            taken = table.taken[:table.count]
            table.L[:table.count] = np.where((taken >= 0)[:, None, None], kind.L[taken], 0.0)
        self._t_ns = w.t_ns[slot]

    @property
    def anchored(self) -> bool:
        """Whether the state before the newest is the anchor, and the body moves: states at rest hold each other."""
        w = self._solver.window
        return bool(w.t_ns[w.n - 2] == self._t_ns and not w.still[w.n - 2:w.n].any())

    def follow(self, iterations: int) -> bool:
        """Move the newest state (and the anchor, from which the next one is predicted) to where the cost is least.

        Refreshes the newest column of points.chi2 and lines.chi2 of the solver, the others become -1. False, and
        nothing moved for good, when the cost has not settled after so many steps.
        """
        w, first = self._solver.window, self._solver.window.n - 2
        states = [a[first:w.n] for a in (w.R, w.p, w.v, w.b)]
        start, dx = [a.copy() for a in states], np.zeros(RIG + 2 * STATE)
        self._look()
        cost = self._evaluate()
        for _ in range(iterations):
            self._pair, g = self._equations()
            factor = cholesky(self._pair)
            if not len(factor):
                break
            dx[PAIR] = solve(factor, -g)
            predicted = -0.5 * float(g @ dx[PAIR])
            retract_states(2, *states, dx)
            before, cost = cost, self._evaluate()
            if max(abs(before - cost), predicted) < SETTLED:
                return True
        for a, s in zip(states, start, strict=True):
            a[:] = s
        return False

    def covariance(self) -> F64:
        """(15, 15) of the newest state just followed, by the equations of the last step.

        What both states owe to the landmarks' common error is carried over from the anchor: that error turns and
        shifts everything, and goes on as the velocity's does.
        """
        w, n = self._solver.window, self._solver.window.n - 1
        a = n - 1
        T = np.eye(STATE)
        T[:3, :3] = w.R[n].T @ w.R[a]
        T[3:6, :3] = -hat(w.p[n] - w.p[a]) @ w.R[a]
        T[6:9, :3] = -hat(w.v[n] - w.v[a]) @ w.R[a]
        T[3:6, 6:9] = w.dt[a] * np.eye(3)
        given = np.linalg.inv(cholesky(self._pair)[STATE:, STATE:])
        return given @ given.T + T @ self._common @ T.T

    def _look(self) -> None:
        """Keep what the newest state sees: of points (rows,) bool of those known, (rows, slots) bool of those seen and
        (rows, slots, 2) of standard deviations, and the same of lines."""
        w, k, form = self._solver.window, self._solver.window.n - 1, int(self._solver.options.line_form)
        p, q = w.points, w.lines
        R, position = self._solver.exposed()
        seen = []
        for table in (p, q):
            now = np.zeros((table.count, w.slots), np.bool_)
            now[:, k] = table.seen[:table.count, k] & (table.L[:table.count, -1, -1] > 0.0)
            seen += table.solved[:table.count], now, np.ones((table.count, w.slots, 2))
        point_doubts(k, R[k], position[k], w.R_BC, w.p_BC, seen[1], p.z, p.sigma, p.abr, p.R_WA, p.p_WA, p.L, seen[2])
        line_doubts(k, R[k], position[k], w.R_BC, w.p_BC, seen[4], q.z, q.sigma, form, q.values, q.origin, q.L, seen[5])
        self._seen = tuple(seen)

    def _evaluate(self) -> float:
        """Residuals, at the present estimate, of what the newest state sees; returns the robust cost."""
        s, w, g_W = self._solver, self._solver.window, self._solver.options.g_W
        a, n = w.n - 2, w.n - 1
        state_difference(1, w.R[a:n], w.p[a:n], w.v[a:n], w.b[a:n], *self._state, self._delta)
        delta = self._delta[RIG:]
        return (0.5 * float(delta @ self._information @ delta) + s.landmark_cost(*self._seen)
                + link_residuals(a, n, w.R, w.p, w.v, w.b, w.dt, w.dR, w.dp, w.dv, w.J_b, w.b_lin, w.W, w.w_b, g_W,
                                 self._r))

    def _equations(self) -> tuple[F64, F64]:
        """Hessian (30, 30) and gradient (30,) of the anchor and the newest state, at the last evaluation."""
        s, w, o = self._solver, self._solver.window, self._solver.options
        a, n = w.n - 2, w.n - 1
        rows = slice(state_row(a), state_row(w.n))
        H, g = self._H[rows, rows], self._g[rows]
        H[:], g[:] = 0.0, 0.0
        add_link_hessians(a, n, w.R, w.p, w.v, w.b, w.dt, w.dR, w.dp, w.dv, w.J_b, w.b_lin, w.W, w.w_b, o.g_W, self._J,
                          self._H)
        add_link_gradients(a, n, self._J, self._r, self._g)
        H[:STATE, :STATE] += self._information
        g[:STATE] += self._information @ self._delta[RIG:]
        R, p = s.exposed()
        seen = H[STATE:STATE + POSE, STATE:STATE + POSE], g[STATE:STATE + POSE]
        add_points(n, R[n], p[n], w.R_BC, w.p_BC, self._seen[0], w.points.z, self._seen[2], w.points.abr,
                   w.points.R_WA, w.points.p_WA, s.points.weight, s.points.pull, *seen)
        add_lines(n, R[n], p[n], w.R_BC, w.p_BC, self._seen[3], w.lines.z, self._seen[5], int(o.line_form),
                  w.lines.values, w.lines.origin, s.lines.weight, s.lines.pull, *seen)
        return H, g


@kernel
def add_points(slot, R, p, R_BC, p_BC, use, z, sigma, abr, R_WA, p_WA, weight, pull, H, g):
    """Add what a slot's observations of points with use[i] say of its pose to H (6, 6) and g (6,)."""
    v, J_pose, J_rig, J_p = np.empty(2), np.empty((2, POSE)), np.empty((2, POSE)), np.empty((2, 3))
    p_W, C = np.empty(3), np.empty((3, 3))
    for i in range(len(use)):
        if use[i] and weight[i, slot] > 0.0:
            inverse_depth_point(R_WA[i], p_WA[i], abr[i], p_W, C)
            if point_reprojection(R, p, R_BC, p_BC, p_W, z[i, slot], v, J_pose, J_rig, J_p):
                add_pose(J_pose, sigma[i, slot], weight[i, slot], pull[i, slot], H, g)


@kernel
def add_lines(slot, R, p, R_BC, p_BC, use, z, sigma, form, values, origin, weight, pull, H, g):
    """As add_points, for lines."""
    v, J_pose, J_rig, J_l = np.empty(2), np.empty((2, POSE)), np.empty((2, POSE)), np.empty((2, 6))
    n_W, d_W, C = np.empty(3), np.empty(3), np.empty((6, 4))
    for i in range(len(use)):
        if use[i] and weight[i, slot] > 0.0:
            world_line(form, values[i], origin[i], n_W, d_W, C)
            if line_reprojection(R, p, R_BC, p_BC, n_W, d_W, z[i, slot], v, J_pose, J_rig, J_l):
                add_pose(J_pose, sigma[i, slot], weight[i, slot], pull[i, slot], H, g)


@inner(forceinline=True)
def add_pose(J, sigma, weight, pull, H, g):
    """Add one observation, its Jacobian J (2, 6) not whitened, pull (2,) its weighted whitened residual."""
    for k in range(2):
        for a in range(POSE):
            x = J[k, a] / sigma[k]
            g[a] += x * pull[k]
            for c in range(POSE):
                H[a, c] += weight * x * J[k, c] / sigma[k]


@kernel
def point_doubts(slot, R, p, R_BC, p_BC, seen, z, sigma, abr, R_WA, p_WA, L, total):
    """Standard deviations total (rows, slots, 2) of a slot's residuals: of the observation and of the point, given
    the poses. What the slot cannot see is no longer seen."""
    v, J_pose, J_rig, J_p = np.empty(2), np.empty((2, POSE)), np.empty((2, POSE)), np.empty((2, 3))
    p_W, C, y = np.empty(3), np.empty((3, 3)), np.empty(3)
    for i in range(len(seen)):
        if seen[i, slot]:
            inverse_depth_point(R_WA[i], p_WA[i], abr[i], p_W, C)
            seen[i, slot] = point_reprojection(R, p, R_BC, p_BC, p_W, z[i, slot], v, J_pose, J_rig, J_p)
            for k in range(2):
                total[i, slot, k] = doubt(J_p[k], C, L[i], sigma[i, slot, k], y)


@kernel
def line_doubts(slot, R, p, R_BC, p_BC, seen, z, sigma, form, values, origin, L, total):
    """As point_doubts, for lines."""
    v, J_pose, J_rig, J_l = np.empty(2), np.empty((2, POSE)), np.empty((2, POSE)), np.empty((2, 6))
    n_W, d_W, C, y = np.empty(3), np.empty(3), np.empty((6, 4)), np.empty(4)
    for i in range(len(seen)):
        if seen[i, slot]:
            world_line(form, values[i], origin[i], n_W, d_W, C)
            seen[i, slot] = line_reprojection(R, p, R_BC, p_BC, n_W, d_W, z[i, slot], v, J_pose, J_rig, J_l)
            for k in range(2):
                total[i, slot, k] = doubt(J_l[k], C, L[i], sigma[i, slot, k], y)


@inner
def doubt(J, C, L, sigma, y):
    """Standard deviation of a residual that changes by J C with a landmark of covariance (L L')^-1; y: scratch."""
    square = sigma * sigma
    for j in range(len(L)):
        y[j] = 0.0
        for m in range(len(J)):
            y[j] += J[m] * C[m, j]
        for k in range(j):
            y[j] -= L[j, k] * y[k]
        y[j] /= L[j, j]
        square += y[j] * y[j]
    return np.sqrt(square)
