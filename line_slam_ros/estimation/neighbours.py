"""Frames that leave at once serve the keyframe next to them: its observations become means over them all.

Errors of a track hardly repeat each other from one frame to the next, so a mean over the frames around a keyframe errs
much less than the keyframe alone. What the body did in between, by its inertial samples, and what that makes of the
landmark, by its estimate, is taken out first: the means are of residuals. Frames come by pairs, the last one before the
keyframe with the first one after it and so on, which cancels errors of velocity and depth. No frame serves twice.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.estimation.landmarks import line_residuals, point_residuals
from line_slam_ros.estimation.solver import Solver
from line_slam_ros.estimation.window import LandmarkTable
from line_slam_ros.geometry.imu import preintegrate
from line_slam_ros.geometry.line_forms import unit_world_lines
from line_slam_ros.types import F64, I64, Observations

REACH_S = 0.2  # from the keyframe: longer, and errors of biases and tilt grow beyond those of the tracks
REPEATED = 0.4  # share of a corner's variance that a mean over however many frames keeps
NOT_ROBUST = 1e300  # loss scale


class Neighbours:
    """Works on the solver's window; remembers the frames since the last keyframe."""

    def __init__(self, solver: Solver, gate_chi2: float):
        self._solver, self._gate = solver, gate_chi2
        self._keyframe_ns = -1  # stamp; -1: there is none
        self._before: list[Observations] = []  # frames before the keyframe that have not served yet, nearest last
        self._since: list[Observations] = []  # frames after it that have no partner before it

    def clear(self) -> None:
        """No keyframe."""
        self._keyframe_ns, self._before, self._since = -1, [], []

    def add(self, seen: Observations, is_keyframe: bool) -> None:
        """Take in the newest state's frame, once everything is where its observations want it."""
        w, slot = self._solver.window, self._solver.window.n - 2
        if is_keyframe:
            self._before = [frame for frame in self._since if _near(frame.t_ns, seen.t_ns)]
            self._since, self._keyframe_ns = [], seen.t_ns
        elif self._keyframe_ns != w.t_ns[slot] or w.still[slot:w.n].any():
            self.clear()
        elif self._before and _near(self._keyframe_ns, seen.t_ns):
            self._average(slot, self._before.pop())
        else:
            self._since.append(seen)

    def _average(self, slot: int, before: Observations) -> None:
        """Average a keyframe's observations with those of a frame before it and of the newest."""
        w, o = self._solver.window, self._solver.options
        R, p = self._poses(slot, before.t_ns)
        rig, points, lines = (w.R_BC, w.p_BC), w.points, w.lines
        seen, r = _Views(points, slot, w.n - 1, before.points.ids, before.points.x), _Residuals(points.count, 3)
        point_residuals(3, R, p, *rig, *seen.arguments(), points.abr, points.R_WA, points.p_WA, NOT_ROBUST, o.rho0,
                        o.w_rho, *r.buffers())
        rows, images, step = seen.agreeing(r, self._gate)
        points.z[rows, slot] -= step  # residuals are predicted minus observed
        points.sigma[rows, slot] *= np.sqrt(_variance(images + 2) / _variance(images))[:, None]
        seen, r = _Views(lines, slot, w.n - 1, before.lines.ids, before.lines.ends), _Residuals(lines.count, 4)
        line_residuals(3, R, p, *rig, *seen.arguments(), int(o.line_form), lines.values, lines.origin, NOT_ROBUST,
                       *r.buffers())
        rows, _, step = seen.agreeing(r, self._gate)
        pluecker, _ = unit_world_lines(int(o.line_form), lines.values[rows], lines.origin[rows])
        R_WC, p_WC = R[1] @ w.R_BC, p[1] + R[1] @ w.p_BC
        across = (pluecker[:, :3] - np.cross(p_WC, pluecker[:, 3:])) @ R_WC[:, :2]
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        lines.z[rows, slot] += step[:, :, None] * across[:, None, :]

    def _poses(self, slot: int, before_ns: int) -> tuple[F64, F64]:
        """Bodies' R_WB (3, 3, 3) and p_WB (3, 3) at a frame before a keyframe, at it and at the newest frame, as the
        keyframe's state and the inertial samples have them."""
        w, g_W = self._solver.window, self._solver.options.g_W
        (R, p), v, b = (a[slot] for a in self._solver.exposed()), w.v[slot], w.b[slot]
        t, gyro, accel = w.samples[slot - 1]
        first = int(np.searchsorted(t, (before_ns - w.t_ns[slot - 1]) * 1e-9 - 1e-6))
        dR, dp, dv = np.empty((3, 3)), np.empty(3), np.empty(3)
        dt = preintegrate(t[first:], gyro[first:], accel[first:], b[:3], b[3:], 0.0, 0.0, dR, dp, dv,
                          np.empty((9, 6)), np.empty((9, 9)))
        R_before = R @ dR.T
        p_before = p - v * dt + 0.5 * g_W * dt**2 + R_before @ (dv * dt - dp)
        p_newest = p + v * w.dt[slot] + 0.5 * g_W * w.dt[slot]**2 + R @ w.dp[slot]
        return np.stack([R_before, R, R @ w.dR[slot]]), np.stack([p_before, p, p_newest])


class _Residuals:
    """Buffers of the residuals of landmarks in three frames; see landmarks.py."""

    def __init__(self, rows: int, size: int):
        self.chi2, self.pull, self.weight = np.zeros((rows, 3)), np.zeros((rows, 3, 2)), np.zeros((rows, 3))
        self._gradient = np.zeros((rows, size))

    def buffers(self) -> tuple[F64, F64, F64, F64]:
        return self.chi2, self.pull, self.weight, self._gradient


class _Views:
    """Of landmarks of one kind, by row: what a frame before a keyframe, the keyframe and the newest frame see."""

    def __init__(self, table: LandmarkTable, slot: int, newest: int, ids: I64, z: F64):
        c = table.count
        self._table, self._slot = table, slot
        rows = table.find(ids)
        known = rows >= 0
        there = np.zeros(c, np.bool_)
        there[rows[known]] = True
        self.use = there & table.solved[:c] & table.seen[:c, slot] & table.seen[:c, newest]
        self.z = np.stack([table.z[:c, newest]] * 3, axis=1)
        self.z[rows[known], 0] = z[known]
        self.z[:, 1] = table.z[:c, slot]
        self.sigma = np.stack([table.sigma[:c, newest]] * 3, axis=1)  # of one frame

    def arguments(self) -> tuple[np.ndarray, np.ndarray, F64, F64]:
        """use, seen, z and sigma as the residuals' kernels take them."""
        return self.use, np.repeat(self.use[:, None], 3, axis=1), self.z, self.sigma

    def agreeing(self, r: _Residuals, gate: float) -> tuple[I64, I64, F64]:
        """Rows (N,) of those that err alike in the keyframe and around it, over how many images their observations were
        means, which are two more now, and by how much (N, 2) the keyframe's residuals change."""
        change = 0.5 * (r.pull[:, 0] + r.pull[:, 2]) - r.pull[:, 1]
        rows = np.flatnonzero(self.use & (r.weight > 0.0).all(axis=1) & ((change**2).sum(axis=1) < gate))
        images = self._table.images[rows, self._slot]
        self._table.images[rows, self._slot] += 2
        return rows, images, (2.0 / (images + 2))[:, None] * change[rows] * self.sigma[rows, 1]


def _near(a_ns: int, b_ns: int) -> bool:
    return abs(b_ns - a_ns) * 1e-9 <= REACH_S


def _variance(images: I64) -> F64:
    """Of a mean over so many frames, of one frame's."""
    return REPEATED + (1.0 - REPEATED) / images
