"""The sliding window's life: insert, triangulate, optimise, cull, choose keyframes, marginalise, notice failure."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from line_slam_ros.config import Estimator as Options
from line_slam_ros.estimation.following import Follower
from line_slam_ros.estimation.initialisation import Snapshot, Start
from line_slam_ros.estimation.marginalisation import drop_state, marginalise_oldest
from line_slam_ros.estimation.neighbours import Neighbours
from line_slam_ros.estimation.shift import FEW_CORNERS, corner_shifts, segment_shifts
from line_slam_ros.estimation.solver import CONVERGED, LEAST_DAMPING, Solver, SolverOptions
from line_slam_ros.estimation.triangulation import lines_in_cameras, start_lines, start_points
from line_slam_ros.estimation.window import DELAY, RIG, LandmarkTable, Window, state_row
from line_slam_ros.geometry.lie import rigid
from line_slam_ros.geometry.line_forms import unit_world_lines
from line_slam_ros.types import F64, I64, Calibration, LineForm, Observations, RigCorrection, Samples

MAX_GYRO_BIAS, MAX_ACCEL_BIAS, MAX_SPEED = 0.5, 2.5, 50.0  # rad/s, m/s^2, m/s: beyond, the estimate is nonsense
MIN_FOLLOWED = 20  # known landmarks that a state must see to be estimated against them alone
FEW_KNOWN = 0.25  # share of the corners just followed below which the window lost touch
MIN_FEATURES = 6  # fewer that an earlier state saw, too, and the camera is blind


@dataclass(frozen=True, slots=True)
class WindowLines:
    """The window's lines as the map wants them."""

    ids: I64  # (L,)
    pluecker: F64  # (L, 6) [n, d] in W, |d| = 1
    cov: F64  # (L, 6, 6)
    views: I64  # (L,)
    seen: np.ndarray  # (L, n) bool, by which states
    ends: F64  # (L, n, 2, 2) where they saw them, normalised
    T_WC: F64  # (n, 4, 4) camera poses of the states


class Estimator:
    """Owns the window. Slam feeds it frames; it never sees an image."""

    def __init__(self, options: Options, calibration: Calibration, focal_px: float, max_points: int, max_lines: int):
        self.options, self.focal = options, focal_px
        # two views of every row that the newest state does not see, so half the tracks of a state; the newest's and
        # the last one's may be new
        rows = (options.window + 4) / 2
        self.window = Window(options.window + 1, calibration.imu_noise, int(rows * max_points), int(rows * max_lines))
        self.g_W = np.array([0.0, 0.0, -options.gravity])
        self.window.set_rig(calibration.T_BC[:3, :3], calibration.T_BC[:3, 3], np.concatenate([
            np.full(3, np.radians(options.extrinsic_sigma_deg)), np.full(3, options.extrinsic_sigma_m),
            [options.time_offset_sigma_s], np.full(2, np.radians(options.lean_sigma_deg))]))
        self.solver = Solver(self.window, SolverOptions(
            self.g_W, options.loss_scale**2, options.loss_scale**2,
            LineForm.of(options.line_representation), float(np.radians(options.upright_spread_deg))))
        self.newest_is_keyframe, self._followed = True, False
        self._follower, self._neighbours = Follower(self.solver), Neighbours(self.solver, options.gate_chi2)
        self.failure = ''
        self._last_sight_ns = 0
        self._marginalised = False  # until then the prior is only the gauge, and nothing is bound to first estimates

    # -- start ---------------------------------------------------------------------------------------------------

    def begin(self, start: Start, shots: list[Snapshot], still: bool) -> None:
        """Fill the window with initial states; the first one's position and heading become the gauge."""
        w = self.window
        w.clear()
        self._follower.clear()
        self._neighbours.clear()
        bias = np.concatenate([start.gyro_bias, np.zeros(3)])
        for k, shot in enumerate(shots):
            w.append(shot.t_ns, start.R_WB[k], start.p_W[k], start.v_W[k], bias, shot.samples)
            w.still[k] = still
            self._register(k, shot.observations)
            self._forget_ended()
        o = self.options
        sigma = np.concatenate([[0.3, 0.3, 1e-4], np.full(3, 1e-4), np.full(3, 10.0),
                                np.full(3, o.gyro_bias_sigma), np.full(3, o.accel_bias_sigma)])
        self._last_sight_ns = shots[-1].t_ns
        information = np.diag(sigma**-2.0)
        R = w.R[0]  # rotation sigma is about the world axes: heading fixed, tilt free
        information[:3, :3] = R.T @ information[:3, :3] @ R
        w.freeze(np.arange(1))
        w.prior_H[state_row(0):state_row(1), state_row(0):state_row(1)] = information
        self.newest_is_keyframe, self._followed, self._marginalised = True, False, False
        self._triangulate()

    def refine(self, rounds: int) -> float:
        """Optimise a freshly filled window, relinearising everything between rounds, at most so many, until the cost
        settles. Returns the final cost."""
        w, cost = self.window, np.inf
        for _ in range(rounds):
            before, cost = cost, self.solver.optimise(10)
            w.recentre_prior()
            for k in range(w.n - 1):
                w.integrate(k)
            if abs(before - cost) < CONVERGED:
                break
        return self.solver.cost()

    def linearise(self) -> None:
        """Fresh normal equations at the present estimate, for covariances."""
        w = self.window
        self.solver.linearise(w.points.solved[:w.points.count], w.lines.solved[:w.lines.count])

    # -- what it knows --------------------------------------------------------------------------------------------

    def gyro_bias(self) -> F64:
        """(3,) rad/s; zero before the start."""
        return self.window.b[self.window.n - 1, :3] if self.window.n else np.zeros(3)

    def rig(self) -> RigCorrection:
        """How far the refined calibration is from the given one."""
        w = self.window
        rig = w.delta(np.empty(len(w.prior_g)))[:RIG]
        return RigCorrection(float(np.degrees(np.linalg.norm(rig[:3]))), float(np.linalg.norm(rig[3:6])),
                             float(rig[DELAY]))

    def covariance(self) -> F64:
        """(9, 9) of the newest state's [rotation in B, position in W, velocity in W]."""
        if self._followed:
            return self._follower.covariance()[:9, :9]
        self._undamp()
        return self.solver.covariance(self.window.n - 1)[:9, :9]

    def _undamp(self) -> None:
        """Covariances are by the equations of the last step; by fresh ones if those are damped, which is no knowledge,
        or do not know the newest state."""
        if self._followed or self.solver.linearised_with > LEAST_DAMPING:
            self.linearise()

    def last_good(self) -> tuple[F64, F64] | None:
        """Position (3,) and rotation R_WB (3, 3) of the newest finite state, None when there is none."""
        w = self.window
        for k in range(w.n - 1, -1, -1):
            if np.isfinite(w.p[k]).all() and np.linalg.norm(w.v[k]) < MAX_SPEED:
                return w.p[k].copy(), w.R[k].copy()
        return None

    def points(self) -> F64:
        """Solved points (N, 3) in W."""
        t = self.window.points
        c = np.flatnonzero(t.solved[:t.count])
        rays = np.c_[t.abr[c, :2], np.ones(len(c))] / t.abr[c, 2:]
        return np.einsum('nij,nj->ni', t.R_WA[c], rays) + t.p_WA[c]

    def lines(self) -> WindowLines:
        """The lines that took part in the last step, with their covariance, the newest pose held fixed."""
        self._undamp()
        w, t, n = self.window, self.window.lines, self.window.n
        rows = np.flatnonzero(t.solved[:t.count] & (t.taken[:t.count] >= 0))
        pluecker, J = unit_world_lines(int(self.solver.options.line_form), t.values[rows], t.origin[rows])
        cov = J @ self.solver.line_covariances(t.taken[rows]) @ J.transpose(0, 2, 1)
        R_WB, p_WB = self.solver.exposed()
        T_WC = rigid(R_WB @ w.R_BC, p_WB + R_WB @ w.p_BC)
        return WindowLines(t.ids[rows], pluecker, cov, t.views[rows] + t.seen[rows, :n].sum(axis=1),
                           t.seen[rows, :n], t.z[rows, :n], T_WC)

    # -- every frame ---------------------------------------------------------------------------------------------

    def step(self, observations: Observations, samples: Samples, still: bool) -> tuple[I64, I64]:
        """Take one frame in; returns the ids of points and lines found to be outliers."""
        w = self.window
        newest = self._predict(observations.t_ns, samples)
        w.still[newest] = still
        self._register(newest, observations)
        just_followed = int(w.points.seen[:w.points.count, newest - 1:newest + 1].all(axis=1).sum())
        if not self.newest_is_keyframe and not self._borders_rest(newest - 1):
            drop_state(self.solver, newest - 1)
        self._forget_ended()
        self.newest_is_keyframe = self._is_keyframe(just_followed)
        self._followed = self._may_follow() and self._follower.follow(self.options.max_iterations)
        if not self._followed:
            self._optimise()
        kinds = (w.points, self.solver.points), (w.lines, self.solver.lines)
        wrong = [self._reject(table, kind.chi2) for table, kind in kinds]
        if not (self._followed or still):  # residuals at rest repeat each other
            for table, kind in kinds:
                table.learn_noise(w.n, kind.pull, kind.weight, kind.size)
        outliers = self._cull(*wrong)
        self._neighbours.add(observations, self.newest_is_keyframe)
        self.failure = self._health()
        return outliers

    def _may_follow(self) -> bool:
        """Whether to leave the window as it is: between keyframes, if the newest state sees enough that it knows."""
        if self.newest_is_keyframe or not (self._marginalised and self._follower.anchored):
            return False
        k = self.window.n - 1
        seen = [(t.seen[:t.count, k], t.solved[:t.count]) for t in (self.window.points, self.window.lines)]
        known = sum(int((now & solved).sum()) for now, solved in seen)
        return known >= max(0.5 * sum(int(now.sum()) for now, _ in seen), MIN_FOLLOWED)

    def _optimise(self) -> None:
        """The whole window."""
        self._triangulate()
        if not self._marginalised:
            self.window.recentre_prior()
        self.solver.optimise(self.options.max_iterations)
        if self._marginalised:
            self._undamp()
            self._follower.anchor(self.window.n - (1 if self.newest_is_keyframe else 2))

    def _borders_rest(self, slot: int) -> bool:
        """Whether a state is the first or last of a rest: those stay, and the links in between hold rest alone."""
        still = self.window.still
        return bool(still[slot] and not (still[slot - 1] and still[slot + 1]))

    def marginalise(self) -> None:
        """Make room for the next frame once the window is full."""
        w = self.window
        if w.n < w.slots - 1 or (w.n < w.slots and not self.newest_is_keyframe):
            return
        self._marginalised = True
        p, q, newest = w.points, w.lines, w.n - 1
        q.views[:q.count] += q.seen[:q.count, 0]
        marginalise_oldest(self.solver, self._leaving(p, newest), self._leaving(q, newest))
        self._forget_ended()

    @staticmethod
    def _leaving(table, newest: int) -> np.ndarray:
        """Solved landmarks that slot 0 saw and the newest does not: they end with slot 0."""
        c = table.count
        return table.solved[:c] & table.seen[:c, 0] & ~table.seen[:c, newest] & (table.seen[:c].sum(axis=1) >= 2)

    def _predict(self, t_ns: int, samples: Samples) -> int:
        w, k = self.window, self.window.n - 1
        newest = w.append(t_ns, w.R[k], w.p[k], w.v[k], w.b[k], samples)
        dt = w.dt[k]
        w.p[newest] = w.p[k] + w.v[k] * dt + 0.5 * self.g_W * dt**2 + w.R[k] @ w.dp[k]
        w.v[newest] = w.v[k] + self.g_W * dt + w.R[k] @ w.dv[k]
        w.R[newest] = w.R[k] @ w.dR[k]
        return newest

    def _register(self, slot: int, seen: Observations) -> None:
        sigma = np.full((len(seen.points.ids), 2), self.options.point_sigma_px / self.focal)
        self.window.points.observe(slot, seen.points.ids, seen.points.x, sigma)
        self.window.lines.observe(slot, seen.lines.ids, seen.lines.ends, seen.lines.sigma)

    def _triangulate(self) -> None:
        w, o, n = self.window, self.solver.options, self.window.n
        p, q = w.points, w.lines
        R, position = self.solver.exposed()
        start_points(n, R, position, w.R_BC, w.p_BC, ~p.solved[:p.count], p.seen, p.z, p.sigma, p.abr, p.R_WA,
                     p.p_WA, o.rho0, o.w_rho, p.solved)
        todo = ~q.solved[:q.count] & (q.seen[:q.count].sum(axis=1) >= self.options.line_min_views)
        min_sine = np.sin(np.radians(self.options.line_min_parallax_deg))
        start_lines(n, R, position, w.R_BC, w.p_BC, todo, q.seen, q.z, q.sigma, min_sine,
                    int(o.line_form), q.values, q.origin, q.solved)

    def _reject(self, table: LandmarkTable, chi2: F64) -> np.ndarray:
        """Take from landmarks the views that fail the chi-square gate; which (rows, n) that are."""
        seen, n = table.seen[:table.count], self.window.n
        expected = np.minimum(table.scale[:table.count], 1.0)[:, None]  # what is more exact than given may err as given
        wrong = table.solved[:table.count, None] & (expected**2 * chi2[:table.count] > self.options.gate_chi2)
        wrong = seen[:, :n] & wrong[:, :n]
        seen[:, :n] &= ~wrong
        return wrong

    def _cull(self, wrong_points: np.ndarray, wrong_lines: np.ndarray) -> tuple[I64, I64]:
        """Landmarks whose newest view (rows, n) was wrong, or most views, go for good, and so do lines that fell into
        a camera that sees them. Returns their ids."""
        w, n, gone = self.window, self.window.n, []
        for table, wrong in ((w.points, wrong_points), (w.lines, wrong_lines)):
            views = table.seen[:table.count, :n].sum(axis=1)
            dead = wrong.any(axis=1) & ((views < 2) | (wrong.sum(axis=1) > views) | wrong[:, n - 1])
            gone.append(table.ids[:table.count][dead].copy())
            table.keep(~dead)
        R, position = self.solver.exposed()
        q, inside = w.lines, np.zeros(w.lines.count, np.bool_)
        lines_in_cameras(n, R, position, w.R_BC, w.p_BC, q.solved[:q.count], q.seen, int(self.solver.options.line_form),
                         q.values, q.origin, inside)
        gone[1] = np.concatenate([gone[1], q.ids[:q.count][inside]])
        q.keep(~inside)
        return gone[0], gone[1]

    def _forget_ended(self) -> None:
        """Rows that the newest state does not see and fewer than two others do: they say nothing, and never will."""
        n = self.window.n
        for table in (self.window.points, self.window.lines):
            seen = table.seen[:table.count, :n]
            table.keep(seen[:, n - 1] | (seen.sum(axis=1) >= 2))

    def _is_keyframe(self, just_followed: int) -> bool:
        """By mean parallax (rotation removed) against the previous keyframe, share of its tracks left, and time.

        Also when more than three quarters of the corners followed from the last image, just_followed in number, are new
        to the window.
        """
        w, n = self.window, self.window.n
        if n < 2:
            return True
        if w.still[n - 1]:
            return False
        a, b = n - 2, n - 1
        if (w.t_ns[b] - w.t_ns[a]) * 1e-9 > self.options.keyframe_max_s:
            return True
        p, q = w.points, w.lines
        if _followed(p, b, n) < FEW_KNOWN * just_followed:
            return True
        both, had = p.seen[:p.count, a] & p.seen[:p.count, b], _followed(p, a, n)
        R = w.R_BC.T @ w.R[a].T @ w.R[b] @ w.R_BC
        shifts = corner_shifts(p.z[:p.count, a][both], _turned(R, p.z[:p.count, b][both]))
        if len(shifts) < FEW_CORNERS:
            both, had = q.seen[:q.count, a] & q.seen[:q.count, b], had + _followed(q, a, n)
            then, sigma = q.z[:q.count, a][both], q.sigma[:q.count, a][both]
            size, _ = segment_shifts(then, _turned(R, q.z[:q.count, b][both]), sigma, sigma)
            shifts = np.concatenate([shifts, size])
        if len(shifts) < max(0.5 * had, 1):
            return bool(p.seen[:p.count, b].any() or q.seen[:q.count, b].any())
        return float(np.mean(shifts)) * self.focal > self.options.keyframe_parallax_px

    def _health(self) -> str:
        """Why the estimate cannot be trusted any more, or ''."""
        w, k = self.window, self.window.n - 1
        speed = float(np.linalg.norm(w.v[k]))
        if not np.isfinite(w.p[k]).all() or speed > MAX_SPEED:
            return f'estimated speed {speed:.0f} m/s'
        if np.linalg.norm(w.b[k, :3]) > MAX_GYRO_BIAS or np.linalg.norm(w.b[k, 3:]) > MAX_ACCEL_BIAS:
            return f'estimated IMU biases {w.b[k].round(2).tolist()} rad/s, m/s^2'
        followed = [t.seen[:t.count, k] & t.seen[:t.count, :k].any(axis=1) for t in (w.points, w.lines)]
        if sum(int(f.sum()) for f in followed) >= MIN_FEATURES:
            self._last_sight_ns = w.t_ns[k]
        blind = (w.t_ns[k] - self._last_sight_ns) * 1e-9
        astray = blind * float(np.sqrt(np.trace(self.covariance()[6:, 6:]))) if blind > 0.0 else 0.0
        return f'nothing followed from image to image for {blind:.1f} s' if astray > self.options.max_blind_m else ''


def _followed(table: LandmarkTable, slot: int, n: int) -> int:
    """How many of a state's tracks another state saw, too: in a noisy image most new ones do not outlive it."""
    seen = table.seen[:table.count, :n]
    return int((seen[:, slot] & (seen.sum(axis=1) >= 2)).sum())


def _turned(R_ab: F64, x: F64) -> F64:
    """Bearings (..., 2) of camera b as one with the rotation of camera a and their own place would have them."""
    rays = x @ R_ab[:, :2].T + R_ab[:, 2]
    return rays[..., :2] / rays[..., 2:]
