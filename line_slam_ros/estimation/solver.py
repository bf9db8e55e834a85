"""Levenberg-Marquardt over the window: inertial, point and line factors and the prior, landmarks eliminated by Schur.

Everything per observation is compiled (landmarks.py); the reduced system (15 per state) is solved by LAPACK.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from line_slam_ros.estimation.dense import cholesky, hold, regular, solve
from line_slam_ros.estimation.landmarks import (
    LANES,
    add_gradient,
    add_hessian,
    back_substitute,
    column,
    eliminate,
    gather,
    gradients,
    line_jacobians,
    line_residuals,
    point_jacobians,
    point_residuals,
    retract_landmarks,
    spread,
)
from line_slam_ros.estimation.rest import add_rest, add_rest_gradient, rest_cost
from line_slam_ros.estimation.uprights import upright_hessians, upright_residuals
from line_slam_ros.estimation.window import DELAY, LEAN, POSE, RIG, STATE, Window, state_row
from line_slam_ros.factors.imu_factor import imu_jacobians, imu_residual
from line_slam_ros.geometry.lie_kernels import retract_rotation
from line_slam_ros.kernel_cache import kernel
from line_slam_ros.types import F64, LineForm

TRUSTED = 0.8  # of the predicted change of the cost: a smaller error, and the Jacobians serve for another step
LEAST_DAMPING = 1e-9  # too small to matter
CONVERGED = 0.3  # change of the cost (half squared standard deviations) below which iterating ends: of some 200 numbers
# together, a twentieth of a standard deviation each


@kernel
def link_residuals(first, last, R, p, v, b, dt, dR, dp, dv, J_b, b_lin, W, w_b, g_W, r):
    """Whitened residuals r (slots, 15) of the inertial links first .. last - 1; returns half their squares."""
    cost = 0.0
    for k in range(first, last):
        m = k + 1
        imu_residual(R[k], p[k], v[k], b[k], R[m], p[m], v[m], b[m], dt[k], dR[k], dp[k], dv[k], J_b[k], b_lin[k],
                     W[k], w_b[k], g_W, r[k])
        for i in range(STATE):
            cost += r[k, i] * r[k, i]
    return 0.5 * cost


@kernel
def add_link_hessians(first, last, R, p, v, b, dt, dR, dp, dv, J_b, b_lin, W, w_b, g_W, J, H):
    """Jacobians J (slots, 2, 15, 15), by both states, of the links first .. last - 1, and their squares into H."""
    products = np.empty((STATE, 3, STATE))  # of both states: J_i' J_i, J_i' J_j, J_j' J_j by rows
    for k in range(first, last):
        m = k + 1
        J_i, J_j = J[k, 0], J[k, 1]
        imu_jacobians(R[k], p[k], v[k], b[k], R[m], p[m], v[m], b[m], dt[k], dR[k], dp[k], dv[k], J_b[k], b_lin[k],
                      W[k], w_b[k], g_W, J_i, J_j)
        o, q = state_row(k), state_row(m)
        for i in range(STATE):
            products[i] = 0.0
            for x in range(STATE):
                y, z = J_i[x, i], J_j[x, i]
                for j in range(STATE):
                    products[i, 0, j] += y * J_i[x, j]
                    products[i, 1, j] += y * J_j[x, j]
                    products[i, 2, j] += z * J_j[x, j]
            for j in range(STATE):
                H[o + i, o + j] += products[i, 0, j]
                H[o + i, q + j] += products[i, 1, j]
                H[q + j, o + i] += products[i, 1, j]
                H[q + i, q + j] += products[i, 2, j]


@kernel
def add_link_gradients(first, last, J, r, g):
    """What the residuals r (slots, 15) of the links first .. last - 1 pull at their states, into g."""
    for k in range(first, last):
        for side in range(2):
            o = state_row(k + side)
            for x in range(STATE):
                for i in range(STATE):
                    g[o + i] += J[k, side, x, i] * r[k, x]


@kernel
def retract_states(n, R, p, v, b, dx):
    """Apply the states' rows of a step dx in place."""
    for k in range(n):
        o = state_row(k)
        retract_rotation(R[k], dx[o:o + 3], R[k])
        for i in range(3):
            p[k, i] += dx[o + 3 + i]
            v[k, i] += dx[o + 6 + i]
        for i in range(6):
            b[k, i] += dx[o + 9 + i]


@kernel
def exposures(n, R, p, v, rates, delay, R_exposed, p_exposed, twist):
    """Poses delay (s) after the states' stamps, to first order, and twist (n, 6) = [rates in B, v in W]."""
    turn = np.empty(3)
    for k in range(n):
        for i in range(3):
            turn[i] = rates[k, i] * delay
            p_exposed[k, i] = p[k, i] + v[k, i] * delay
            twist[k, i], twist[k, 3 + i] = rates[k, i], v[k, i]
        retract_rotation(R[k], turn, R_exposed[k])


def retract_rig(R_BC, p_BC, delay, lean, dx):
    """Apply a step dx (9,) to the rig and the lean in place."""
    retract_rotation(R_BC, dx[:3], R_BC)
    p_BC += dx[3:6]
    delay += dx[DELAY]
    lean += dx[LEAN:]


@dataclass(frozen=True, slots=True)
class SolverOptions:
    """Numbers the optimiser needs besides the window."""

    g_W: F64  # (3,) m/s^2
    point_c2: float  # Cauchy scale of points, squared standard deviations
    line_c2: float
    line_form: LineForm = LineForm.ORTHONORMAL
    upright_spread: float = 0.0  # rad, of the directions of upright lines; 0: they are not believed to be upright
    rho0: float = 0.3  # 1/m, where points without parallax are believed to be
    w_rho: float = 0.03  # m, weight of that belief: thousands of points must not add up to a belief in scale


class _Landmarks:
    """Buffers for the landmarks of one kind; see landmarks.py."""

    def __init__(self, rows: int, slots: int, size: int):
        self.size = size
        self.use = np.zeros(0, np.bool_)  # of the rows in use, those that take part
        self.chi2, self.pull, self.weight = np.zeros((rows, slots)), np.zeros((rows, slots, 2)), np.zeros((rows, slots))
        self.at, self.undo = np.full((rows, slots), -1), np.zeros((rows, slots))
        self.by_land = np.zeros((rows, slots, 2, size))
        self.L, self.a, self.step = np.zeros((rows, size, size)), np.zeros((rows, size)), np.zeros((rows, size))
        self.first, self.scale = np.zeros(rows, np.int64), np.ones(rows)  # scale of the noise in L

    def choose(self, use: np.ndarray, row: int) -> int:
        """Let the landmarks of the rows in use (M,) take part, theirs from row on; returns the row behind the last."""
        self.use = use
        self.first[:len(use)] = row + self.size * (np.cumsum(use) - use)
        return row + self.size * int(use.sum())


class Solver:
    """Optimises a Window in place; owns every buffer it needs.

    Jacobians are taken, and the equations factored, once (linearise); residuals and gradient follow every step. Only
    where the cost does not fall as the equations predict they are taken anew.
    """

    def __init__(self, window: Window, options: SolverOptions):
        self.window, self.options = window, options
        size, slots = len(window.prior_g), window.slots
        rows_p, rows_l = len(window.points.ids), len(window.lines.ids)
        self.H, self.g, self._delta, self._dx = np.zeros((size, size)), np.zeros(size), np.zeros(size), np.zeros(size)
        self._R, self._p, self._twist = np.zeros((slots, 3, 3)), np.zeros((slots, 3)), np.zeros((slots, 6))
        self._R0, self._p0 = np.zeros((slots, 3, 3)), np.zeros((slots, 3))
        self._links, self._link_r, self._link_J = (0, 0), np.zeros((slots, STATE)), np.zeros((slots, 2, STATE, STATE))
        self.points, self.lines = _Landmarks(rows_p, slots, 3), _Landmarks(rows_l, slots, 4)
        self._J, self._count = np.zeros((slots, 2 * (rows_p + rows_l), LANES)), np.zeros(slots, np.int64)
        self._S, self._s = np.zeros((3 * rows_p + 4 * rows_l, column(slots))), np.zeros(3 * rows_p + 4 * rows_l)
        self._upright_pull, self._upright_weight = np.zeros((rows_l, 2)), np.zeros(rows_l)
        self._rows = 0  # of S, s in use
        self._columns, self._own = np.zeros(column(slots)), np.zeros((0, LANES, LANES))
        self._factor: F64 | None = None  # upper triangular, of H; empty: it has none; None: not computed yet
        self.linearised_with = 0.0  # damping that H's factor and the landmarks' L hold

    def linearise(self, use_points, use_lines, damping: float = 0.0, links: tuple[int, int] | None = None) -> None:
        """Fill H and g from the chosen landmarks, the prior, links [first, last) and their rests.

        The last state of a range of links is left to the range that starts with it.
        """
        self._links = links or (0, self.window.n - 1)
        self._choose(use_points, use_lines)
        self._evaluate()
        self._take_jacobians(damping)
        self._take_gradient()

    def _choose(self, use_points, use_lines) -> None:
        self._rows = self.lines.choose(use_lines, self.points.choose(use_points, 0))

    def _evaluate(self) -> float:
        """Residuals at the present estimate; returns the robust cost."""
        w = self.window
        d = w.delta(self._delta)
        return (float(d @ (0.5 * (w.prior_H @ d) + w.prior_g)) + rest_cost(w) + self.inertial_cost()
                + self.landmark_cost(self.points.use, w.points.seen, w.points.sigma, self.lines.use, w.lines.seen,
                                     w.lines.sigma)
                + self._upright_cost())

    def _upright_cost(self) -> float:
        """Of the belief in upright lines, after landmark_cost, to whose gradients it adds."""
        q, o, kl = self.window.lines, self.options, self.lines
        if not o.upright_spread:
            return 0.0
        return upright_residuals(kl.use, int(o.line_form), q.values, q.origin, self.window.lean, o.upright_spread,
                                 self._upright_pull, self._upright_weight, kl.a)

    def landmark_cost(self, use_points, points_seen, point_sigma, use_lines, lines_seen, line_sigma) -> float:
        """Robust cost of observations (rows, slots) of the landmarks of rows in use; their chi2, pull and weight."""
        w, o = self.window, self.options
        p, q, kp, kl = w.points, w.lines, self.points, self.lines
        self._expose()
        return (point_residuals(w.n, self._R, self._p, w.R_BC, w.p_BC, use_points, points_seen, p.z, point_sigma,
                                p.abr, p.R_WA, p.p_WA, o.point_c2, o.rho0, o.w_rho, kp.chi2, kp.pull, kp.weight, kp.a)
                + line_residuals(w.n, self._R, self._p, w.R_BC, w.p_BC, use_lines, lines_seen, q.z, line_sigma,
                                 int(o.line_form), q.values, q.origin, o.line_c2, kl.chi2, kl.pull, kl.weight, kl.a))

    def _take_jacobians(self, damping: float) -> None:
        """Jacobians at the first estimates, with the weights of the last evaluation: H, and all that steps need."""
        w, o, n = self.window, self.options, self.window.n
        p, q, kp, kl = w.points, w.lines, self.points, self.lines
        w.unfrozen_to_current()
        self.linearised_with, self._factor = damping, None
        for table, kind in ((p, kp), (q, kl)):
            table.taken[:table.count] = np.where(kind.use, np.arange(table.count), -1)
            kind.scale[:table.count] = table.scale[:table.count]
        self.H[:] = w.prior_H
        add_link_hessians(*self._links, w.R0, w.p0, w.v0, w.b0, w.dt, w.dR, w.dp, w.dv, w.J_b, w.b_lin, w.W, w.w_b,
                          o.g_W, self._link_J, self.H)
        add_rest(w, self._links, self.H)
        exposures(n, w.R0, w.p0, w.v, w.rates, w.delay[0], self._R0, self._p0, self._twist)
        S = self._S[:self._rows, :column(n)]
        S[:], self._count[:] = 0.0, 0
        point_jacobians(n, self._R0, self._p0, w.R_BC, w.p_BC, self._twist, kp.use, p.z, p.sigma, p.abr, p.R_WA, p.p_WA,
                        o.w_rho, kp.weight, self._count, self._J, kp.at, kp.undo, kp.by_land, kp.L, kp.first, self._S)
        line_jacobians(n, self._R0, self._p0, w.R_BC, w.p_BC, self._twist, kl.use, q.z, q.sigma, int(o.line_form),
                       q.values, q.origin, kl.weight, self._count, self._J, kl.at, kl.undo, kl.by_land, kl.L, kl.first,
                       self._S)
        if o.upright_spread:
            upright_hessians(kl.use, int(o.line_form), q.values, q.origin, w.lean, o.upright_spread,
                             self._upright_weight, kl.L, kl.first, self._S, self.H)
        for kind in (kp, kl):
            eliminate(kind.use, kind.size, damping, kind.L, kind.first, column(n), self._S)
        self._own = np.stack([J[:k].T @ J[:k] for J, k in zip(self._J[:n], self._count, strict=False)])
        add_hessian(n, self._own, S.T @ S, self.H)
        if not w.rig_sigma.all():
            hold(self.H, np.flatnonzero(w.rig_sigma == 0.0))

    def _take_gradient(self) -> None:
        """g of the last evaluation, by the Jacobians taken last."""
        w, n = self.window, self.window.n
        self.g[:] = w.prior_g + w.prior_H @ w.delta(self._delta)
        add_link_gradients(*self._links, self._link_J, self._link_r, self.g)
        add_rest_gradient(w, self._links, self.g)
        if self.options.upright_spread:
            self.g[LEAN:RIG] -= self._upright_pull[:len(self.lines.use)].sum(axis=0) / self.options.upright_spread
        own = np.zeros((n, LANES))
        for kind in (self.points, self.lines):
            gradients(n, kind.use, kind.size, kind.pull, kind.at, kind.undo, kind.by_land, kind.L, kind.a, kind.first,
                      self._J, own, self._s)
        add_gradient(n, own, self.g)
        spread(n, -(self._s[:self._rows] @ self._S[:self._rows, :column(n)]), self.g)
        self.g[:RIG][w.rig_sigma == 0.0] = 0.0

    def _expose(self) -> None:
        """Body poses at the times when the images were really taken."""
        w = self.window
        exposures(w.n, w.R, w.p, w.v, w.rates, w.delay[0], self._R, self._p, self._twist)

    def exposed(self) -> tuple[F64, F64]:
        """R_WB (n, 3, 3) and p_WB (n, 3) when the images of the window were taken."""
        self._expose()
        return self._R[:self.window.n], self._p[:self.window.n]

    def cost(self) -> float:
        """Present robust cost; refreshes points.chi2 and lines.chi2 (rows, slots)."""
        w = self.window
        self._choose(w.points.solved[:w.points.count], w.lines.solved[:w.lines.count])
        return self._evaluate()

    def inertial_cost(self) -> float:
        """Half the squared whitened residuals of all inertial links."""
        w = self.window
        return link_residuals(0, w.n - 1, w.R, w.p, w.v, w.b, w.dt, w.dR, w.dp, w.dv, w.J_b, w.b_lin, w.W, w.w_b,
                              self.options.g_W, self._link_r)

    def optimise(self, iterations: int) -> float:
        """Up to that many steps; returns the final cost."""
        self._links = 0, self.window.n - 1
        cost, damping, trusted = self.cost(), LEAST_DAMPING, False
        for _ in range(iterations):
            fresh = not trusted
            if fresh:
                self._take_jacobians(damping)
            self._take_gradient()
            before = self._save()
            predicted = self._step()
            new_cost = self._evaluate() if np.isfinite(predicted) else np.inf
            gain, damped = cost - new_cost, self.linearised_with > LEAST_DAMPING  # what is damped may still be far off
            trusted = abs(gain - predicted) < TRUSTED * predicted
            if gain > 0.0:
                cost, damping = new_cost, max(0.1 * damping, LEAST_DAMPING)
            else:
                self._restore(before)
                self._evaluate()
                damping = min(max(10.0 * damping, 1e-4), 1e4) if fresh else damping
            if min(abs(gain), predicted) < CONVERGED and not damped:
                break
        return cost

    def unsettled(self) -> float:
        """By how much the cost should fall by the equations linearised last; infinity if they have no solution.

        Leaves the step of rig and states that they ask for in dx.
        """
        factor, rows = self._factored(), self.window.rows
        if not len(factor):
            return np.inf
        s, g, dx = self._s[:self._rows], self.g[:rows], self._dx[:rows]
        dx[:] = solve(factor, -g)
        return 0.5 * float(s @ s - g @ dx)

    def _factored(self) -> F64:
        """Of the equations; empty when they have no solution."""
        if self._factor is None:
            rows = self.window.rows
            self._factor = cholesky(self.H[:rows, :rows], self.linearised_with)
        return self._factor

    def _step(self) -> float:
        """Solve the equations and move everything, if they have a solution; returns what unsettled does."""
        predicted = self.unsettled()
        if not np.isfinite(predicted):
            return predicted
        w, dx, n = self.window, self._dx, self.window.n
        s, S = self._s[:self._rows], self._S[:self._rows, :column(n)]
        columns = self._columns[:column(n)]
        gather(n, dx, columns)
        t = s + S @ columns
        for kind in (self.points, self.lines):
            back_substitute(kind.use, kind.size, kind.L, kind.first, t, kind.step)
        retract_states(n, w.R, w.p, w.v, w.b, dx)
        retract_rig(w.R_BC, w.p_BC, w.delay, w.lean, dx[:RIG])
        retract_landmarks(self.points.use, w.points.abr, self.points.step, self.lines.use, int(self.options.line_form),
                          w.lines.values, self.lines.step)
        return predicted

    def _save(self) -> list[np.ndarray]:
        w = self.window
        return [a[:k].copy() for a, k in self._variables(w)]

    def _restore(self, saved: list[np.ndarray]) -> None:
        for (a, k), s in zip(self._variables(self.window), saved, strict=True):
            a[:k] = s

    @staticmethod
    def _variables(w: Window) -> list[tuple[np.ndarray, int]]:
        n, p, q = w.n, w.points.count, w.lines.count
        return [(w.R, n), (w.p, n), (w.v, n), (w.b, n), (w.R_BC, 3), (w.p_BC, 3), (w.delay, 1), (w.lean, 2),
                (w.points.abr, p), (w.lines.values, q)]

    def covariance(self, slot: int) -> F64:
        """(15, 15) of a state given everything in the window, by the equations linearised last.

        LinAlgError when these have no solution.
        """
        return _covariance(regular(self._factored()), slot)

    def owed_to_landmarks(self, slot: int) -> F64:
        """(15, 15) of a state's covariance: what would be gone of it were the landmarks known. As for covariance."""
        return self.covariance(slot) - _covariance(self._given_landmarks(self.window.n - 1), slot)

    def information(self, slot: int) -> F64:
        """(15, 15) about a state, given the landmarks, from all that comes before it and what it sees itself.

        By the Jacobians taken last; LinAlgError when the equations have no solution.
        """
        latest = self._given_landmarks(slot)[-STATE:, -STATE:]
        return latest.T @ latest

    def _given_landmarks(self, last: int) -> F64:
        """Factor of the equations of rig and states up to a last one, were the landmarks known.

        The rest of a state before the newest is left out, as in linearise.
        """
        w, o, links, rows = self.window, self.options, (0, last), state_row(last + 1)
        H = w.prior_H.copy()
        add_link_hessians(*links, w.R0, w.p0, w.v0, w.b0, w.dt, w.dR, w.dp, w.dv, w.J_b, w.b_lin, w.W, w.w_b, o.g_W,
                          self._link_J, H)
        add_rest(w, links, H)
        if o.upright_spread:
            H[LEAN:RIG, LEAN:RIG] += np.eye(2) * self._upright_weight[:len(self.lines.use)].sum() / o.upright_spread**2
        add_hessian(last + 1, self._own, np.zeros((column(last + 1), column(last + 1))), H)
        hold(H, np.flatnonzero(w.rig_sigma == 0.0))
        return regular(cholesky(H[:rows, :rows]))

    def line_covariances(self, lines: np.ndarray) -> F64:
        """(L, 4, 4) of lines (rows when Jacobians were taken last) in their tangent, as the newest camera knows them.

        A^-1 + (A^-1 W) C (A^-1 W)' with W the ties to rig and poses and C the covariance of these, given the newest
        pose: where that pose is in the world is not the line's doubt, how the others stood to it is. Where a line has
        less noise than was given, A^-1 is that of the given noise: from how its views scatter nobody learns in what
        all of them are wrong.
        """
        n, rows = self.window.n, self.window.rows
        H = self.H[:rows, :rows].copy()
        hold(H, np.arange(state_row(n - 1), state_row(n - 1) + POSE))
        seen = np.concatenate([np.arange(RIG), *(np.arange(state_row(k), state_row(k) + POSE) for k in range(n - 1))])
        ties = np.zeros((rows, len(seen)))
        ties[seen, np.arange(len(seen))] = 1.0
        C = solve(regular(cholesky(H)), ties)[seen]
        held = np.flatnonzero(self.window.rig_sigma == 0.0)
        C[held, held] = 0.0
        S = self._S[self.lines.first[lines, None] + np.arange(4), :len(seen)]
        inverse = np.linalg.inv(self.lines.L[lines]).transpose(0, 2, 1)
        AW = inverse @ S
        own = inverse @ inverse.transpose(0, 2, 1) / np.minimum(self.lines.scale[lines], 1.0)[:, None, None]**2
        return own + AW @ C @ AW.transpose(0, 2, 1)


def _covariance(factor: F64, slot: int) -> F64:
    """(15, 15) of a state by the factor of equations of rig and states."""
    latest = np.linalg.inv(factor[state_row(slot):, state_row(slot):])[:STATE]
    return latest @ latest.T
