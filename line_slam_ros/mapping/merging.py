"""More lines fused into kept ones, which stay as they are until commit()."""
from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from line_slam_ros.config import Mapping
from line_slam_ros.kernel_cache import inner, kernel
from line_slam_ros.mapping.fusion import fuse, nearness, twin, within
from line_slam_ros.mapping.table import IdTable
from line_slam_ros.types import F64, I64, LineSegments

ROOM = 1.0  # m, by which the box of a merging grows beyond what it must hold, so that it seldom grows
KEPT_COLUMNS = {'pluecker': ((6,), np.float64), 'cov': ((6, 6), np.float64), 'ends': ((2, 3), np.float64),
                'views': ((), np.int64), 'sigma': ((), np.float64)}


@dataclass(frozen=True, slots=True)
class Landmarks:
    """Lines as the map keeps them: LineSegments with their covariance."""

    ids: I64  # (L,)
    pluecker: F64  # (L, 6) [n, d] in W, |d| = 1
    cov: F64  # (L, 6, 6) of [n, d], rank 4
    ends: F64  # (L, 2, 3) in W, m
    views: I64  # (L,)
    sigma: F64  # (L,) m, across at the worse end

    def columns(self) -> tuple[np.ndarray, ...]:
        return tuple(getattr(self, f.name) for f in fields(self))

    def segments(self) -> LineSegments:
        return LineSegments(self.ids, self.pluecker, self.ends, self.views, self.sigma)


class Merging:
    """Landmarks on top of a table with KEPT_COLUMNS: only what they change is computed and copied."""

    def __init__(self, kept: IdTable, landmarks: Landmarks, rule: Mapping) -> None:
        self._kept = kept
        self._gone = np.zeros(len(kept), np.bool_)  # kept rows that were fused, or replaced
        columns, stays = tuple(map(np.empty_like, landmarks.columns())), np.zeros(len(landmarks.ids), np.bool_)
        _merge(landmarks.columns(), kept.rows(landmarks.ids), (kept.ids, *(kept[name] for name in KEPT_COLUMNS)),
               nearness(rule), self._gone, columns, stays)
        self._changed = Landmarks(*(column[stays] for column in columns))

    def commit(self) -> None:
        """Write the outcome to the kept ones."""
        for line_id in self._kept.ids[self._gone].tolist():
            self._kept.remove(line_id)
        rows = np.array([self._kept.put(line_id) for line_id in self._changed.ids.tolist()], np.int64)
        for name in KEPT_COLUMNS:
            self._kept[name][rows] = getattr(self._changed, name)

    def segments(self) -> LineSegments:
        """The outcome, by id."""
        ids = np.concatenate([self._kept.ids, self._changed.ids])
        order = np.argsort(ids, kind='stable')
        order = order[~np.concatenate([self._gone, np.zeros(len(self._changed.ids), np.bool_)])[order]]
        columns = (np.concatenate([self._kept[name], getattr(self._changed, name)])
                   for name in ('pluecker', 'ends', 'views', 'sigma'))
        return LineSegments(ids[order], *(column.take(order, axis=0) for column in columns))  # 4 x as fast as [order]


@kernel
def _merge(landmarks, namesakes, kept, near, gone, changed, stays):
    """Each landmark is fused with every twin among the kept lines and the landmarks before it; the lowest id survives.
    Of two under one id that are not the same line, the more certain one stays.

    landmarks, kept, changed: columns of Landmarks; namesakes (L,): kept rows with the landmarks' ids, -1 for none.
    Fills gone, of kept rows; changed and stays, of landmarks. Only kept lines in the box about all that is new can be
    twins; the others are passed over.
    """
    ids, pluecker, cov, ends, views, sigma = landmarks
    kept_ids, kept_pluecker, kept_cov, kept_ends, kept_views, kept_sigma = kept
    to_ids, to_pluecker, to_cov, to_ends, to_views, to_sigma = changed
    line, line_cov, line_ends = np.empty(6), np.empty((6, 6)), np.empty((2, 3))
    fused, fused_cov, fused_ends = np.empty(6), np.empty((6, 6)), np.empty((2, 3))
    away, before = np.ones(len(ids), np.bool_), np.empty(len(ids), np.int64)
    low, high, rows = np.empty(3), np.empty(3), np.empty(len(kept_ids) + 1, np.int64)
    for c in range(3):
        low[c], high[c] = np.inf, -np.inf
    for i in range(len(ids)):
        before[i] = i
        _widen(ends[i], low, high)
    reach = near[2] + near[1] / near[0]
    count = within(low, high, reach, kept_ends, rows)
    for i in range(len(ids)):
        _copy(pluecker[i], cov[i], ends[i], line, line_cov, line_ends)
        line_id, line_views, line_sigma = ids[i], views[i], sigma[i]
        while True:
            k, distance = twin(line, line_cov, line_ends, kept_pluecker, kept_cov, kept_ends, rows[:count], gone, near)
            j, nearer = twin(line, line_cov, line_ends, to_pluecker, to_cov, to_ends, before[:i], away, near)
            if nearer < distance:
                twin_line, twin_cov, twin_ends = to_pluecker[j], to_cov[j], to_ends[j]
                line_id, line_views, away[j] = min(line_id, to_ids[j]), line_views + to_views[j], True
            elif k >= 0:
                twin_line, twin_cov, twin_ends = kept_pluecker[k], kept_cov[k], kept_ends[k]
                line_id, line_views, gone[k] = min(line_id, kept_ids[k]), line_views + kept_views[k], True
            else:
                break
            line_sigma = fuse(twin_line, twin_cov, twin_ends, line, line_cov, line_ends, fused, fused_cov, fused_ends)
            line, fused = fused, line
            line_cov, fused_cov = fused_cov, line_cov
            line_ends, fused_ends = fused_ends, line_ends
            if _widen(line_ends, low, high):
                count = within(low, high, reach, kept_ends, rows)
        namesake = namesakes[i] if line_id == ids[i] else -1
        if _prevails(i, line_id, line_sigma, namesake, kept_sigma, gone, to_ids, to_sigma, away):
            _copy(line, line_cov, line_ends, to_pluecker[i], to_cov[i], to_ends[i])
            to_ids[i], to_views[i], to_sigma[i], away[i] = line_id, line_views, line_sigma, False
    for i in range(len(ids)):
        stays[i] = not away[i]


@inner
def _copy(line, cov, ends, to_line, to_cov, to_ends):
    """Line (6,), cov (6, 6) and ends (2, 3), by elements: assigning whole arrays compiles seconds of error messages."""
    for k in range(6):
        to_line[k] = line[k]
        for m in range(6):
            to_cov[k, m] = cov[k, m]
    for k in range(2):
        for m in range(3):
            to_ends[k, m] = ends[k, m]


@inner
def _prevails(i, line_id, line_sigma, namesake, kept_sigma, gone, to_ids, to_sigma, away):
    """Whether landmark i is more certain than the others of its id, which then go: the kept row namesake (-1: none) and
    landmarks before it."""
    if namesake >= 0 and not gone[namesake]:
        if line_sigma >= kept_sigma[namesake]:
            return False
        gone[namesake] = True
    prevails = True
    for j in range(i):
        if not away[j] and to_ids[j] == line_id:
            prevails = line_sigma < to_sigma[j]
            away[j] = prevails
    return prevails


@inner
def _widen(points, low, high):
    """Takes points (N, 3) into the box, with some room around them; whether it grew."""
    grew = False
    for k in range(len(points)):
        for c in range(3):
            if points[k, c] < low[c]:
                low[c], grew = points[k, c] - ROOM, True
            if points[k, c] > high[c]:
                high[c], grew = points[k, c] + ROOM, True
    return grew
