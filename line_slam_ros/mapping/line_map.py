"""The line map: landmarks being estimated, landmarks kept, and what of both is good enough to show."""
from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from line_slam_ros.config import Mapping
from line_slam_ros.mapping.fusion import worst_sigma
from line_slam_ros.mapping.merging import KEPT_COLUMNS, Landmarks, Merging
from line_slam_ros.mapping.table import IdTable
from line_slam_ros.mapping.trimming import trim
from line_slam_ros.mapping.views import add_view, view_columns
from line_slam_ros.types import F64, I64, LineSegments

VIEWS = 64  # kept of each active landmark for its trimming
ACTIVE_COLUMNS = {'pluecker': ((6,), np.float64), 'cov': ((6, 6), np.float64), 'views': ((), np.int64)}


class LineMap:
    """Lines with stable ids. Active ones follow the estimator; retired ones are merged with the kept ones and stay.

    Memory grows with the kept lines only. Same calls, same map: nothing is random.
    """

    def __init__(self, config: Mapping) -> None:
        self._config = config
        self._active = IdTable(**ACTIVE_COLUMNS, **view_columns(VIEWS))
        self._kept = IdTable(**KEPT_COLUMNS)
        self._version = 0
        self._trimmed: tuple[int, Landmarks] | None = None  # with the version
        self._shown: tuple[int, LineSegments] = (0, LineSegments.empty())

    @staticmethod
    def warm_up(config: Mapping) -> None:
        """Compile or load every kernel, on a map of its own."""
        scratch, line = LineMap(config), np.array([0.0, 2.0, 0.0, 1.0, 0.0, 0.0])  # two metres ahead, along x
        scratch.refine(np.array([0]), line[None], np.zeros((1, 6, 6)), np.array([config.min_views]))
        scratch.observe(np.array([0]), np.array([[[-0.1, 0.0], [0.1, 0.0]]]), np.eye(4))
        scratch.active()
        scratch.segments()

    @property
    def version(self) -> int:
        """Changes when segments() may."""
        return self._version

    def refine(self, ids: I64, pluecker: F64, cov: F64, views: I64) -> None:
        """Newest estimates of the landmarks in the window; ids (L,) may be new.

        pluecker (L, 6) = [n, d] in W with |d| = 1; cov (L, 6, 6) of these numbers; views (L,): how many keyframes
        saw each. A direction that turned round is turned back, so that the ends keep their order.
        """
        rows = np.array([self._active.put(i) for i in ids], np.int64)
        before = self._active['pluecker'][rows, 3:]
        turned = np.sum(before * pluecker[:, 3:], axis=1) < 0.0
        self._active['pluecker'][rows] = np.where(turned[:, None], -pluecker, pluecker)
        self._active['cov'][rows] = cov
        self._active['views'][rows] = views
        self._version += 1

    def observe(self, ids: I64, ends: F64, T_WC: F64) -> None:
        """One view's segments, ends (L, 2, 2) normalised, from T_WC (4, 4); ids without an estimate are skipped."""
        rows = self._active.rows(ids)
        known = np.flatnonzero(rows >= 0)
        add_view(self._active, rows[known], T_WC, ends[known], np.ones((len(known), 2)))
        self._version += 1

    def retire(self, ids: I64) -> None:
        """These left the window: keep them, merged with what is kept, or drop them, by quality; unknown ids are
        skipped."""
        rows = self._active.rows(np.unique(ids))
        rows = rows[rows >= 0]
        Merging(self._kept, self._trim(rows), self._config).commit()
        self._forget(self._active.ids[rows].tolist())

    def drop(self, ids: I64) -> None:
        """These were wrong: forget what is active of them; unknown ids are skipped."""
        self._forget({int(i) for i in ids if i in self._active})

    def active(self) -> LineSegments:
        """The landmarks in the window that are good enough for the map, by id, not merged with the kept ones."""
        return self._good().segments()

    def segments(self) -> LineSegments:
        """The map by id: what would be kept if every active landmark left the window now."""
        if self._shown[0] != self._version:
            self._shown = self._version, Merging(self._kept, self._good(), self._config).segments()
        return self._shown[1]

    def clear(self) -> None:
        """Forget everything; the version goes on."""
        self._active.clear()
        self._kept.clear()
        self._version += 1

    def _good(self) -> Landmarks:
        """The active landmarks that may enter the map, trimmed, by id."""
        if self._trimmed is None or self._trimmed[0] != self._version:
            self._trimmed = self._version, self._trim(np.argsort(self._active.ids))
        return self._trimmed[1]

    def _forget(self, ids: Iterable[int]) -> None:
        for i in ids:
            self._active.remove(i)
            self._version += 1

    def _trim(self, rows: I64) -> Landmarks:
        """Those of the active landmarks in rows that may enter the map, trimmed."""
        rule, table = self._config, self._active
        ends, parallax = np.empty((len(rows), 2, 3)), np.empty(len(rows))
        trim(rows, table['pluecker'], table['poses'], table['ends'], table['count'], rule.max_range_m, rule.end_share,
             1e-3 * rule.end_sigma_mrad, ends, parallax)
        pluecker, cov, views = (table[name][rows] for name in ('pluecker', 'cov', 'views'))
        sigma = worst_sigma(pluecker, cov, ends)
        good = ((views >= rule.min_views) & (sigma <= rule.max_sigma_m)
                & (parallax >= np.radians(rule.min_parallax_deg))
                & (np.sum((ends[:, 1] - ends[:, 0]) * pluecker[:, 3:], axis=1) >= rule.min_length_m))
        return Landmarks(*(column[good] for column in (table.ids[rows], pluecker, cov, ends, views, sigma)))
