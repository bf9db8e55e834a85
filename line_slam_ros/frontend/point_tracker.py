"""Corners followed from image to image."""
from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from line_slam_ros.config import Points
from line_slam_ros.frontend.affine_kernels import learn
from line_slam_ros.frontend.corner_detector import new_corners
from line_slam_ros.frontend.patch_kernels import AREA, RADIUS
from line_slam_ros.frontend.patch_matching import match, predict
from line_slam_ros.frontend.rows import Rows
from line_slam_ros.frontend.smoothing import halve
from line_slam_ros.frontend.two_view import static_matches
from line_slam_ros.geometry.camera import Camera
from line_slam_ros.types import F64, I64, U8, PointObservations

LEVELS = 4  # of the pyramid: displacements of up to about 2^3 x 7 px from the prediction are found
BORDER = RADIUS + 2.0  # px, where a patch still fits
REFILL = 0.9  # of max_count: below, new corners are looked for
FEW = 0.7  # of max_count: below, they cannot wait
LOOK_BACK = 10  # images; slow drift off the epipolar line shows over this base line, not between neighbours
GYRO_SIGMA = 4e-3  # rad per image: an uncalibrated gyro's bias of 0.08 rad/s at 20 Hz


@dataclass
class Corners(Rows):
    """Living tracks."""

    ids: I64
    ages: I64  # images since detection
    uv: F64  # (N, 2) px as received
    x: F64  # (N, 2) normalised
    motion: F64  # (N, 2) normalised, last displacement beyond that of the rotation
    shapes: F64  # (N, 2, 2) affine map of the learned patch into the newest image
    slots: I64  # where the tracker keeps the learned patch

    @staticmethod
    def blank(n: int) -> Corners:
        """n rows, not filled in except ages, motion and shapes."""
        return Corners(np.empty(n, np.int64), np.zeros(n, np.int64), np.empty((n, 2)), np.empty((n, 2)),
                       np.zeros((n, 2)), np.tile(np.eye(2), (n, 1, 1)), np.empty(n, np.int64))


@dataclass
class _Past:
    """Where the corners of an earlier image were."""

    ids: I64  # rising, as those of the corners
    x: F64
    R_CnC0: F64  # rotation from the first image to that


class PointTracker:
    """Corners with ids that are never reused.

    Each corner is looked for where rotation and its own last motion put it, by an affine warp of the patch learned when
    it was detected: so errors do not add up. If it is not there it is carried from the previous image by translation,
    coarse to fine, and tried again; a patch that has changed too much is learned anew. Tracks that fail the way back to
    the previous image, or the epipolar constraint with it or with one LOOK_BACK images ago, end.
    """

    def __init__(self, camera: Camera, config: Points):
        self._camera, self._config = camera, config
        self._learned = (np.empty((config.max_count, 3, AREA), np.float32),
                         np.empty((config.max_count, 2, 7)), np.empty((config.max_count, 6, 6)))
        self._next_id = 0
        size = camera.calibration.height, camera.calibration.width
        self._row = np.empty(size[1] + 4, np.uint16)
        self._halves = [halves(size), halves(size)]  # of the newest image, and of the one before
        self.reset()

    def reset(self) -> None:
        """Forget every track; ids go on counting."""
        self.corners = Corners.blank(0)
        self._pyramid: tuple[U8, ...] = ()  # of the newest image
        self._past: deque[_Past] = deque(maxlen=LOOK_BACK)
        self._R_CnC0 = np.eye(3)

    def forget(self, ids: I64) -> None:
        """End these tracks."""
        if len(ids):
            self.corners = self.corners.select(~np.isin(self.corners.ids, ids))

    def observations(self) -> PointObservations:
        """The corners in the newest image."""
        c = self.corners
        return PointObservations(c.ids.copy(), c.uv.copy(), c.x.copy())

    def track(self, image: U8, R_CnCp: F64 | None, pace: float = 1.0) -> None:
        """Move every track into image (H, W); R_CnCp turns rays of the previous camera into this one.

        pace: time since the previous image, in units of that before it.
        """
        previous, self._pyramid = self._pyramid, (image, *self._halves[0])
        self._halves.reverse()
        for level, half in pairwise(self._pyramid):
            halve(level, self._row, half)
        if not len(self.corners):
            return
        before, n = self.corners, len(self.corners)
        x_turned, turns = np.empty((2 * n, 2)), np.empty((n, 2, 2))
        predict(np.eye(3) if R_CnCp is None else R_CnCp, before.x, before.motion, pace, x_turned[:n], x_turned[n:],
                turns)
        expected, uv, found = self._camera.project(x_turned), np.empty((n, 2)), np.empty(n, np.int64)
        match(previous, self._pyramid, before.uv, turns, expected[:n], expected[n:], before.slots,
              *self._learned, self._config.round_trip_px, BORDER, uv, before.shapes, found)
        relearn = found == 2
        learn(image, uv, before.slots, *self._learned, relearn)
        uv[(found == 0) | (found == 2) & ~relearn] = np.nan
        x = self._camera.normalise(uv)
        index = self._static(before.ids, before.x, x, np.flatnonzero(np.isfinite(x[:, 0])), R_CnCp)
        x = x[index]
        self.corners = Corners(before.ids[index], before.ages[index] + 1, uv[index], x, x - x_turned[index],
                               before.shapes[index], before.slots[index])

    def detect(self, wait: bool = False) -> None:
        """New corners where there is room; wait: only when there are FEW."""
        count = self._config.max_count
        if len(self.corners) > (FEW if wait else REFILL) * count or count == 0:
            return
        image, half_size = self._pyramid[:2]
        cell = float(np.sqrt(image.size / count))
        uv = new_corners(image, half_size, self.corners.uv, count - len(self.corners),
                         self._config.min_distance_px, cell, self._config.min_contrast)
        fresh = Corners.blank(len(uv))
        fresh.uv, fresh.x, good = uv, self._camera.normalise(uv), np.ones(len(uv), np.bool_)
        fresh.slots = np.delete(np.arange(count), self.corners.slots)[:len(uv)]
        learn(image, uv, fresh.slots, *self._learned, good)
        fresh = fresh.select(good & self._inside(uv) & np.isfinite(fresh.x).all(axis=1))
        fresh.ids = np.arange(self._next_id, self._next_id + len(fresh))
        self._next_id += len(fresh)
        self.corners = self.corners.extended(fresh)

    def _inside(self, uv: F64) -> NDArray[np.bool_]:
        h, w = self._pyramid[0].shape
        return ((uv > BORDER) & (uv < np.array([w, h]) - 1.0 - BORDER)).all(axis=1)

    def _static(self, ids: I64, x_before: F64, x: F64, index: I64, R_CnCp: F64 | None) -> I64:
        """Those rows of index that agree with one rigid motion since the previous and since an older image."""
        threshold = self._config.epipolar_px / self._camera.focal
        keep, R = static_matches(x_before[index], x[index], R_CnCp, GYRO_SIGMA, threshold)
        index, self._R_CnC0 = index[keep], R @ self._R_CnC0
        if len(self._past) == LOOK_BACK:
            past = self._past[0]
            then = np.searchsorted(past.ids, ids[index]).clip(max=len(past.ids) - 1)
            known = np.flatnonzero(past.ids[then] == ids[index]) if len(past.ids) else np.empty(0, np.int64)
            keep, _ = static_matches(past.x[then[known]], x[index[known]], self._R_CnC0 @ past.R_CnC0.T, GYRO_SIGMA,
                                     2.0 * threshold)
            static = np.ones(len(index), np.bool_)
            static[known] = keep
            index = index[static]
        self._past.append(_Past(ids[index], x[index], self._R_CnC0))
        return index


def halves(size: tuple[int, int]) -> tuple[U8, ...]:
    """Memory for the upper levels of a pyramid, each half the size (height, width) of the one before."""
    return tuple(np.empty([-(-side // 2**level) for side in size], np.uint8) for level in range(1, LEVELS))
