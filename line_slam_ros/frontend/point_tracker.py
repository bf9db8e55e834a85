"""Corners followed from image to image."""
from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from line_slam_ros.config import Points
from line_slam_ros.frontend import patch_kernels as patches
from line_slam_ros.frontend.corner_detector import new_corners
from line_slam_ros.frontend.rows import Rows
from line_slam_ros.frontend.two_view import static_matches
from line_slam_ros.geometry.camera import Camera
from line_slam_ros.types import F64, I64, U8, PointObservations

LEVELS = 4  # of the pyramid: displacements of up to about 2^3 x 7 px from the prediction are found
BORDER = patches.RADIUS + 2.0  # px, where a patch still fits
REFILL = 0.9  # of max_count: below, new corners are looked for
COARSE_STEPS, FINE_STEPS = 10, 5
SAME_PATCH = 0.85  # correlation above which a patch still shows what it showed when it was learned
STRAY_PX = 1.5  # the learned patch must be found this near to where the last image puts it
SHAPE = (0.5, 2.0)  # range of the area ratio for which the learned patch is kept
LOOK_BACK = 10  # images; slow drift off the epipolar line shows over this base line, not between neighbours
GYRO_SIGMA = 4e-3  # rad per image: an uncalibrated gyro's bias of 0.08 rad/s at 20 Hz


@dataclass
class Corners(Rows):
    """Living tracks."""

    ids: I64
    ages: I64  # images since detection
    uv: F64  # (N, 2) px as received
    x: F64  # (N, 2) normalised
    templates: NDArray[np.float32]  # (N, SIZE + 2, LANES + 2) the learned patch
    inverses: F64  # (N, 6, 6)
    shapes: F64  # (N, 2, 2) affine map of the learned patch into the newest image

    @staticmethod
    def blank(n: int) -> Corners:
        """n rows, not filled in except ages and shapes."""
        return Corners(np.empty(n, np.int64), np.zeros(n, np.int64), np.empty((n, 2)), np.empty((n, 2)),
                       np.empty((n, patches.SIZE + 2, patches.LANES + 2), np.float32), np.empty((n, 6, 6)),
                       np.tile(np.eye(2), (n, 1, 1)))


@dataclass
class _Past:
    """Where the corners of an earlier image were."""

    ids: I64
    x: F64
    R_CnCp: F64  # rotation from that image to the newest


class PointTracker:
    """Corners with ids that are never reused.

    Each corner is first carried from the previous image by translation, then matched against the patch learned when it
    was detected, by an affine warp: so errors do not add up. A patch that has changed too much is learned anew. Tracks
    that fail the way back to the previous image, or the epipolar constraint with the previous image or with one
    LOOK_BACK images ago, end.
    """

    def __init__(self, camera: Camera, config: Points):
        self._camera, self._config = camera, config
        self._next_id = 0
        self.reset()

    def reset(self) -> None:
        """Forget every track; ids go on counting."""
        self.corners = Corners.blank(0)
        self._image: U8 | None = None
        self._pyramid: tuple[U8, ...] = ()
        self.x_turned: F64 = np.empty((0, 2))  # where the rotation alone would have put the corners of the newest image
        self.motion_x: F64 = np.empty((0, 2))  # and what is left
        self._past: deque[_Past] = deque(maxlen=LOOK_BACK)

    def forget(self, ids: I64) -> None:
        """End these tracks."""
        self.corners = self.corners.select(~np.isin(self.corners.ids, ids))

    def observations(self) -> PointObservations:
        """The corners in the newest image."""
        c = self.corners
        return PointObservations(c.ids.copy(), c.uv.copy(), c.x.copy())

    def track(self, image: U8, R_CnCp: F64 | None) -> None:
        """Move every track into image (H, W); R_CnCp turns rays of the previous camera into this one."""
        previous, self._pyramid, self._image = self._pyramid, pyramid(image), image
        if not len(self.corners):
            return
        before, corners = self.corners, self.corners.select(slice(None))
        corners.uv = self._predict(R_CnCp)
        turns = self._turns(R_CnCp)
        corners.shapes = turns @ before.shapes
        good = self._match(previous, before.uv, turns, corners)
        corners.x = self._camera.normalise(corners.uv)
        corners.ages = before.ages + 1
        good &= self._inside(corners.uv) & np.isfinite(corners.x).all(axis=1)
        index = self._static(before.x, corners, good, R_CnCp)
        self.corners = corners.select(index)
        self.x_turned = turn(R_CnCp, before.x[index])
        self.motion_x = self.corners.x - self.x_turned

    def detect(self) -> None:
        """New corners where there is room."""
        count = self._config.max_count
        if len(self.corners) > REFILL * count or count == 0:
            return
        cell = float(np.sqrt(self._image.size / count))
        uv = new_corners(self._image, self._pyramid[1], self.corners.uv, count - len(self.corners),
                         self._config.min_distance_px, cell, self._config.min_contrast)
        fresh = Corners.blank(len(uv))
        fresh.uv, fresh.x, good = uv, self._camera.normalise(uv), np.ones(len(uv), np.bool_)
        patches.learn(self._pyramid[0], uv, fresh.templates, fresh.inverses, good)
        fresh = fresh.select(good & self._inside(uv) & np.isfinite(fresh.x).all(axis=1))
        fresh.ids = np.arange(self._next_id, self._next_id + len(fresh))
        self._next_id += len(fresh)
        self.corners = self.corners.extended(fresh)

    def _predict(self, R_CnCp: F64 | None) -> F64:
        """Pixels (N, 2) where the corners would be, had the camera only turned."""
        uv = self._camera.project(turn(R_CnCp, self.corners.x))
        return np.where(np.isfinite(uv).all(axis=1, keepdims=True), uv, self.corners.uv)

    def _turns(self, R_CnCp: F64 | None) -> F64:
        """Maps (N, 2, 2) of small surroundings by the rotation: the derivative of turn(x), the lens left out."""
        if R_CnCp is None:
            return np.tile(np.eye(2), (len(self.corners), 1, 1))
        rays = self.corners.x @ R_CnCp[:, :2].T + R_CnCp[:, 2]
        moved = rays[:, :2, None] / rays[:, 2:, None]
        return (R_CnCp[:2, :2] - moved * R_CnCp[2, :2]) / rays[:, 2:, None]

    def _match(self, previous: tuple[U8, ...], start: F64, turns: F64, corners: Corners) -> NDArray[np.bool_]:
        """Improve the predictions corners.uv in place; mask (N,) of those that were found."""
        n, newest, back_turns = len(start), self._pyramid, np.linalg.inv(turns)
        good, back_good = np.ones(n, np.bool_), np.ones(n, np.bool_)
        patches.follow(previous, newest, start, back_turns, corners.uv, 1, COARSE_STEPS, good)
        uv, shapes, score = corners.uv.copy(), corners.shapes.copy(), np.empty(n)
        patches.align(newest[0], corners.templates, corners.inverses, uv, shapes, FINE_STEPS, score)
        area, stray = np.linalg.det(shapes), np.hypot(*(uv - corners.uv).T)
        same = (score > SAME_PATCH) & (stray < STRAY_PX) & (area > SHAPE[0]) & (area < SHAPE[1])
        patches.follow(previous[:1], newest[:1], start, back_turns, corners.uv, 0, COARSE_STEPS, changed := ~same)
        corners.uv[same], corners.shapes[same] = uv[same], shapes[same]
        good = same | changed
        back = start.copy()
        patches.follow(newest[:1], previous[:1], corners.uv, turns, back, 0, COARSE_STEPS, back_good)
        good &= back_good & (np.hypot(*(back - start).T) < self._config.round_trip_px)
        relearn = good & ~same
        corners.shapes[relearn] = np.eye(2)
        patches.learn(newest[0], corners.uv, corners.templates, corners.inverses, relearn)
        return good & (same | relearn)

    def _inside(self, uv: F64) -> NDArray[np.bool_]:
        h, w = self._image.shape
        return ((uv > BORDER) & (uv < np.array([w, h]) - 1.0 - BORDER)).all(axis=1)

    def _static(self, x_before: F64, corners: Corners, good: NDArray[np.bool_], R_CnCp: F64 | None) -> I64:
        """Indices of the good corners that agree with one rigid motion since the previous and since an older image."""
        threshold = self._config.epipolar_px / self._camera.focal
        index = np.flatnonzero(good)
        keep, R = static_matches(x_before[index], corners.x[index], R_CnCp, GYRO_SIGMA, threshold)
        index = index[keep]
        for past in self._past:
            past.R_CnCp = R @ past.R_CnCp
        if len(self._past) == LOOK_BACK:
            past = self._past[0]
            _, then, now = np.intersect1d(past.ids, corners.ids[index], assume_unique=True, return_indices=True)
            keep, _ = static_matches(past.x[then], corners.x[index[now]], past.R_CnCp, GYRO_SIGMA, 2.0 * threshold)
            index = np.delete(index, now[~keep])
        self._past.append(_Past(corners.ids[index], corners.x[index], np.eye(3)))
        return index


def turn(R_CnCp: F64 | None, x: F64) -> F64:
    """Normalised coordinates (..., 2) after the rotation of the camera; NaN behind it; as they are if it is unknown."""
    if R_CnCp is None:
        return x
    rays = x @ R_CnCp[:, :2].T + R_CnCp[:, 2]
    return rays[..., :2] / np.where(rays[..., 2:] > 0.0, rays[..., 2:], np.nan)


def pyramid(image: U8) -> tuple[U8, ...]:
    """Images, each half the size of the one before."""
    levels = [image]
    for _ in range(LEVELS - 1):
        levels.append(cv2.pyrDown(levels[-1]))
    return tuple(levels)
