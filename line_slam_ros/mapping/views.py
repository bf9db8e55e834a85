"""The views of each landmark: a fixed-size, evenly thinned record of where a segment was seen from.

A view is kept as it was observed (camera pose and segment), not as a 3D point: what follows from it can be computed
again, exactly, whenever the landmark's estimate changes.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from line_slam_ros.kernel_cache import inner, kernel
from line_slam_ros.mapping.table import IdTable
from line_slam_ros.types import F64, I64


def view_columns(capacity: int) -> dict[str, tuple[tuple[int, ...], DTypeLike]]:
    """Columns of an IdTable that keeps up to capacity (even) views of each record, half as many at least."""
    return {
        'poses': ((capacity, 3, 4), np.float64),  # [R_WC, p_WC] of each view
        'ends': ((capacity, 2, 2), np.float64),  # observed segment, normalised
        'sigma': ((capacity, 2), np.float64),  # its standard deviation across, normalised
        'count': ((), np.int64),  # views kept
        'seen': ((), np.int64),  # views offered
    }


def add_view(table: IdTable, rows: I64, T_WC: F64, ends: F64, sigma: F64) -> None:
    """One camera's segments (M, 2, 2) with sigma (M, 2) for the records in rows (M,) of a table with view_columns.

    A full record drops every second view and from then on takes every second one, and so on: memory is bounded, the
    views stay evenly spread over the landmark's life, the first one stays, and nothing is random.
    """
    _add_view(rows, np.ascontiguousarray(T_WC[:3], float), np.ascontiguousarray(ends, float),
              np.ascontiguousarray(sigma, float), table['poses'], table['ends'], table['sigma'],
              table['count'], table['seen'])


@kernel
def _add_view(rows, pose, ends, sigma, all_poses, all_ends, all_sigma, count, seen):
    capacity = all_poses.shape[1]
    for m in range(len(rows)):
        i = rows[m]
        stride = 1
        while seen[i] >= stride * capacity:
            stride *= 2
        if seen[i] % stride == 0:
            if count[i] == capacity:
                count[i] = capacity // 2
                for k in range(1, count[i]):
                    _write(all_poses[i, 2 * k], all_ends[i, 2 * k], all_sigma[i, 2 * k],
                           all_poses[i, k], all_ends[i, k], all_sigma[i, k])
            k = count[i]
            _write(pose, ends[m], sigma[m], all_poses[i, k], all_ends[i, k], all_sigma[i, k])
            count[i] += 1
        seen[i] += 1


@inner
def _write(pose, ends, sigma, to_pose, to_ends, to_sigma):
    for r in range(3):
        for c in range(4):
            to_pose[r, c] = pose[r, c]
    for e in range(2):
        to_sigma[e] = sigma[e]
        for c in range(2):
            to_ends[e, c] = ends[e, c]
