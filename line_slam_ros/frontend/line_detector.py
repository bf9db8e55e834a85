"""New straight segments in an undistorted image."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from line_slam_ros.frontend.segment_kernels import segments
from line_slam_ros.frontend.segment_sets import join
from line_slam_ros.types import F64, U8

SHORTEST = 0.5  # of the wanted length: pieces that may still be joined
NEARLY = 0.8  # of the wanted length: the rest may be found when the edge is measured
COLLINEAR_PX = 0.75
GAP_PX = 6.0  # across which collinear pieces are joined


def detect(image: U8, min_length_px: float, work: tuple[NDArray, ...]) -> F64:
    """Segments (M, 2, 2) px of image (H, W), longest first, brighter on the side of the normal (-t_v, t_u).

    work: segment_kernels.buffers(H, W).
    """
    ends = longest_first(segments(image, SHORTEST * min_length_px, work), SHORTEST * min_length_px)
    joined = np.zeros(len(ends), np.bool_)
    join(ends, COLLINEAR_PX, GAP_PX, joined)
    return longest_first(ends[~joined], NEARLY * min_length_px)


def longest_first(ends: F64, shortest: float) -> F64:
    """Segments ends (M, 2, 2) of at least this length, by falling length."""
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    order = np.argsort(-length, kind='stable')
    return ends[order[length[order] >= shortest]]
