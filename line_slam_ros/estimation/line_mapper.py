"""Mapping with given poses: only the lines are estimated. The second mode, next to Slam."""
from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter

import numpy as np

from line_slam_ros.config import Config
from line_slam_ros.estimation.line_solver import refine_lines
from line_slam_ros.estimation.line_start import start_from_planes
from line_slam_ros.frontend.front_end import FrontEnd
from line_slam_ros.geometry.camera import Camera, warm_up_lenses
from line_slam_ros.geometry.lie import rigid
from line_slam_ros.geometry.line_forms import VALUES, store_lines
from line_slam_ros.kernel_cache import cache_is_empty
from line_slam_ros.mapping.line_map import LineMap
from line_slam_ros.mapping.table import IdTable
from line_slam_ros.mapping.views import add_view, view_columns
from line_slam_ros.types import (
    F64,
    I64,
    Calibration,
    Estimate,
    Frame,
    LineForm,
    LineObservations,
    LineSegments,
    Status,
)

SHARED = 0.5  # a keyframe is due when fewer of the present lines were in the last one
VIEWS = 256  # most views that a line is estimated from
MOSTLY = 0.5  # share of outlying views that makes a line wrong


class LineMapper:
    """Frames and poses in, a line map out; same surface as Slam but for process_with_pose()."""

    def __init__(self, config: Config, calibration: Calibration) -> None:
        self._config, self._calibration = config, calibration
        camera = Camera(calibration)
        self._focal = camera.focal
        self.front_end = FrontEnd(camera, replace(config, use_points=False, use_lines=True))
        self.line_map = LineMap(config.mapping)
        self.lines = LineEstimator(config)
        self.status, self.waiting_for, self.resets = Status.INITIALISING, 'first image with a pose', 0
        self.timings: dict[str, float] = {}
        self._last: tuple[int, F64] | None = None  # t_ns, T_WC
        self._keyframe: tuple[LineObservations, F64] | None = None  # with R_WC

    def warm_up(self, tell: Callable[[str], None] = print) -> None:
        """Compile or load every kernel; tell is called with a sentence for the human when it takes long."""
        cache_is_empty(tell)
        warm_up_lenses()
        LineMap.warm_up(self._config.mapping)
        LineEstimator.warm_up(self._config)
        scratch = FrontEnd(Camera(self._calibration), replace(self._config, use_points=False, use_lines=True))
        height, width = self._calibration.height, self._calibration.width
        for k in range(3):  # a bright sheet that moves to the right
            image = np.full((height, width), 60, np.uint8)
            image[height // 4: -height // 4, width // 4 + k: -width // 4 + k] = 180
            scratch.track(Frame(k, image), np.eye(3))

    def process_with_pose(self, frame: Frame, T_WB: F64, behind: bool = False) -> Estimate:
        """One frame and the body's pose (4, 4) when it was taken. The estimate repeats the pose.

        When the caller is behind, nothing new is detected in this frame unless few tracks are left.
        Raises ValueError for a frame that is not newer than the last and for a pose that is not finite.
        """
        if self._last is not None and frame.t_ns <= self._last[0]:
            raise ValueError(f'frame stamp {frame.t_ns} is not after {self._last[0]}')
        if not np.all(np.isfinite(T_WB)):
            raise ValueError(f'pose of frame {frame.t_ns} is not finite: {T_WB}')
        self.timings = {}
        with self._timed('total'):
            T_WC = T_WB @ self._calibration.T_BC
            R_CnCp = None if self._last is None else T_WC[:3, :3].T @ self._last[1][:3, :3]
            with self._timed('track'):
                seen = self.front_end.track(frame, R_CnCp, skip_detection=behind).lines
            self._last = frame.t_ns, T_WC
            self.status, self.waiting_for = Status.TRACKING, ''
            is_keyframe = self._is_keyframe(seen, T_WC[:3, :3])
            if is_keyframe:
                self._keyframe = seen, T_WC[:3, :3]
                with self._timed('optimise'):
                    wrong = self.lines.add(seen, T_WC)
                    self.front_end.forget(np.empty(0, np.int64), wrong)
                with self._timed('map'):
                    self.lines.hand_over(self.line_map)
        zero = np.zeros(3)
        return Estimate(frame.t_ns, np.array(T_WB, float), zero, zero, zero, zero, np.zeros((9, 9)), is_keyframe,
                        self.timings)

    def rig(self) -> None:
        """The calibration is not refined in this mode."""

    def active_lines(self) -> LineSegments:
        """The lines seen lately."""
        return self.line_map.active()

    def points(self) -> F64:
        """No points in this mode: (0, 3)."""
        return np.empty((0, 3))

    def reset(self, reason: str) -> None:
        """Start anew: time and map."""
        self.resets += 1
        self.status, self.waiting_for = Status.INITIALISING, reason
        self._last = self._keyframe = None
        self.front_end.reset()
        self.lines.clear(self.line_map)
        self.line_map.clear()

    def _is_keyframe(self, seen: LineObservations, R_WC: F64) -> bool:
        """By the mean distance that the segments moved across since the last keyframe, rotation removed, and by the
        share of lines that were in it."""
        if self._keyframe is None:
            return True
        before, R_WK = self._keyframe
        _, now_rows, then_rows = np.intersect1d(seen.ids, before.ids, return_indices=True)
        if len(now_rows) < SHARED * len(seen.ids):
            return True
        if not len(now_rows):
            return False
        rays = np.concatenate([seen.ends[now_rows], np.ones((len(now_rows), 2, 1))], axis=-1) @ (R_WC.T @ R_WK)
        moved = rays[..., :2] / rays[..., 2:] - before.ends[then_rows, :1]
        along = before.ends[then_rows, 1] - before.ends[then_rows, 0]
        across = moved[..., 0] * along[:, None, 1] - moved[..., 1] * along[:, None, 0]
        parallax = np.abs(across) / np.linalg.norm(along, axis=-1)[:, None]
        return float(parallax.mean()) * self._focal > self._config.estimator.keyframe_parallax_px

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        started = perf_counter()
        yield
        self.timings[stage] = perf_counter() - started


class LineEstimator:
    """The lines seen lately, each from the views of its whole life, with known poses."""

    def __init__(self, config: Config) -> None:
        self._options = config.estimator
        self._form = int(LineForm.of(config.estimator.line_representation))
        self._table = IdTable(**view_columns(VIEWS), values=((VALUES,), np.float64),
                              origin=((3,), np.float64), started=((), np.bool_), pluecker=((6,), np.float64),
                              cov=((6, 6), np.float64), outliers=((), np.float64), newest=((), np.int64))
        self._keyframes = 0
        self._seen: LineObservations | None = None  # by the newest keyframe
        self._T_WC = np.eye(4)
        self._mapped: set[int] = set()  # ids handed over to the map

    @staticmethod
    def warm_up(config: Config) -> None:
        """Compile or load every kernel, on an estimator of its own."""
        scratch, line_map = LineEstimator(config), LineMap(config.mapping)
        for k in range(config.estimator.line_min_views + 1):
            x = 0.3 * k
            ends = np.array([[[-x, -0.5], [-x, 0.5]]])
            scratch.add(LineObservations(np.array([0]), ends, np.full((1, 2), 1e-3)), rigid(np.eye(3), [x, 0.0, 0.0]))
        scratch.hand_over(line_map)

    def add(self, seen: LineObservations, T_WC: F64) -> I64:
        """A keyframe's segments from a known pose: start what can be, refine what was seen. Ids of lines that most
        views contradict are returned and forgotten."""
        self._keyframes += 1
        self._seen, self._T_WC = seen, T_WC
        rows = np.array([self._table.put(i) for i in seen.ids], np.int64)
        self._table['newest'][rows] = self._keyframes
        add_view(self._table, rows, T_WC, seen.ends, seen.sigma)
        self._start(rows[~self._table['started'][rows]])
        self._refine(rows[self._table['started'][rows]])
        wrong = seen.ids[self._table['started'][rows] & (self._table['outliers'][rows] > MOSTLY)]
        for line_id in wrong:
            self._table.remove(line_id)
        return wrong

    def hand_over(self, line_map: LineMap) -> None:
        """Bring the map up to date: refined lines, their views, lines that were wrong and those that left."""
        table = self._table
        wrong = np.array([i for i in self._mapped if i not in table], np.int64)
        line_map.drop(wrong)
        self._mapped.difference_update(wrong.tolist())
        rows = table.rows(self._seen.ids)
        rows = rows[(rows >= 0) & table['started'][rows]]
        line_map.refine(table.ids[rows], table['pluecker'][rows], table['cov'][rows], table['seen'][rows])
        known = np.isin(self._seen.ids, list(self._mapped))
        line_map.observe(self._seen.ids[known], self._seen.ends[known], self._T_WC)
        for row in rows[~np.isin(table.ids[rows], list(self._mapped))]:
            self._introduce(row, line_map)
        self._retire(table.ids[self._keyframes - table['newest'] >= self._options.window].copy(), line_map)

    def _introduce(self, row: int, line_map: LineMap) -> None:
        """Give the map all views of a line that it did not know."""
        table, line_id = self._table, self._table.ids[row: row + 1]
        for k in range(table['count'][row]):
            pose = table['poses'][row, k]
            line_map.observe(line_id, table['ends'][row, k: k + 1], rigid(pose[:, :3], pose[:, 3]))
        self._mapped.add(int(line_id[0]))

    def clear(self, line_map: LineMap) -> None:
        """Retire everything and forget it."""
        self._retire(self._table.ids.copy(), line_map)

    def _retire(self, ids: I64, line_map: LineMap) -> None:
        line_map.retire(ids)
        self._mapped.difference_update(ids.tolist())
        for line_id in ids:
            self._table.remove(line_id)

    def _start(self, rows: I64) -> None:
        """First estimates of the lines in these rows that can have one; the others wait for more views."""
        table, options = self._table, self._options
        rows = rows[table['count'][rows] >= options.line_min_views]
        if not len(rows):
            return
        lines, origin, holds = start_from_planes(*(table[name][rows] for name in ('poses', 'ends', 'sigma', 'count')),
                                                 np.sin(np.radians(options.line_min_parallax_deg)))
        values, stored = np.empty((len(rows), VALUES)), np.empty(len(rows), np.bool_)
        store_lines(self._form, lines, table['poses'][rows, 0, :, :3], table['ends'][rows, 0], values, stored)
        rows, good = rows[holds & stored], holds & stored
        table['started'][rows], table['origin'][rows], table['values'][rows] = True, origin[good], values[good]

    def _refine(self, rows: I64) -> None:
        table, options = self._table, self._options
        refine_lines(rows, self._form, table['poses'], table['ends'], table['sigma'], table['count'], table['values'],
                     table['origin'], options.loss_scale**2, options.max_iterations, options.gate_chi2,
                     table['pluecker'], table['cov'], table['outliers'])
