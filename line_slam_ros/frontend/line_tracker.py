"""Straight edges followed from image to image."""
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from line_slam_ros.config import Lines
from line_slam_ros.frontend import edge_kernels as edge
from line_slam_ros.frontend.edge_sampling import LENS_STEP, SAMPLES
from line_slam_ros.frontend.line_detector import detect
from line_slam_ros.frontend.rows import Rows
from line_slam_ros.frontend.segment_kernels import buffers
from line_slam_ros.frontend.segment_sets import duplicates
from line_slam_ros.frontend.smoothing import smooth
from line_slam_ros.frontend.stripes import BLUR, blur_of, displacement
from line_slam_ros.geometry.camera import Camera
from line_slam_ros.types import F64, I64, U8, LineObservations

SIGMA_FLOOR_PX = 0.2  # what a fit to one image cannot know: blur, lens model, edges that are not sharp
SAME_EDGE_PX = 3.0
REFILL = 0.9  # of max_count: below, new segments are looked for
FEW = 0.5  # of max_count: below, they cannot wait
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
    widths: F64  # (M,) px, equivalent width: stripes.look()
    stripes: F64  # (M, 2, 2), opposite steps to both sides: stripes.look()
    motion: F64  # (M, 2, 2) px, last displacement beyond that of the rotation
    slots: I64  # where the tracker keeps the grey profile

    @staticmethod
    def blank(n: int) -> Segments:
        """n rows, not filled in except ages and motion."""
        return Segments(np.empty(n, np.int64), np.zeros(n, np.int64), np.empty((n, 2, 2)), np.empty((n, 2)),
                        np.empty(n), np.empty((n, 2, 2)), np.zeros((n, 2, 2)), np.empty(n, np.int64))


class LineTracker:
    """Moving-edge tracks of segments on an undistorted canvas; ids are never reused.

    A segment is predicted (rotation of the camera and its own last motion), shifted across its normal to where the grey
    profiles of the previous image fit best, and then put on the extremum of the gradient, from which the sides of thin
    stripes are moved to where they really are: what is reported does not depend on earlier images, so nothing drifts.
    """

    def __init__(self, camera: Camera, config: Lines):
        self._config = config
        self.canvas, half_canvas = camera.canvas(), camera.canvas(0.5)
        self._half_maps, self._work = camera.maps(half_canvas), buffers(*half_canvas.size[::-1])
        self._image = np.zeros((camera.calibration.height, camera.calibration.width), np.uint8)  # smoothed
        self._row = np.empty(camera.calibration.width + 4, np.uint16)
        self._view = self._image, self._lens_table(camera)  # what the kernels look at
        self._profiles = np.empty((config.max_count, edge.WIDTH, SAMPLES), np.float32)
        self._next_id = 0
        self.reset()

    def _lens_table(self, camera: Camera) -> NDArray[np.float32]:
        """Received pixel (H / LENS_STEP, W / LENS_STEP, 2) of the undistorted ones; NaN where there is none."""
        width, height = self.canvas.size
        v, u = np.mgrid[:height + LENS_STEP:LENS_STEP, :width + LENS_STEP:LENS_STEP]
        uv = camera.project(self.canvas.normalise(np.stack([u, v], axis=-1).reshape(-1, 2)))
        return uv.reshape(*u.shape, 2).astype(np.float32)

    def reset(self) -> None:
        """Forget every track; ids go on counting."""
        self.segments = Segments.blank(0)
        self._blur: float | None = None  # px; None: not measured yet
        self._wait = 0

    def forget(self, ids: I64) -> None:
        """End these tracks."""
        if len(ids):
            self.segments = self.segments.select(~np.isin(self.segments.ids, ids))

    def observations(self) -> LineObservations:
        """The segments in the newest image, where their edges really are."""
        s = self.segments
        off, doubt = displacement(s.stripes, self._blur or BLUR)
        along = s.ends[:, 1] - s.ends[:, 0]
        normal = along[:, ::-1] * (-1.0, 1.0) / np.linalg.norm(along, axis=1, keepdims=True)
        sigma = np.sqrt(s.variance + doubt[:, None]**2 + SIGMA_FLOOR_PX**2) / self.canvas.fx
        return LineObservations(s.ids.copy(), self.canvas.normalise(s.ends + (off[:, None] * normal)[:, None]), sigma)

    def take(self, image: U8) -> None:
        """Take the newest image (H, W), as received."""
        smooth(image, self._row, self._image)

    def track(self, R_CnCp: F64 | None, x: F64, motion_x: F64, pace: float = 1.0) -> None:
        """Move every track into the newest image.

        R_CnCp turns rays of the previous camera into this one; beyond that, corners at x (N, 2) moved by motion_x.
        pace: time since the previous image, in units of that before it.
        """
        segments = self.segments
        if not len(segments):
            return
        turned = self._turn(R_CnCp)
        segments.motion *= pace
        new = segments.ages == 0
        if new.any():
            segments.motion[new] = self._flow(turned[new], x, motion_x)
        segments.ends = turned + segments.motion
        good = np.empty(len(segments), np.bool_)
        edge.follow(self._view, self._config.min_contrast, SAME_PROFILE, ON_EDGE,
                    HYSTERESIS * self._config.min_length_px, segments.slots, self._profiles, segments.ends,
                    segments.motion, segments.variance, segments.widths, segments.stripes, good)
        segments.ages += 1
        self.segments = self._apart(segments if good.all() else segments.select(good), len(segments))
        self._blur = blur_of(self.segments.widths, self.segments.stripes, self._blur)

    def _apart(self, segments: Segments, of: int) -> Segments:
        """Without those that lie on an earlier one of the first so many; rows are in order of their age."""
        doubled = np.empty(len(segments), np.bool_)
        duplicates(segments.ends, SAME_EDGE_PX, of, doubled)
        return segments.select(~doubled) if doubled.any() else segments

    def _turn(self, R_CnCp: F64 | None) -> F64:
        """Ends (M, 2, 2) px where they would be, had the camera only turned."""
        if R_CnCp is None:
            return self.segments.ends.copy()
        c, turned = self.canvas, np.empty_like(self.segments.ends)
        edge.turn(R_CnCp, (c.fx, c.fy), (c.cx, c.cy), self.segments.ends, turned)
        return turned

    def _flow(self, ends: F64, x: F64, motion_x: F64) -> F64:
        """Mean motion (M, 2, 2) px of the corners around each segment's middle, by Gaussian weights; 0 far from any."""
        uv, motion = self.canvas.project(x), motion_x * (self.canvas.fx, self.canvas.fy)
        distance = np.linalg.norm(ends.mean(axis=1)[:, None] - uv, axis=-1) / FLOW_REACH_PX
        weight = np.exp(-0.5 * distance**2)
        mean = (weight @ motion) / (weight.sum(axis=1, keepdims=True) + 0.1)
        return np.repeat(mean[:, None], 2, axis=1)

    def detect(self, wait: bool = False) -> bool:
        """New segments, every few images, while there is room; did it look? wait: only when there are FEW."""
        self._wait -= 1
        room, count = self._config.max_count - len(self.segments), len(self.segments)
        if self._wait > 0 or room == 0 or count > (FEW if wait else REFILL) * self._config.max_count:
            return False
        self._wait = DETECT_EVERY
        half = cv2.remap(self._image, *self._half_maps, cv2.INTER_LINEAR)
        ends = 2.0 * detect(half, 0.5 * self._config.min_length_px, self._work)
        fresh = Segments.blank(len(ends))
        fresh.ends = ends
        old = len(self.segments)
        fresh = self._apart(self.segments.extended(fresh), old).select(slice(old, None))
        good = np.empty(len(fresh), np.bool_)
        edge.settle(self._view, self._config.min_contrast, ON_EDGE_NEW, self._config.min_length_px, room,
                    fresh.ends, fresh.variance, good)
        fresh = fresh.select(good)
        both = self._apart(self.segments.extended(fresh), old + len(fresh))
        fresh = both.select(slice(old, self._config.max_count))
        fresh.ids = np.arange(self._next_id, self._next_id + len(fresh))
        fresh.slots = np.delete(np.arange(self._config.max_count), self.segments.slots)[:len(fresh)]
        self._next_id += len(fresh)
        edge.learn(self._view, fresh.ends, fresh.slots, self._profiles, fresh.widths, fresh.stripes)
        self.segments = self.segments.extended(fresh)
        return True
