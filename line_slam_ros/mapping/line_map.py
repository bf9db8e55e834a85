"""The line map: landmarks being estimated, landmarks kept, and what of both is good enough to show."""
from __future__ import annotations

import numpy as np

from line_slam_ros.config import Mapping
from line_slam_ros.mapping.fusion import Landmark, agree, fuse, near, worst_sigma
from line_slam_ros.mapping.table import IdTable
from line_slam_ros.mapping.trimming import trim
from line_slam_ros.mapping.views import add_view, view_columns
from line_slam_ros.types import F64, I64, LineSegments

VIEWS = 64  # kept of each active landmark for its trimming
LINE_COLUMNS = {'pluecker': ((6,), np.float64), 'cov': ((6, 6), np.float64), 'views': ((), np.int64)}
KEPT_COLUMNS = {**LINE_COLUMNS, 'ends': ((2, 3), np.float64), 'sigma': ((), np.float64)}


class LineMap:
    """Lines with stable ids. Active ones follow the estimator; retired ones are merged with the kept ones and stay.

    Memory grows with the kept lines only. Same calls, same map: nothing is random.
    """

    def __init__(self, config: Mapping) -> None:
        self._config = config
        self._active = IdTable(**LINE_COLUMNS, **view_columns(VIEWS))
        self._kept = IdTable(**KEPT_COLUMNS)
        self._version = 0
        self._trimmed: tuple[int, list[Landmark]] = (0, [])
        self._shown: tuple[int, LineSegments] = (0, LineSegments.empty())

    @staticmethod
    def warm_up(config: Mapping) -> None:
        """Compile or load every kernel, on a map of its own."""
        scratch, line = LineMap(config), np.array([0.0, 2.0, 0.0, 1.0, 0.0, 0.0])  # two metres ahead, along x
        scratch.refine(np.array([0]), line[None], np.zeros((1, 6, 6)), np.array([config.min_views]))
        scratch.observe(np.array([0]), np.array([[[-0.1, 0.0], [0.1, 0.0]]]), np.eye(4))
        scratch.active()
        duplicate(scratch._kept, Landmark(1, line, np.zeros((6, 6)), np.zeros((2, 3)), 0, 0.0), config)

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
        gone = {int(i) for i in ids if i in self._active}
        for landmark in self._good():
            if landmark.id in gone:
                keep(self._kept, landmark, self._config)
        for i in sorted(gone):
            self._active.remove(i)
        self._version += 1

    def drop(self, ids: I64) -> None:
        """These were wrong: forget what is active of them; unknown ids are skipped."""
        for i in {int(i) for i in ids if i in self._active}:
            self._active.remove(i)
        self._version += 1

    def active(self) -> LineSegments:
        """The landmarks in the window that are good enough for the map, by id, not merged with the kept ones."""
        table = self._kept.like()
        for landmark in self._good():
            put(table, landmark)
        return to_segments(table)

    def segments(self) -> LineSegments:
        """The map by id: what would be kept if every active landmark left the window now."""
        if self._shown[0] != self._version:
            table = self._kept.copy()
            for landmark in self._good():
                keep(table, landmark, self._config)
            self._shown = self._version, to_segments(table)
        return self._shown[1]

    def clear(self) -> None:
        """Forget everything; the version goes on."""
        self._active.clear()
        self._kept.clear()
        self._version += 1

    def _good(self) -> list[Landmark]:
        """The active landmarks that may enter the map, trimmed, by id."""
        if self._trimmed[0] != self._version:
            self._trimmed = self._version, self._trim()
        return self._trimmed[1]

    def _trim(self) -> list[Landmark]:
        rule, table = self._config, self._active
        pluecker, cov, views, ids = table['pluecker'], table['cov'], table['views'], table.ids
        extents, parallax = np.empty((len(table), 2)), np.empty(len(table))
        trim(pluecker, table['poses'], table['ends'], table['count'], rule.max_range_m, rule.end_share,
             1e-3 * rule.end_sigma_mrad, extents, parallax)
        foot = np.cross(pluecker[:, 3:], pluecker[:, :3])  # of the world's origin
        ends = foot[:, None] + extents[..., None] * pluecker[:, None, 3:]
        sigma = worst_sigma(pluecker, cov, ends)
        good = ((views >= rule.min_views) & (sigma <= rule.max_sigma_m)
                & (parallax >= np.radians(rule.min_parallax_deg))
                & (extents[:, 1] - extents[:, 0] >= rule.min_length_m))
        return [Landmark(int(ids[k]), pluecker[k].copy(), cov[k].copy(), ends[k], int(views[k]), float(sigma[k]))
                for k in np.flatnonzero(good)[np.argsort(ids[good])]]


def keep(table: IdTable, landmark: Landmark, rule: Mapping) -> None:
    """Add a landmark to the kept ones, fused with every duplicate among them; the lowest id survives. Of two under one
    id that are not the same line, the more certain one stays."""
    twin = duplicate(table, landmark, rule)
    while twin is not None:
        table.remove(twin.id)
        landmark = fuse(twin, landmark)
        twin = duplicate(table, landmark, rule)
    namesake = table.rows([landmark.id])[0]
    if namesake < 0 or landmark.sigma < table['sigma'][namesake]:
        put(table, landmark)


def put(table: IdTable, landmark: Landmark) -> None:
    """Write a landmark to its row of a table of kept ones."""
    row = table.put(landmark.id)
    for name in KEPT_COLUMNS:
        table[name][row] = getattr(landmark, name)


def duplicate(table: IdTable, landmark: Landmark, rule: Mapping) -> Landmark | None:
    """The nearest kept landmark that is the same line, if any."""
    for row in near(landmark, table['pluecker'], table['ends'], rule):
        other = Landmark(int(table.ids[row]), *(table[name][row].copy() for name in ('pluecker', 'cov', 'ends')),
                         int(table['views'][row]), float(table['sigma'][row]))
        if agree(landmark, other, rule):
            return other
    return None


def to_segments(table: IdTable) -> LineSegments:
    """A table of kept landmarks, by id."""
    rows = np.argsort(table.ids)
    return LineSegments(table.ids[rows], *(table[name][rows] for name in ('pluecker', 'ends', 'views', 'sigma')))
