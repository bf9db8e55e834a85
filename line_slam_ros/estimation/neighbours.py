"""Frames that leave at once serve the keyframe next to them: its observations become means over them all.

Errors of a track hardly repeat each other from one frame to the next, so a mean over the frames around a keyframe errs
much less than the keyframe alone. What the body did in between, by its inertial samples, and what that makes of the
landmark, by its estimate, is taken out first: the means are of residuals. Frames come by pairs, one from before the
keyframe and one from as long after it, which cancels errors of velocity and depth. No frame serves twice.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.estimation.landmarks import line_residuals, point_residuals
from line_slam_ros.estimation.solver import Solver, exposures
from line_slam_ros.estimation.window import LandmarkTable
from line_slam_ros.geometry.imu import preintegrate
from line_slam_ros.geometry.line_forms import unit_world_lines
from line_slam_ros.types import F64, I64, Observations

REACH_S = 0.2  # from the keyframe: longer, and errors of biases and tilt grow beyond those of the tracks
ALIKE = 0.7  # least ratio of the times from a keyframe to the two frames of a pair
REPEATED = 0.4  # share of a corner's variance that is in all frames within reach; measured: 0.2 to 0.4
NOT_ROBUST = 1e300  # loss scale


class Neighbours:
    """Works on the solver's window; remembers the frames around the newest keyframe that have not served yet."""

    def __init__(self, solver: Solver, gate_chi2: float):
        self._solver, self._gate = solver, gate_chi2
        self._keyframe_ns = -1  # stamp; -1: there is none
        self._before: list[Observations] = []  # of the keyframe, nearest last
        self._after: list[Observations] = []

    def clear(self) -> None:
        """No keyframe."""
        self._keyframe_ns, self._before, self._after = -1, [], []

    def add(self, seen: Observations, is_keyframe: bool) -> None:
        """Take in the newest state's frame, once everything is where its observations want it."""
        w, slot = self._solver.window, self._solver.window.n - 2
        near = [frame for frame in self._after if _apart_s(frame, seen.t_ns) <= REACH_S]
        if is_keyframe:
            self._keyframe_ns, self._before, self._after = seen.t_ns, near, []
        elif self._keyframe_ns != w.t_ns[slot] or w.still[slot:w.n].any():
            self.clear()
        elif (partner := self._partner(_apart_s(seen, self._keyframe_ns))) is not None:
            self._average(slot, partner)
        else:
            self._after = [*near, seen]

    def _partner(self, after_s: float) -> Observations | None:
        """The frame as long before the keyframe, which then has served, if there is one within reach."""
        while self._before and _apart_s(self._before[-1], self._keyframe_ns) < ALIKE * after_s:
            self._before.pop()
        if after_s <= REACH_S and self._before and ALIKE * _apart_s(self._before[-1], self._keyframe_ns) <= after_s:
            return self._before.pop()
        return None

    def _average(self, slot: int, before: Observations) -> None:
        """Average a keyframe's observations with those of a frame before it and of the newest.

        A segment's standard deviations stay: what is wrong with its edge is so in all frames.
        """
        w, o = self._solver.window, self._solver.options
        points, lines = w.points, w.lines
        R, p = self._poses(slot, before.t_ns)
        seen = _Triples(points, slot, w.n - 1, before.points.ids, before.points.x)
        point_residuals(3, R, p, w.R_BC, w.p_BC, seen.use, seen.seen, seen.z, seen.sigma, points.abr, points.R_WA,
                        points.p_WA, NOT_ROBUST, o.rho0, o.w_rho, seen.chi2, seen.pull, seen.weight, seen.gradient)
        rows, step = seen.agreeing(self._gate)
        gain, variance = _count_two_more(points, rows, slot)
        points.z[rows, slot] -= gain * step  # residuals are predicted minus observed
        points.sigma[rows, slot] *= np.sqrt(variance)
        seen = _Triples(lines, slot, w.n - 1, before.lines.ids, before.lines.ends)
        line_residuals(3, R, p, w.R_BC, w.p_BC, seen.use, seen.seen, seen.z, seen.sigma, int(o.line_form), lines.values,
                       lines.origin, NOT_ROBUST, seen.chi2, seen.pull, seen.weight, seen.gradient)
        rows, step = seen.agreeing(self._gate)
        gain, _ = _count_two_more(lines, rows, slot)
        pluecker, _ = unit_world_lines(int(o.line_form), lines.values[rows], lines.origin[rows])
        R_WC, p_WC = R[1] @ w.R_BC, p[1] + R[1] @ w.p_BC
        across = (pluecker[:, :3] - np.cross(p_WC, pluecker[:, 3:])) @ R_WC[:, :2]
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        lines.z[rows, slot] += (gain * step)[:, :, None] * across[:, None, :]

    def _poses(self, slot: int, before_ns: int) -> tuple[F64, F64]:
        """Bodies' R_WB (3, 3, 3) and p_WB (3, 3) when the images of a frame before a keyframe, of it and of the newest
        frame were taken, as the keyframe's state and the inertial samples have them."""
        w, g_W = self._solver.window, self._solver.options.g_W
        R, p, v, b = w.R[slot], w.p[slot], w.v[slot], w.b[slot]
        t, gyro, accel = w.samples[slot - 1]
        first = int(np.searchsorted(t, (before_ns - w.t_ns[slot - 1]) * 1e-9 - 1e-6))
        dR, dp, dv = np.empty((3, 3)), np.empty(3), np.empty(3)
        dt = preintegrate(t[first:], gyro[first:], accel[first:], b[:3], b[3:], 0.0, 0.0, dR, dp, dv,
                          np.empty((9, 6)), np.empty((9, 9)))
        R_before, after = R @ dR.T, w.dt[slot]
        v_before, v_after = v - g_W * dt - R_before @ dv, v + g_W * after + R @ w.dv[slot]
        p_before = p - v_before * dt - 0.5 * g_W * dt**2 - R_before @ dp
        p_after = p + v * after + 0.5 * g_W * after**2 + R @ w.dp[slot]
        rates = np.stack([gyro[first] - b[:3], w.rates[slot], w.rates[slot + 1]])
        R_exposed, p_exposed = np.empty((3, 3, 3)), np.empty((3, 3))
        exposures(3, np.stack([R_before, R, R @ w.dR[slot]]), np.stack([p_before, p, p_after]),
                  np.stack([v_before, v, v_after]), rates, w.delay[0], R_exposed, p_exposed, np.empty((3, 6)))
        return R_exposed, p_exposed


class _Triples:
    """What the frame before a keyframe, the keyframe and the newest frame see of landmarks of one kind, by row, and
    buffers for the residuals (landmarks.py)."""

    def __init__(self, table: LandmarkTable, slot: int, newest: int, ids: I64, z: F64):
        c, rows = table.count, table.find(ids)
        known = rows >= 0
        first, there = table.z[:c, newest].copy(), np.zeros(c, np.bool_)
        first[rows[known]], there[rows[known]] = z[known], True
        self.use = there & table.solved[:c] & table.seen[:c, slot] & table.seen[:c, newest]
        self.seen = np.repeat(self.use[:, None], 3, axis=1)
        self.z = np.stack([first, table.z[:c, slot], table.z[:c, newest]], axis=1)
        self.sigma = np.repeat(table.sigma[:c, newest, None], 3, axis=1)  # of one frame
        self.chi2, self.pull, self.weight = np.zeros((c, 3)), np.zeros((c, 3, 2)), np.zeros((c, 3))
        self.gradient = np.zeros((c, 4))

    def agreeing(self, gate: float) -> tuple[I64, F64]:
        """Rows (N,) of those that err alike in the keyframe and around it, and by how much more (N, 2) around it."""
        more = 0.5 * (self.pull[:, 0] + self.pull[:, 2]) - self.pull[:, 1]
        rows = np.flatnonzero(self.use & (self.weight > 0.0).all(axis=1) & ((more**2).sum(axis=1) < gate))
        return rows, more[rows] * self.sigma[rows, 1]


def _count_two_more(table: LandmarkTable, rows: I64, slot: int) -> tuple[F64, F64]:
    """Let observations be means over two more images; their share in it, and the new variance over the old (N, 1)."""
    images = table.images[rows, slot, None]
    table.images[rows, slot] += 2
    before, after = (REPEATED + (1.0 - REPEATED) / count for count in (images, images + 2))
    return 2.0 / (images + 2), after / before


def _apart_s(frame: Observations, t_ns: int) -> float:
    return abs(t_ns - frame.t_ns) * 1e-9
