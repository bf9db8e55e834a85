"""Levenberg-Marquardt over the window: inertial, point and line factors and the prior, landmarks eliminated by Schur.

Everything per observation is compiled (landmarks.py); the reduced system (15 per state) is solved by LAPACK.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from line_slam_ros.estimation.landmarks import (
    add_lines,
    add_points,
    back_substitute,
    line_cost,
    mirror,
    point_cost,
    retract_landmarks,
)
from line_slam_ros.estimation.window import RIG, STATE, Window
from line_slam_ros.factors.imu_factor import imu_jacobians, imu_residual
from line_slam_ros.geometry.lie_kernels import retract_rotation
from line_slam_ros.types import F64, LineForm

CONVERGED = 1.0  # change of the cost (half squared standard deviations) below which iterating ends


@njit(cache=True, nogil=True, error_model='numpy')
def add_links(first, last, R, p, v, b, R0, p0, v0, b0, dt, dR, dp, dv, J_b, b_lin, W, w_b, g_W, H, g):
    """Inertial factors of links first .. last - 1 into (H, g); residuals at present, Jacobians at first estimates."""
    r, J_i, J_j = np.empty(15), np.empty((15, 15)), np.empty((15, 15))
    for k in range(first, last):
        m = k + 1
        imu_residual(R[k], p[k], v[k], b[k], R[m], p[m], v[m], b[m], dt[k], dR[k], dp[k], dv[k], J_b[k], b_lin[k],
                     W[k], w_b[k], g_W, r)
        imu_jacobians(R0[k], p0[k], v0[k], b0[k], R0[m], p0[m], v0[m], b0[m], dt[k], dR[k], dp[k], dv[k], J_b[k],
                      b_lin[k], W[k], w_b[k], g_W, J_i, J_j)
        o, q = STATE * k, STATE * m
        for i in range(15):
            for j in range(15):
                ii, ij, jj = 0.0, 0.0, 0.0
                for x in range(15):
                    ii += J_i[x, i] * J_i[x, j]
                    ij += J_i[x, i] * J_j[x, j]
                    jj += J_j[x, i] * J_j[x, j]
                H[o + i, o + j] += ii
                H[o + i, q + j] += ij
                H[q + j, o + i] += ij
                H[q + i, q + j] += jj
            for x in range(15):
                g[o + i] += J_i[x, i] * r[x]
                g[q + i] += J_j[x, i] * r[x]


@njit(cache=True, nogil=True, error_model='numpy')
def link_cost(n, R, p, v, b, dt, dR, dp, dv, J_b, b_lin, W, w_b, g_W):
    """Half the squared whitened inertial residuals of all links."""
    r, cost = np.empty(15), 0.0
    for k in range(n - 1):
        m = k + 1
        imu_residual(R[k], p[k], v[k], b[k], R[m], p[m], v[m], b[m], dt[k], dR[k], dp[k], dv[k], J_b[k], b_lin[k],
                     W[k], w_b[k], g_W, r)
        for i in range(15):
            cost += r[i] * r[i]
    return 0.5 * cost


@njit(cache=True, nogil=True, error_model='numpy')
def retract_states(n, R, p, v, b, dx):
    """Apply a step dx (15 n,) in place."""
    for k in range(n):
        o = STATE * k
        retract_rotation(R[k], dx[o:o + 3], R[k])
        for i in range(3):
            p[k, i] += dx[o + 3 + i]
            v[k, i] += dx[o + 6 + i]
        for i in range(6):
            b[k, i] += dx[o + 9 + i]


@njit(cache=True, nogil=True, error_model='numpy')
def exposures(n, R, p, v, rates, delay, R_exposed, p_exposed, twist):
    """Poses delay (s) after the states' stamps, to first order, and twist (n, 6) = [rates in B, v in W]."""
    turn = np.empty(3)
    for k in range(n):
        for i in range(3):
            turn[i] = rates[k, i] * delay
            p_exposed[k, i] = p[k, i] + v[k, i] * delay
            twist[k, i], twist[k, 3 + i] = rates[k, i], v[k, i]
        retract_rotation(R[k], turn, R_exposed[k])


@njit(cache=True, nogil=True, error_model='numpy')
def retract_rig(R_BC, p_BC, delay, dx):
    """Apply a step dx (7,) to the rig in place."""
    retract_rotation(R_BC, dx[:3], R_BC)
    for i in range(3):
        p_BC[i] += dx[3 + i]
    delay[0] += dx[6]


@dataclass(frozen=True, slots=True)
class SolverOptions:
    """Numbers the optimiser needs besides the window."""

    g_W: F64  # (3,) m/s^2
    point_c2: float  # Cauchy scale of points, squared standard deviations
    line_c2: float
    line_form: LineForm = LineForm.ORTHONORMAL
    rho0: float = 0.3  # 1/m, where points without parallax are believed to be
    w_rho: float = 0.03  # m, weight of that belief: thousands of points must not add up to a belief in scale
    still_speed: float = 0.01  # m/s, how still a body at rest is
    still_shift: float = 1e-3  # m, and how far it may move between two states at rest


class Solver:
    """Optimises a Window in place; owns every buffer it needs."""

    def __init__(self, window: Window, options: SolverOptions):
        self.window, self.options = window, options
        size, rows_p, rows_l, slots = len(window.prior_g), len(window.points.ids), len(window.lines.ids), window.slots
        self.H, self.g, self._delta, self._dx = np.zeros((size, size)), np.zeros(size), np.zeros(size), np.zeros(size)
        self._R, self._p, self._twist = np.zeros((slots, 3, 3)), np.zeros((slots, 3)), np.zeros((slots, 6))
        self._R0, self._p0 = np.zeros((slots, 3, 3)), np.zeros((slots, 3))
        self._E_p, self._E_l = np.zeros((rows_p, slots, 3, 6)), np.zeros((rows_l, slots, 4, 6))
        self._B_p, self._B_l = np.zeros((rows_p, 3, RIG)), np.zeros((rows_l, 4, RIG))
        self._A_p, self._A_l = np.zeros((rows_p, 3, 3)), np.zeros((rows_l, 4, 4))
        self._a_p, self._a_l = np.zeros((rows_p, 3)), np.zeros((rows_l, 4))
        self._step_p, self._step_l = np.zeros((rows_p, 3)), np.zeros((rows_l, 4))
        self.chi2_points, self.chi2_lines = np.zeros((rows_p, slots)), np.zeros((rows_l, slots))
        self._damping, self.linearised_with = 1e-6, 0.0  # linearised_with: damping that H and the landmarks' A hold

    def linearise(self, use_points, use_lines, damping: float = 0.0, links: tuple[int, int] | None = None) -> None:
        """Fill H (15 n, 15 n) and g from the chosen landmarks, the prior, links [first, last) and their rests.

        The last state of a range of links is left to the range that starts with it.
        """
        w, o, n = self.window, self.options, self.window.n
        w.unfrozen_to_current()
        self.H[:] = w.prior_H
        self.g[:] = w.prior_g + w.prior_H @ w.delta(self._delta)
        first, last = links or (0, n - 1)
        add_links(first, last, w.R, w.p, w.v, w.b, w.R0, w.p0, w.v0, w.b0, w.dt, w.dR, w.dp, w.dv, w.J_b, w.b_lin,
                  w.W, w.w_b, o.g_W, self.H, self.g)
        self._add_rest(first, last, n if links is None else last)
        self.linearised_with = damping
        self._expose()
        exposures(n, w.R0, w.p0, w.v, w.rates, w.delay[0], self._R0, self._p0, self._twist)
        t, rig = w.points, self._rig()
        add_points(n, self._R, self._p, self._R0, self._p0, w.R_BC, w.p_BC, self._twist, rig, use_points, t.seen, t.z,
                   t.sigma, t.abr, t.R_WA, t.p_WA, o.point_c2, o.rho0, o.w_rho, damping, self.H, self.g, self._E_p,
                   self._B_p, self._A_p, self._a_p)
        t = w.lines
        add_lines(n, self._R, self._p, self._R0, self._p0, w.R_BC, w.p_BC, self._twist, rig, use_lines, t.seen, t.z,
                  t.sigma, int(o.line_form), t.values, t.origin, o.line_c2, damping, self.H, self.g, self._E_l,
                  self._B_l, self._A_l, self._a_l)
        mirror(n, rig, self.H)

    def _rig(self) -> int:
        """First row of the rig, -1 when it is not estimated."""
        return STATE * self.window.slots if self.window.rig_sigma.any() else -1

    def _expose(self) -> None:
        """Body poses at the times when the images were really taken."""
        w = self.window
        exposures(w.n, w.R, w.p, w.v, w.rates, w.delay[0], self._R, self._p, self._twist)

    def exposed(self) -> tuple[F64, F64]:
        """R_WB (n, 3, 3) and p_WB (n, 3) when the images of the window were taken."""
        self._expose()
        return self._R[:self.window.n], self._p[:self.window.n]

    def _add_rest(self, first: int, last: int, end: int) -> None:
        """States [first, end) at rest have no velocity; links [first, last) between two of them have no length."""
        w, o, one = self.window, self.options, np.eye(3)
        for k in first + np.flatnonzero(w.still[first:end]):
            v = slice(STATE * k + 6, STATE * k + 9)
            self.H[v, v] += one / o.still_speed**2
            self.g[v] += w.v[k] / o.still_speed**2
        for k in first + np.flatnonzero(w.still[first:last] & w.still[first + 1:last + 1]):
            a, b = slice(STATE * k + 3, STATE * k + 6), slice(STATE * k + 18, STATE * k + 21)
            shift = (w.p[k + 1] - w.p[k]) / o.still_shift**2
            self.H[a, a] += one / o.still_shift**2
            self.H[b, b] += one / o.still_shift**2
            self.H[a, b] -= one / o.still_shift**2
            self.H[b, a] -= one / o.still_shift**2
            self.g[a] -= shift
            self.g[b] += shift

    def _rest_cost(self) -> float:
        w, o, n = self.window, self.options, self.window.n
        both = w.still[:n - 1] & w.still[1:n]
        return 0.5 * float(np.sum((w.v[:n][w.still[:n]] / o.still_speed) ** 2)
                           + np.sum((np.diff(w.p[:n], axis=0)[both] / o.still_shift) ** 2))

    def cost(self) -> float:
        """Present robust cost; refreshes chi2_points and chi2_lines (rows, slots)."""
        w, o, n = self.window, self.options, self.window.n
        p, q = w.points, w.lines
        d = w.delta(self._delta)
        prior = d @ (0.5 * (w.prior_H @ d) + w.prior_g)
        self._expose()
        return (prior + self._rest_cost() + self.inertial_cost()
                + point_cost(n, self._R, self._p, w.R_BC, w.p_BC, p.solved[:p.count], p.seen, p.z, p.sigma, p.abr,
                             p.R_WA, p.p_WA, o.point_c2, o.rho0, o.w_rho, self.chi2_points)
                + line_cost(n, self._R, self._p, w.R_BC, w.p_BC, q.solved[:q.count], q.seen, q.z, q.sigma,
                            int(o.line_form), q.values, q.origin, o.line_c2, self.chi2_lines))

    def inertial_cost(self) -> float:
        """Half the squared whitened residuals of all inertial links."""
        w = self.window
        return link_cost(w.n, w.R, w.p, w.v, w.b, w.dt, w.dR, w.dp, w.dv, w.J_b, w.b_lin, w.W, w.w_b, self.options.g_W)

    def optimise(self, iterations: int) -> float:
        """Up to that many steps; returns the final cost."""
        w = self.window
        use_p, use_l = w.points.solved[:w.points.count], w.lines.solved[:w.lines.count]
        cost = self.cost()
        for _ in range(iterations):
            self.linearise(use_p, use_l, self._damping)
            before = self._save()
            if not self._step(use_p, use_l):
                self._damping = min(max(10.0 * self._damping, 1e-4), 1e4)
                continue
            new_cost = self.cost()
            gain = cost - new_cost
            if gain > 0.0:
                self._damping, cost = max(0.1 * self._damping, 1e-9), new_cost
            else:
                self._restore(before)
                self._damping = min(max(10.0 * self._damping, 1e-4), 1e4)
            if abs(gain) < CONVERGED:
                break
        return self.cost()

    def _step(self, use_p, use_l) -> bool:
        w, rows, dx = self.window, self.window.rows(), self._dx
        H = self.H[np.ix_(rows, rows)]
        H[np.arange(len(rows)), np.arange(len(rows))] *= 1.0 + self._damping
        dx[:] = 0.0
        try:
            dx[rows] = -cho_solve(cho_factor(H, lower=True, check_finite=False), self.g[rows], check_finite=False)
        except LinAlgError:
            return False
        rig, p, q = self._rig(), w.points, w.lines
        back_substitute(w.n, use_p, p.seen, 3, rig, self._E_p, self._B_p, self._A_p, self._a_p, dx, self._step_p)
        back_substitute(w.n, use_l, q.seen, 4, rig, self._E_l, self._B_l, self._A_l, self._a_l, dx, self._step_l)
        retract_states(w.n, w.R, w.p, w.v, w.b, dx)
        retract_rig(w.R_BC, w.p_BC, w.delay, dx[STATE * w.slots:])
        retract_landmarks(use_p, w.points.abr, self._step_p, use_l, int(self.options.line_form),
                          w.lines.values, self._step_l)
        return True

    def _save(self) -> list[np.ndarray]:
        w = self.window
        return [a[:k].copy() for a, k in self._variables(w)]

    def _restore(self, saved: list[np.ndarray]) -> None:
        for (a, k), s in zip(self._variables(self.window), saved, strict=True):
            a[:k] = s

    @staticmethod
    def _variables(w: Window) -> list[tuple[np.ndarray, int]]:
        n, p, q = w.n, w.points.count, w.lines.count
        return [(w.R, n), (w.p, n), (w.v, n), (w.b, n), (w.R_BC, 3), (w.p_BC, 3), (w.delay, 1), (w.points.abr, p),
                (w.lines.values, q)]

    def _information(self, rows: np.ndarray) -> tuple[F64, bool]:
        """Cholesky factor of those rows of H, for cho_solve; what nothing says anything about is held by a trace."""
        return cho_factor(self.H[np.ix_(rows, rows)] + 1e-9 * np.eye(len(rows)), lower=True, check_finite=False)

    def covariance(self, slot: int) -> F64:
        """(15, 15) of one state given everything in the window; needs a fresh linearise."""
        rows, o = self.window.rows(), STATE * slot
        rhs = np.zeros((len(rows), STATE))
        rhs[o:o + STATE] = np.eye(STATE)
        return cho_solve(self._information(rows), rhs, check_finite=False)[o:o + STATE]

    def line_covariances(self, lines: np.ndarray) -> F64:
        """(L, 4, 4) of the lines in those rows, in their tangent, as the newest camera knows them; after a linearise.

        A^-1 + (A^-1 W) S (A^-1 W)' with W = [E B] the ties to poses and rig and S the covariance of these, given the
        newest pose: where that pose is in the world is not the line's doubt, how the others stood to it is.
        """
        w, A = self.window, self._A_l[lines]
        newest = STATE * (w.n - 1)
        rows = np.setdiff1d(w.rows(), np.arange(newest, newest + 6))
        tied = rows[(rows >= STATE * w.slots) | ((rows % STATE < 6) & (rows < newest))]
        W = np.zeros((len(lines), 4, len(self.g)))
        for slot in range(w.n):
            W[:, :, STATE * slot:STATE * slot + 6] = self._E_l[lines, slot] * w.lines.seen[lines, slot, None, None]
        W[:, :, STATE * w.slots:] = self._B_l[lines]
        ties = np.zeros((len(rows), len(tied)))
        ties[np.searchsorted(rows, tied), np.arange(len(tied))] = 1.0
        S = cho_solve(self._information(rows), ties, check_finite=False)[np.searchsorted(rows, tied)]
        AW = A @ W[:, :, tied]
        return A + AW @ S @ AW.transpose(0, 2, 1)
