"""A house of vertical, horizontal and slanted lines, a camera that goes round in it, and what it sees of the lines.

A wire frame: nothing hides a line but the camera's field of view, as in the house experiment of the line code base.
World: z up, floor at z = 0, the middle of the house above the origin, turned by any angle about z.

Every kind of chance has its own stream of the seed and is drawn for all pairs of a frame and a line, seen or not, so
that one effect switched on or off leaves the others as they are. Same seed, same numbers.
"""
from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from line_slam_ros.geometry.lie import rigid, rigid_inverse, so3_exp, transform_points
from line_slam_ros.types import F64, I64

FRAME_RATE = 30.0  # Hz
NEAREST = 0.1  # m, depth at which a line comes into view
SHORTEST = 20.0  # px, length of a segment in the image that a detector would still report
EYE = 1.6  # m, mean height of the camera
LEAST_PART = 0.2  # of a visible segment that a partial view shows
MOST_NOISE_PX = 1e6  # far wider than any image
BODY = 22  # lines of the house besides its windows
WALLS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # outward normals
ALONG = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])  # level, in the wall
UP = np.array([0.0, 0.0, 1.0])


class Purpose(IntEnum):
    """What the seed is used for; each has a stream of its own."""

    WORLD = 0
    MOTION = 1
    PARTIAL = 2
    OUTLIER = 3
    NOISE = 4
    SWAP = 5


@dataclass(frozen=True, slots=True)
class Pinhole:
    """A camera without distortion: size and intrinsics in px."""

    width: int = 640
    height: int = 640
    fx: float = 460.0
    fy: float = 460.0
    cx: float = 320.0
    cy: float = 320.0

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f'image size must be at least 1x1 px, got {self.width}x{self.height}')
        if not (0.0 < self.fx < math.inf and 0.0 < self.fy < math.inf):
            raise ValueError(f'focal length must be a positive number of px, got {self.fx}, {self.fy}')
        if not (math.isfinite(self.cx) and math.isfinite(self.cy)):
            raise ValueError(f'principal point must be two finite numbers of px, got {self.cx}, {self.cy}')

    @classmethod
    def centred(cls, width: int = 640, height: int = 640, focal: float = 460.0) -> Pinhole:
        """One focal length, the principal point in the middle of the image."""
        return cls(width, height, focal, focal, width / 2.0, height / 2.0)

    @property
    def focals(self) -> F64:
        """fx, fy."""
        return np.array([self.fx, self.fy])

    @property
    def borders(self) -> F64:
        """(2, 2) least and largest x, y of the image, normalised."""
        return (np.array([[0.0, 0.0], [self.width, self.height]]) - (self.cx, self.cy)) / self.focals


@dataclass(frozen=True, slots=True)
class Effects:
    """How the observations differ from the whole, exact segments. Shares are of all views, in [0, 1]."""

    noise_px: float = 0.0  # standard deviation of every coordinate of every end
    fov_limit: bool = True  # cut segments at the border of the image; otherwise all that lie in front are seen whole
    partial: float = 0.0  # share of views that see only a part of the segment, anywhere in it
    outliers: float = 0.0  # share of views replaced by a segment that has nothing to do with the line
    swapped: float = 0.0  # share of views with their two ends in the other order

    def __post_init__(self) -> None:
        if not 0.0 <= self.noise_px <= MOST_NOISE_PX:
            raise ValueError(f'noise must lie from 0 to {MOST_NOISE_PX:g} px, got {self.noise_px:g}')
        for name in ('partial', 'outliers', 'swapped'):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f'{name} is a share and must lie from 0 to 1, got {getattr(self, name)}')


def random_house(seed: int, lines: int = 80) -> F64:
    """Segments (lines, 2, 3) of a house. ValueError for fewer than BODY, without which it is none.

    Edges of floor, eaves and gable roof, a door, stair rails, up to eight windows, and for the rest pictures, pipes
    and shelves: single lines on the walls or in front of them.
    """
    if lines < BODY:
        raise ValueError(f'a house needs at least {BODY} lines, got {lines}')
    rng = _stream(seed, Purpose.WORLD)
    size = rng.uniform([7.0, 7.0, 3.0], [10.0, 10.0, 4.0])  # m, in x, in y and height of the walls
    windows = min(int(rng.integers(4, 9)), (lines - BODY) // 4)
    parts = [_edges(size, size[2] + rng.uniform(1.2, 2.5)), _openings(rng, size, windows), _stair_rails(rng, size)]
    parts.append(_single_lines(rng, size, lines - sum(map(len, parts))))
    return np.concatenate(parts) @ so3_exp(rng.uniform(0.0, 2.0 * np.pi) * UP).T


def closed_loop(seed: int, frames: int = 600) -> tuple[F64, F64]:
    """Stamps (F,) s and T_WC (F, 4, 4): once round in the house, up and down, looking across its middle."""
    if frames < 2:
        raise ValueError(f'a trajectory needs at least 2 frames, got {frames}')
    rng = _stream(seed, Purpose.MOTION)
    radii, rise, waves = rng.uniform(1.2, 2.2, 2), rng.uniform(0.3, 0.6), int(rng.integers(3, 7))
    sway, phase = rng.uniform(0.1, 0.4, 3), rng.uniform(0.0, 2.0 * np.pi, 4)
    angle = phase[3] + 2.0 * np.pi * np.arange(frames) / frames
    p_W = np.stack([radii[0] * np.cos(angle), radii[1] * np.sin(angle), EYE + rise * np.sin(waves * angle)], axis=-1)
    target_W = sway * np.sin(angle[:, None] * [2, 3, 2] + phase[:3]) + EYE * UP
    return np.arange(frames) / FRAME_RATE, look_at(p_W, target_W)


def look_at(p_W: ArrayLike, target_W: ArrayLike) -> F64:
    """T_WC (..., 4, 4) of cameras at p_W (..., 3) that look at target_W (..., 3), not straight up or down, level."""
    forward = np.subtract(target_W, p_W)
    right = np.cross(forward, UP)
    axes = np.stack([right, np.cross(forward, right), forward], axis=-1)  # columns x, y, z of the camera
    return rigid(axes / np.linalg.norm(axes, axis=-2, keepdims=True), p_W)


def observe(segments: F64, T_WC: F64, camera: Pinhole, effects: Effects, seed: int) -> tuple[I64, I64, F64]:
    """Frame (M,), line (M,) and normalised ends (M, 2, 2) of all views, in the order of frames, then of lines.

    segments (L, 2, 3) in W, T_WC (F, 4, 4). A view has at least SHORTEST px before it is made partial; noise goes on
    every view, outliers included. ValueError when no line is ever seen.
    """
    p_C = transform_points(rigid_inverse(T_WC)[:, None], segments)  # (F, L, 2, 3)
    part, visible = _part_in_image(p_C, camera) if effects.fov_limit else _whole_in_front(p_C)
    at = np.nonzero(visible)
    p_C = _between(p_C[at], part[at])
    ends = p_C[..., :2] / p_C[..., 2:]
    long = np.linalg.norm((ends[:, 1] - ends[:, 0]) * camera.focals, axis=-1) >= SHORTEST
    if not long.any():
        raise ValueError('no line is in view of any camera; put the camera into the house: its middle is the origin, '
                         'z is up, the camera looks along its z axis')
    frame, line = at[0][long], at[1][long]
    return frame, line, _disturbed(ends[long], _Draws(seed, visible.shape, (frame, line)), camera, effects)


@dataclass(frozen=True, slots=True)
class _Draws:
    """Random numbers for all pairs of a frame and a line, of which the views take theirs."""

    seed: int
    shape: tuple[int, int]  # frames, lines
    at: tuple[I64, I64]  # (M,) the views

    def uniform(self, purpose: Purpose, count: int) -> F64:
        """(count, M) in [0, 1)."""
        return _stream(self.seed, purpose).random((count, *self.shape))[(slice(None), *self.at)]

    def normal(self, purpose: Purpose, count: int) -> F64:
        """(count, M) of standard deviation 1."""
        return _stream(self.seed, purpose).normal(size=(count, *self.shape))[(slice(None), *self.at)]


def _disturbed(ends: F64, draws: _Draws, camera: Pinhole, effects: Effects) -> F64:
    """The views' ends (M, 2, 2) with all effects but the limited field of view."""
    chance, start, extent = draws.uniform(Purpose.PARTIAL, 3)
    extent = LEAST_PART + (1.0 - LEAST_PART) * extent
    first = start * (1.0 - extent)
    part = np.where(chance[:, None] < effects.partial, np.stack([first, first + extent], axis=-1), [0.0, 1.0])
    chance, *place = draws.uniform(Purpose.OUTLIER, 5)
    ends = np.where(chance[:, None, None] < effects.outliers, _anywhere(np.array(place), camera), _between(ends, part))
    noise = draws.normal(Purpose.NOISE, 4).T.reshape(-1, 2, 2) * effects.noise_px / camera.focals
    swapped = draws.uniform(Purpose.SWAP, 1)[0] < effects.swapped
    ends = ends + noise
    return np.where(swapped[:, None, None], ends[:, ::-1], ends)


def _anywhere(place: F64, camera: Pinhole) -> F64:
    """Segments (M, 2, 2) inside the image, a tenth to half of its smaller side long; place (4, M) in [0, 1)."""
    low, high = camera.borders
    middle = low + (0.25 + 0.5 * place[:2].T) * (high - low)
    half = min(camera.width, camera.height) * (0.05 + 0.2 * place[2])
    angle = 2.0 * np.pi * place[3]
    offset = half[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1) / camera.focals
    return np.stack([middle - offset, middle + offset], axis=1)


def _whole_in_front(p_C: F64) -> tuple[F64, NDArray[np.bool_]]:
    """Part (..., 2) of segments (..., 2, 3) that is seen without a border, all of it, and whether both ends are."""
    visible = (p_C[..., 2] >= NEAREST).all(axis=-1)
    return np.broadcast_to([0.0, 1.0], (*visible.shape, 2)), visible


def _part_in_image(p_C: F64, camera: Pinhole) -> tuple[F64, NDArray[np.bool_]]:
    """Part (..., 2) of segments (..., 2, 3) inside the view frustum, as shares of the way to the second end, and
    whether there is one; clipped plane by plane (Cyrus, Beck 1978)."""
    (left, top), (right, bottom) = camera.borders
    inward = np.array([[1, 0, -left], [0, 1, -top], [-1, 0, right], [0, -1, bottom], [0, 0, 1]])
    first, second = np.moveaxis(p_C @ inward.T - [0.0, 0.0, 0.0, 0.0, NEAREST], -2, 0)  # (..., 5) signed, >= 0 inside
    with np.errstate(divide='ignore', invalid='ignore'):
        crossing = first / (first - second)
    start = np.where(first < 0.0, crossing, 0.0).max(axis=-1)
    end = np.where(second < 0.0, crossing, 1.0).min(axis=-1)
    return np.stack([start, end], axis=-1), start < end  # both ends outside one plane: end <= crossing <= start


def _between(ends: F64, part: F64) -> F64:
    """Points (..., 2, D) at the shares ``part`` (..., 2) of the way from the first of ends (..., 2, D) to the second;
    exactly the ends at 0 and 1."""
    part = part[..., None]
    return (1.0 - part) * ends[..., :1, :] + part * ends[..., 1:, :]


def _edges(size: F64, ridge: float) -> F64:
    """(17, 2, 3): floor, eaves, corners, slants of the gables, ridge at that height."""
    corners = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]])
    floor = corners * size / 2.0
    eaves = floor + size * UP
    tips = eaves * [1.0, 0.0, 0.0] + ridge * UP
    pairs = [(floor, np.roll(floor, -1, axis=0)), (eaves, np.roll(eaves, -1, axis=0)), (floor, eaves), (eaves, tips),
             (tips[:1], tips[1:2])]
    return np.concatenate([np.stack(pair, axis=1) for pair in pairs])


def _openings(rng: np.random.Generator, size: F64, windows: int) -> F64:
    """(3 + 4 windows, 2, 3): frames of a door and of windows, spread over the walls without touching."""
    number = np.arange(1 + windows)
    wall, row = number % 4, number // 4
    columns = row[-1] + 1
    pitch = np.abs(ALONG[wall]) @ size / columns
    half = np.minimum(rng.uniform(0.4, 0.9, len(number)), 0.4 * pitch)
    sill, head = rng.uniform(0.7, 1.1, len(number)), rng.uniform(2.0, 2.4, len(number))
    sill[0] = 0.0
    along = ((row + 0.5 - columns / 2.0) * pitch)[:, None] + half[:, None] * [-1.0, -1.0, 1.0, 1.0]
    corners = _on_wall(size, wall[:, None], along, np.stack([sill, head, head, sill], axis=1))
    frames = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3)
    return np.delete(frames, 3, axis=0)  # a door has no sill


def _stair_rails(rng: np.random.Generator, size: F64) -> F64:
    """(2, 2, 3): the string of a stair along a wall, and its rail 0.9 m above."""
    run, rise = rng.uniform(2.0, 3.0), rng.uniform(1.5, 2.0)
    height = np.array([[0.0, rise], [0.9, 0.9 + rise]])
    return _on_wall(size - 0.2, rng.integers(4), np.tile([-run / 2.0, run / 2.0], (2, 1)), height)


def _single_lines(rng: np.random.Generator, size: F64, count: int) -> F64:
    """(count, 2, 3): vertical, level and slanted, 0.6 to 1.6 m long, on a wall or up to 1 m in front of it."""
    wall, in_front = rng.integers(0, 4, count), rng.uniform(0.0, 1.0, (count, 1))
    slant = np.radians(rng.uniform(20.0, 70.0, count)) * rng.choice([-1.0, 1.0], count)
    angle = np.choose(rng.integers(0, 3, count), [np.full(count, np.pi / 2.0), np.zeros(count), slant])
    half = rng.uniform(0.3, 0.8, count)[:, None] * [-1.0, 1.0]
    along = rng.uniform(-1.0, 1.0, count) * (np.abs(ALONG[wall]) @ size / 2.0 - 2.0)
    height = rng.uniform(1.0, size[2] - 1.0, count)
    return _on_wall((size - 2.0 * in_front)[:, None], wall[:, None], along[:, None] + half * np.cos(angle)[:, None],
                    height[:, None] + half * np.sin(angle)[:, None])


def _on_wall(size: F64, wall: ArrayLike, along: F64, height: F64) -> F64:
    """Points (..., 3) on walls (...) by their way along it from its middle and their height, m each."""
    return WALLS[wall] * size / 2.0 + along[..., None] * ALONG[wall] + height[..., None] * UP


def _stream(seed: int, purpose: Purpose) -> np.random.Generator:
    """The purpose's own stream of the seed."""
    if seed < 0:
        raise ValueError(f'seed must be 0 or more, got {seed}')
    return np.random.default_rng(np.random.SeedSequence(seed).spawn(len(Purpose))[purpose])
