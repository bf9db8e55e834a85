"""Straight edges followed from image to image."""
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from line_slam_ros.config import Lines
from line_slam_ros.frontend import edge_kernels as edge
from line_slam_ros.frontend.line_detector import detect
from line_slam_ros.frontend.rows import Rows
from line_slam_ros.geometry.camera import Camera
from line_slam_ros.types import F64, I64, U8, LineObservations

SIGMA_FLOOR_PX = 0.2  # what a fit to one image cannot know: blur, lens model, edges that are not sharp
SAME_EDGE_PX = 3.0
REFILL = 0.9  # of max_count: below, new segments are looked for
DETECT_EVERY = 5  # images, at most
SAME_PROFILE = 0.6  # correlation with the profile in the previous image
ON_EDGE, ON_EDGE_NEW = 0.5, 0.7  # share of the samples that must lie on the fitted line
HYSTERESIS = 0.7  # a track may become this much shorter than a new segment must be
FLOW_REACH_PX = 60.0  # corners this near tell how a new segment moves


@dataclass
class Segments(Rows):
    """Living tracks."""

    ids: I64
    ages: I64  # images since detection
    ends: F64  # (M, 2, 2) px of the undistorted canvas
    variance: F64  # (M, 2) px^2 of each end across the segment
    motion: F64  # (M, 2, 2) px, last displacement beyond that of the rotation
    profiles: NDArray[np.float32]  # (M, SAMPLES, 2 HALF + 1) grey across the segment, normalised

    @staticmethod
    def blank(n: int) -> Segments:
        """n rows, not filled in except ages and motion."""
        return Segments(np.empty(n, np.int64), np.zeros(n, np.int64), np.empty((n, 2, 2)), np.empty((n, 2)),
                        np.zeros((n, 2, 2)), np.empty((n, edge.SAMPLES, 2 * edge.HALF + 1), np.float32))


class LineTracker:
    """Moving-edge tracks of segments on an undistorted canvas; ids are never reused.

    A segment is predicted (rotation of the camera and its own last motion), shifted across its normal to where the grey
    profiles of the previous image fit best, and then put on the extremum of the gradient: what is reported does not
    depend on earlier images, so nothing drifts.
    """

    def __init__(self, camera: Camera, config: Lines):
        self._config = config
        self.canvas, self._half_canvas = camera.rectified(), camera.rectified(0.5)
        self._lens = self._lens_table(camera)
        self._next_id = 0
        self.reset()

    def _lens_table(self, camera: Camera) -> F64:
        """Received pixel (H / LENS_STEP, W / LENS_STEP, 2) of the undistorted ones; NaN where there is none."""
        width, height = self.canvas.size
        v, u = np.mgrid[:height + edge.LENS_STEP:edge.LENS_STEP, :width + edge.LENS_STEP:edge.LENS_STEP]
        uv = camera.project(self.canvas.normalise(np.stack([u, v], axis=-1).reshape(-1, 2)))
        return np.ascontiguousarray(uv.reshape(*u.shape, 2))

    def reset(self) -> None:
        """Forget every track; ids go on counting."""
        self.segments = Segments.blank(0)
        self._image: U8 | None = None
        self._wait = 0

    def forget(self, ids: I64) -> None:
        """End these tracks."""
        self.segments = self.segments.select(~np.isin(self.segments.ids, ids))

    def observations(self) -> LineObservations:
        """The segments in the newest image."""
        s = self.segments
        sigma = np.sqrt(s.variance + SIGMA_FLOOR_PX**2) / self.canvas.fx
        return LineObservations(s.ids.copy(), self.canvas.normalise(s.ends), sigma)

    def take(self, image: U8) -> None:
        """Take the newest image (H, W), as received."""
        self._image = cv2.GaussianBlur(image, (3, 3), 0)

    def track(self, R_CnCp: F64 | None, x: F64, motion_x: F64, pace: float = 1.0) -> None:
        """Move every track into the newest image.

        R_CnCp turns rays of the previous camera into this one; beyond that, corners at x (N, 2) moved by motion_x.
        pace: time since the previous image, in units of that before it.
        """
        segments = self.segments
        if not len(segments):
            return
        turned = self._turn(R_CnCp)
        new = segments.ages == 0
        segments.motion[new] = self._flow(turned[new], x, motion_x)
        segments.motion[~new] *= pace
        segments.ends = turned + segments.motion
        score = np.empty(len(segments))
        edge.follow(self._image, self._lens, segments.profiles, segments.ends, score)
        segments.motion = segments.ends - turned
        segments.ages = segments.ages + 1
        good = self._measure(segments, ON_EDGE, HYSTERESIS * self._config.min_length_px) & (score > SAME_PROFILE)
        self.segments = self._apart(segments.select(good), len(segments))
        edge.remember(self._image, self._lens, self.segments.ends, self.segments.profiles)

    def _measure(self, segments: Segments, on_edge: float, shortest: float) -> NDArray[np.bool_]:
        """Put the segments on their edges, in place; mask (M,) of those that are there and long enough."""
        support = np.empty(len(segments))
        edge.measure(self._image, self._lens, self._config.min_contrast, segments.ends, segments.variance, support)
        length = np.linalg.norm(segments.ends[:, 1] - segments.ends[:, 0], axis=1)
        return (support > on_edge) & (length > shortest)

    def _apart(self, segments: Segments, of: int) -> Segments:
        """Without those that lie on an earlier one of the first so many; rows are in order of their age."""
        doubled = np.zeros(len(segments), np.bool_)
        edge.duplicates(segments.ends, SAME_EDGE_PX, of, doubled)
        return segments.select(~doubled)

    def _turn(self, R_CnCp: F64 | None) -> F64:
        """Ends (M, 2, 2) px where they would be, had the camera only turned."""
        if R_CnCp is None:
            return self.segments.ends.copy()
        rays = self.canvas.normalise(self.segments.ends) @ R_CnCp[:, :2].T + R_CnCp[:, 2]
        return self.canvas.project(rays[..., :2] / np.maximum(rays[..., 2:], 0.1))

    def _flow(self, ends: F64, x: F64, motion_x: F64) -> F64:
        """Mean motion (M, 2, 2) px of the corners around each segment's middle, by Gaussian weights; 0 far from any."""
        uv, motion = self.canvas.project(x), motion_x * (self.canvas.fx, self.canvas.fy)
        distance = np.linalg.norm(ends.mean(axis=1)[:, None] - uv, axis=-1) / FLOW_REACH_PX
        weight = np.exp(-0.5 * distance**2)
        mean = (weight @ motion) / (weight.sum(axis=1, keepdims=True) + 0.1)
        return np.repeat(mean[:, None], 2, axis=1)

    def detect(self) -> None:
        """New segments, every few images, while there is room."""
        self._wait -= 1
        room = self._config.max_count - len(self.segments)
        if self._wait > 0 or len(self.segments) > REFILL * self._config.max_count or room == 0:
            return
        self._wait = DETECT_EVERY
        half = cv2.remap(self._image, self._half_canvas.map1, self._half_canvas.map2, cv2.INTER_LINEAR)
        ends = 2.0 * detect(half, 0.5 * self._config.min_length_px)
        fresh = Segments.blank(len(ends))
        fresh.ends = ends
        old = len(self.segments)
        fresh = self._apart(self.segments.extended(fresh), old).select(slice(old, None))
        fresh = fresh.select(self._measure(fresh, ON_EDGE_NEW, self._config.min_length_px))
        both = self._apart(self.segments.extended(fresh), old + len(fresh))
        fresh = both.select(slice(old, self._config.max_count))
        fresh.ids = np.arange(self._next_id, self._next_id + len(fresh))
        self._next_id += len(fresh)
        edge.remember(self._image, self._lens, fresh.ends, fresh.profiles)
        self.segments = self.segments.extended(fresh)
