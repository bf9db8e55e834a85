"""New straight segments in an undistorted image."""
from __future__ import annotations

import cv2
import numpy as np

from line_slam_ros.frontend import edge_kernels as edge
from line_slam_ros.types import F64, U8

SHORTEST = 0.5  # of the wanted length: pieces that may still be joined
COLLINEAR_PX = 1.5
GAP_PX = 12.0  # across which collinear pieces are joined


class LineDetector:
    """OpenCV's line segment detector (von Gioi et al., 2012) on the image at half size, collinear pieces joined."""

    def __init__(self) -> None:
        self._lsd = cv2.createLineSegmentDetector(cv2.LSD_REFINE_NONE, 1.0)

    def detect(self, image: U8, min_length_px: float) -> F64:
        """Segments (M, 2, 2) px of image (H, W), longest first, brighter on the side of the normal (-t_v, t_u)."""
        found = self._lsd.detect(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))[0]
        if found is None:
            return np.empty((0, 2, 2))
        ends = 2.0 * np.asarray(found, np.float64).reshape(-1, 2, 2) + 0.5  # centre of the first 2 x 2 pixels
        ends = longest_first(ends, SHORTEST * min_length_px)
        ends = orient(image, ends)
        joined = np.zeros(len(ends), np.bool_)
        edge.join(ends, COLLINEAR_PX, GAP_PX, joined)
        return longest_first(ends[~joined], 0.8 * min_length_px)


def longest_first(ends: F64, shortest: float) -> F64:
    """Segments ends (M, 2, 2) of at least this length, by falling length."""
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    order = np.argsort(-length, kind='stable')
    return ends[order[length[order] >= shortest]]


def orient(image: U8, ends: F64) -> F64:
    """The same segments (M, 2, 2), the ends swapped where the image (H, W) is darker on the side of the normal."""
    along = np.linspace(0.1, 0.9, 9)[None, :, None]
    middle = ends[:, :1] * (1.0 - along) + ends[:, 1:] * along
    t = ends[:, 1:] - ends[:, :1]
    normal = np.stack([-t[..., 1], t[..., 0]], axis=-1) / np.linalg.norm(t, axis=-1, keepdims=True)
    limit = np.array(image.shape)[::-1] - 1

    def grey(offset: float) -> F64:
        uv = np.clip(np.rint(middle + offset * normal), 0, limit).astype(int)
        return image[uv[..., 1], uv[..., 0]].mean(axis=1)

    darker = grey(2.0) < grey(-2.0)
    return np.where(darker[:, None, None], ends[:, ::-1], ends)
