"""A corridor with turns: walls nearly uniform, with doors, windows, notices, skirting and lamps painted on.

What a wall radiates is one picture of all walls side by side; floor and ceiling have a picture each. Lamp light is
diffuse and baked in. Wall k runs from corner k of the outline to the next, the corridor on its left; a place on it is
(along, height). Same seed, same numbers.
"""
from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from line_slam_ros.simulation.features import CORRIDOR
from line_slam_ros.types import F64

WIDTH, HEIGHT = CORRIDOR[1:]
TEXEL = 0.005  # m, of the walls; every painted edge lies between two texels
TILE = 0.01  # m, texel of floor and ceiling
MARGIN = 1.5  # m from the ends of the route to the end walls
LAMP = np.array([1.2, 0.3])  # m, along and across the corridor
LAMP_GAP = 3.0  # m between lamps
LAMP_LIGHT = 2.5
AMBIENT, GLOW = 0.35, 0.45  # light without lamps, and of one lamp at a metre
SKIRTING = 0.08  # m
DOOR, FRAME = np.array([0.9, 2.0]), 0.07  # m
WINDOW, SILL = np.array([1.2, 1.2]), 0.9  # m


@dataclass(frozen=True, slots=True)
class Panel:
    """A rectangle painted on a wall."""

    wall: int
    low: tuple[float, float]  # along, height, m
    high: tuple[float, float]
    albedo: float
    structural: bool = True  # its edges count as lines of the building

    def corners(self) -> F64:
        """(4, 2) along and height, in turn."""
        (a, z), (b, y) = self.low, self.high
        return np.array([[a, z], [b, z], [b, y], [a, y]])


@dataclass(frozen=True, slots=True)
class Corridor:
    """Plan and pictures; world: z up, floor at 0, the route begins at the origin along x."""

    route: F64  # (N, 2) m, the middle line
    outline: F64  # (M, 2) m, counter-clockwise corners
    panels: tuple[Panel, ...]
    lamps: F64  # (L, 2, 2) m, lowest and highest x, y
    walls: np.ndarray  # float32 (HEIGHT / TEXEL, columns)
    first_column: np.ndarray  # (M,) of each wall
    floor: np.ndarray  # float32 (rows along y, columns along x)
    ceiling: np.ndarray
    origin: F64  # (2,) m, where floor and ceiling begin

    @staticmethod
    def random(seed: int, texture: float = 1.0) -> Corridor:
        """One or two turns, 30 to 60 m; ``texture`` scales the weak pattern of the surfaces."""
        if seed < 0:
            raise ValueError(f'seed must be 0 or more, got {seed}')
        if not 0.0 <= texture <= 100.0:
            raise ValueError(f'texture must lie from 0 to 100, got {texture:g}')
        rng = np.random.default_rng(seed)
        route = _random_route(rng)
        outline = _outline(route)
        panels = tuple(panel for k, length in enumerate(_lengths(outline)) for panel in _furnish(rng, k, length))
        lamps = _lamps(route)
        walls, first = _paint_walls(rng, outline, panels, lamps, texture)
        origin = outline.min(axis=0)
        shape = tuple(np.rint(np.ptp(outline, axis=0) / TILE).astype(int)[::-1])
        floor = rng.uniform(0.3, 0.45) * (1.0 + 3.0 * texture * _pattern(rng, shape))
        ceiling = 0.8 * (1.0 + texture * _pattern(rng, shape))
        floor *= _light(shape, TILE, lamps, np.append(origin, 0.0), np.eye(3))
        ceiling *= np.float32(AMBIENT)
        for low, high in np.rint((lamps - origin) / TILE).astype(int):
            ceiling[low[1]:high[1], low[0]:high[0]] = LAMP_LIGHT
        return Corridor(route, outline, panels, lamps, walls, first, floor, ceiling, origin)

    @property
    def length(self) -> float:
        """Of the route, m."""
        return float(np.abs(np.diff(self.route, axis=0)).sum())

    def on_wall(self, wall: int, places: F64) -> F64:
        """World points (..., 3) of places (..., 2) along and up a wall."""
        begin, direction = self.outline[wall], _directions(self.outline)[wall]
        return np.concatenate([begin + places[..., :1] * direction, places[..., 1:]], axis=-1)

    def edges(self) -> F64:
        """(E, 2, 3) m: edges of structural panels and lamps, and where walls, floor and ceiling meet."""
        found = []
        for panel in self.panels:
            if panel.structural:
                corners = self.on_wall(panel.wall, panel.corners())
                sides = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
                found.append(sides[~np.isclose(sides[:, :, 2], 0.0).all(axis=1)])  # on the floor: below
        for (x, y), (u, v) in self.lamps:
            corners = np.array([[x, y, HEIGHT], [u, y, HEIGHT], [u, v, HEIGHT], [x, v, HEIGHT]])
            found.append(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))
        low = np.column_stack([self.outline, np.zeros(len(self.outline))])
        high = low + [0.0, 0.0, HEIGHT]
        found += [np.stack([low, high], axis=1), *(np.stack([x, np.roll(x, -1, axis=0)], axis=1) for x in (low, high))]
        return np.concatenate(found)


def _random_route(rng: np.random.Generator) -> F64:
    """L or U, the turns all left or all right."""
    lengths = rng.uniform(15.0, 27.0, 2) if rng.random() < 0.5 else rng.uniform([12.0, 7.0, 12.0], [20.0, 12.0, 20.0])
    turn = rng.choice([-1.0, 1.0])
    angles = np.arange(len(lengths)) * turn * np.pi / 2.0
    legs = np.rint(np.column_stack([np.cos(angles), np.sin(angles)])) * _round(lengths, TILE)[:, None]
    return np.concatenate([np.zeros((1, 2)), legs.cumsum(axis=0)])


def _outline(route: F64) -> F64:
    """Corners of the walls at half a WIDTH beside a route of right angles, which end MARGIN behind its ends."""
    ahead = np.diff(route, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    inner = left[:-1] + left[1:]
    side = 0.5 * WIDTH * np.concatenate([left[:1], inner, left[-1:]])
    middle = route + MARGIN * np.concatenate([-ahead[:1], np.zeros_like(inner), ahead[-1:]])
    return np.concatenate([middle - side, (middle + side)[::-1]])


def _directions(outline: F64) -> F64:
    steps = np.roll(outline, -1, axis=0) - outline
    return steps / np.linalg.norm(steps, axis=1, keepdims=True)


def _lengths(outline: F64) -> F64:
    return np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1)


def _round(x: F64, texel: float = TEXEL) -> F64:
    return np.rint(np.asarray(x) / texel) * texel


def _furnish(rng: np.random.Generator, wall: int, length: float) -> list[Panel]:
    """Doors, windows and notices some metres apart, and the skirting between the doors."""
    panels, doors = [], [0.0]
    at = float(_round(rng.uniform(0.5, 2.0)))
    while at < length - 1.8:
        kind = rng.choice(3, p=[0.6, 0.2, 0.2])
        if kind == 0:
            panels += _door(rng, wall, at)
            doors += [at, at + DOOR[0] + 2 * FRAME]
        elif kind == 1:
            panels += _window(rng, wall, at)
        else:
            panels += _notice(rng, wall, at)
        at = float(_round(at + rng.uniform(2.2, 5.0)))
    doors.append(length)
    shade = rng.uniform(0.15, 0.4)
    for a, b in zip(doors[::2], doors[1::2], strict=True):
        panels.append(Panel(wall, (a, 0.0), (b, SKIRTING), shade))
    return panels


def _door(rng: np.random.Generator, wall: int, at: float) -> list[Panel]:
    frame, leaf = rng.uniform(0.3, 0.5), rng.uniform(0.35, 0.8)
    low, high = (at + FRAME, 0.0), (at + FRAME + DOOR[0], float(DOOR[1]))
    panels = [Panel(wall, (at, 0.0), (high[0] + FRAME, high[1] + FRAME), frame), Panel(wall, low, high, leaf)]
    panels.append(Panel(wall, (low[0] + 0.06, 1.04), (low[0] + 0.18, 1.06), 0.15, False))  # handle
    if rng.random() < 0.5:
        x = high[0] + FRAME + 0.15
        panels.append(Panel(wall, (x, 1.5), (x + 0.2, 1.6), rng.uniform(0.2, 0.9)))  # name plate
    return panels


def _window(rng: np.random.Generator, wall: int, at: float) -> list[Panel]:
    x, z, middle = at + WINDOW[0], SILL + WINDOW[1], at + WINDOW[0] / 2
    pane = rng.uniform(1.0, 1.5)
    return [Panel(wall, (at, SILL), (x, z), 0.75),
            Panel(wall, (at + 0.06, SILL + 0.06), (middle - 0.03, z - 0.06), pane),
            Panel(wall, (middle + 0.03, SILL + 0.06), (x - 0.06, z - 0.06), pane)]


def _notice(rng: np.random.Generator, wall: int, at: float) -> list[Panel]:
    """A sheet with rows of dark marks."""
    width, height = _round(rng.uniform([0.3, 0.4], [0.6, 0.8]))
    low = 1.2
    panels = [Panel(wall, (at, low), (at + width, low + height), rng.uniform(0.75, 0.9))]
    for z in _round(np.arange(low + 0.06, low + height - 0.06, 0.06)).tolist():
        a = at + 0.04
        while a < at + width - 0.08:
            b = float(min(a + _round(rng.uniform(0.02, 0.1)), at + width - 0.04))
            panels.append(Panel(wall, (a, z), (b, z + 0.025), rng.uniform(0.2, 0.6), False))
            a = b + 0.02
    return panels


def _lamps(route: F64) -> F64:
    boxes = []
    for begin, end in pairwise(route):
        leg = end - begin
        length = np.abs(leg).sum()
        half = 0.5 * (LAMP if leg[0] else LAMP[::-1])
        for s in np.arange(1.5, length - 0.5, LAMP_GAP):
            middle = _round(begin + s * leg / length, TILE)
            boxes.append([middle - half, middle + half])
    return np.array(boxes)


def _paint_walls(rng: np.random.Generator, outline: F64, panels: tuple[Panel, ...], lamps: F64,
                 texture: float) -> tuple[np.ndarray, np.ndarray]:
    """The picture of all walls and the first column of each."""
    rows, columns = round(HEIGHT / TEXEL), np.rint(_lengths(outline) / TEXEL).astype(np.int64)
    first = np.concatenate([[0], columns.cumsum()[:-1]])
    picture = np.empty((rows, columns.sum()), np.float32)
    picture[:] = rng.uniform(0.55, 0.65)
    for panel in panels:
        (a, z), (b, y) = (np.rint(np.divide(end, TEXEL)).astype(int) for end in (panel.low, panel.high))
        picture[z:y, first[panel.wall] + a:first[panel.wall] + b] = panel.albedo
    picture *= 1.0 + texture * _pattern(rng, picture.shape)
    for k, (x, y) in enumerate(_directions(outline)):
        part = picture[:, first[k]:first[k] + columns[k]]
        axes = np.array([[x, y, 0.0], [0.0, 0.0, 1.0], [-y, x, 0.0]])
        part *= _light(part.shape, TEXEL, lamps, np.append(outline[k], 0.0), axes)
    return picture, first


def _pattern(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Relative variation: 0.4 % over centimetres, 0.7 % over decimetres, 1.5 % over half metres."""
    total = np.zeros(shape, np.float32)
    for cell, strength in ((2, 0.004), (20, 0.007), (100, 0.015)):
        coarse = rng.standard_normal((shape[0] // cell + 2, shape[1] // cell + 2), np.float32)
        total += strength * cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)
    return total


def _light(shape: tuple[int, ...], texel: float, lamps: F64, begin: F64, axes: F64) -> np.ndarray:
    """Light (rows, columns) on a plane that begins at ``begin`` (3,); rows of axes (3, 3): along, up, normal."""
    coarse = shape[0] // 20 + 2, shape[1] // 20 + 2
    up, along = np.meshgrid(*(np.linspace(0.0, n * texel, m) for n, m in zip(shape, coarse, strict=True)),
                            indexing='ij')
    places = begin + along[..., None] * axes[0] + up[..., None] * axes[1]
    light = np.full(coarse, AMBIENT)
    for x, y in lamps.mean(axis=1):
        towards = (x, y, HEIGHT) - places
        light += (GLOW * np.maximum(towards @ axes[2], 0.0) * towards[..., 2]
                  / ((towards**2).sum(axis=-1) + 0.1)**2)  # 0.1 m^2: a lamp is no point
    return cv2.resize(light.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR)
