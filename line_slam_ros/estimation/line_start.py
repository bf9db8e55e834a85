"""First estimates of lines from views with known poses, many lines at a time."""
from __future__ import annotations

import numpy as np

from line_slam_ros.estimation.triangulation import has_parallax, plane_variance
from line_slam_ros.geometry.lie import rigid, rigid_inverse
from line_slam_ros.geometry.lines import line_from_many_planes, observation_plane, transform_lines, trim
from line_slam_ros.kernel_cache import kernel
from line_slam_ros.types import F64, I64

MOST_VIEWS = 32  # evenly chosen when there are more
IN_FRONT = 0.5  # share of the feet that must lie in front of their cameras; a bad view may not stop a line


def start_from_planes(poses: F64, ends: F64, sigma: F64, count: I64, min_sine: float) -> tuple[F64, F64, np.ndarray]:
    """Lines (M, 6), |d| = 1, about origins (M, 3) in W from all their observation planes, and which of them (M,) hold.

    poses (M, K, 3, 4) = [R_WC, p_WC], ends (M, K, 2, 2) and their noise sigma (M, K, 2) across of the first count (M,)
    views of each. The origin is the first camera's centre. A line does not hold while no two planes meet at an angle
    whose sine is min_sine and which noise does not explain, whatever the order of the ends (it is parallel to the
    motion, or in one plane with it, or the cameras have only turned), or when it lies behind most cameras.
    """
    views = min(MOST_VIEWS, poses.shape[1])
    chosen = np.minimum(np.arange(views), count[:, None] - 1)
    many = count > views
    chosen[many] = np.rint(np.linspace(0, count[many] - 1, views).T).astype(np.int64)
    valid = np.arange(views) < count[:, None]
    each = np.arange(len(count))[:, None]
    poses, ends, sigma, origin = poses[each, chosen], ends[each, chosen], sigma[each, chosen], poses[:, 0, :, 3].copy()
    T_OC = rigid(poses[..., :3], poses[..., 3] - origin[:, None])
    planes = np.nan_to_num(observation_plane(T_OC, ends)) * valid[..., None]
    lines = line_from_many_planes(planes)
    feet = trim(transform_lines(rigid_inverse(T_OC), lines[:, None, None])[:, :, 0], ends)
    in_front = np.sum(np.isfinite(feet).all(axis=(-2, -1)) & valid, axis=1) > IN_FRONT * valid.sum(axis=1)
    return lines, origin, _parallax(planes, ends, sigma, np.minimum(count, views), min_sine) & in_front


@kernel
def _parallax(planes, ends, sigma, count, min_sine):
    """Which lines (M,) have it in their first count (M,) views of planes (M, K, 4)."""
    found, noise2 = np.empty(len(planes), np.bool_), np.empty(planes.shape[1])
    for i in range(len(planes)):
        for k in range(count[i]):
            noise2[k] = plane_variance(ends[i, k], sigma[i, k])
        found[i] = has_parallax(planes[i, :, :3], noise2, count[i], min_sine)
    return found
