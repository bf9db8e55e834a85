"""The line experiment as arrays: every view of every line with its known camera pose, sorted by line."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from line_slam_ros.experiment.files import Experiment
from line_slam_ros.types import F64, I64


@dataclass(frozen=True, slots=True)
class LineProblem:
    """L lines to be estimated from M views. Line i has the views first[i] <= k < last[i]; none when they are equal.

    The first view of a line in the order of the file is its host: that camera's centre is the line's origin.
    """

    segments: F64  # (L, 2, 3) m, true end points in W
    first: I64  # (L,)
    last: I64  # (L,)
    frame: I64  # (M,) row of the pose of each view
    poses: F64  # (M, 3, 4) = [R_WC, p_WC]
    ends: F64  # (M, 2, 2) normalised

    @staticmethod
    def of(experiment: Experiment) -> LineProblem:
        """Views sorted by line, in the order of the file within a line. Lines that nothing sees are kept, too.

        ValueError when there are no views at all.
        """
        views, lines = experiment.views, len(experiment.segments)
        if not len(views.line):
            raise ValueError('no line was observed: there is nothing to estimate')
        order = np.argsort(views.line, kind='stable')
        bounds = np.searchsorted(views.line[order], np.arange(lines + 1))
        frame = views.frame[order]
        return LineProblem(experiment.segments, bounds[:-1].copy(), bounds[1:].copy(), frame,
                           np.ascontiguousarray(experiment.T_WC[frame, :3]), np.ascontiguousarray(views.ends[order]))

    @property
    def count(self) -> I64:
        """Views of each line (L,)."""
        return self.last - self.first

    @property
    def line(self) -> I64:
        """Line of each view (M,)."""
        return np.repeat(np.arange(len(self.first)), self.count)

    def origin(self) -> F64:
        """Centre of each line's host camera (L, 3); NaN for lines without views."""
        origin = np.full((len(self.first), 3), np.nan)
        seen = self.count > 0
        origin[seen] = self.poses[self.first[seen], :, 3]
        return origin

    def only(self, chosen: np.ndarray) -> LineProblem:
        """The same lines with the views of chosen (M,) bool. Where a host is left out, another view takes its place."""
        last = np.cumsum(np.bincount(self.line[chosen], minlength=len(self.first)))
        return LineProblem(self.segments, np.concatenate([[0], last[:-1]]), last, self.frame[chosen],
                           self.poses[chosen], self.ends[chosen])

    def padded(self, views: F64) -> F64:
        """What belongs to each view (M, ...) as a table (L, K, ...) of K views at most; rows beyond count repeat the
        line's last view."""
        count = self.count
        if not len(views):
            return np.zeros((len(count), 1, *views.shape[1:]))
        columns = np.minimum(np.arange(max(1, count.max(initial=1))), np.maximum(count, 1)[:, None] - 1)
        return views[np.minimum(self.first[:, None] + columns, len(views) - 1)]
