"""Where the edges of thin stripes really are: blur drives the two sides of a stripe apart.

Door frames, cables, joints and skirtings are a few pixels wide or less. Both their edges are seen through the blur of
the lens, of motion and of the slopes' own differences, and the steepest places that a tracker finds lie up to a blur's
standard deviation too far out. As long as the camera comes nearer this changes slowly, and looks like parallax.

One number stands for the blur of an image, though that of motion has a direction. From a blur of 2 px on the other side
of a stripe lies outside what is looked at.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.kernel_cache import inner
from line_slam_ros.types import F64

BLUR = 1.4  # px, standard deviation of what edges are seen through, as long as there are none to measure it at
STEPS = 5  # edges at least that have no stripe beside them, to measure it
SHARPEST = 0.25  # of these; the others are soft themselves
SOON = 0.2  # share of a new measurement in the blur
BLUR_ERROR = 0.1  # relative standard deviation of the blur
APART_ERROR = 0.08  # of how far apart two sides look to be, in units of the blur: too far, and standard deviation
THINNEST, WIDEST = 0.3, 8.0  # stripes, in units of the blur, between which all are as likely in proportion
FLAT = 1e6  # px, width of what is no edge
STEEPER = 0.3  # standard deviation, in units of the blur, for each time that the slope beside is steeper than the edge
ROOT_TWO_PI = np.float32(np.sqrt(2.0 * np.pi))


def _expected() -> tuple[F64, F64, F64]:
    """How far apart two sides look to be, what to expect then of how far either is off, and its standard deviation; all
    in units of the blur as it is known.

    Two opposite steps 2 a apart have their steepest places 2 x apart, a = x tanh(a x) in units of the true blur: the
    root of the derivative of the difference of two Gaussians.
    """
    width, error = np.meshgrid(np.geomspace(THINNEST, WIDEST, 200), np.linspace(-2.0, 2.0, 21))
    blur = np.exp(BLUR_ERROR * error)
    a = 0.5 * width / blur
    x = np.maximum(a, 1.0)
    for _ in range(50):
        x = a / np.tanh(a * x)
    off, looks = (x - a) * blur, np.linspace(2.0, 6.0, 41)
    surprise = error**2 + ((looks[:, None, None] - 2.0 * x * blur) / APART_ERROR - 1.0)**2
    weight = np.exp(-0.5 * surprise)
    weight /= weight.sum(axis=(1, 2), keepdims=True)
    mean = (weight * off).sum(axis=(1, 2))
    return looks, mean, np.sqrt((weight * (off - mean[:, None, None])**2).sum(axis=(1, 2)))


APART, OFF, OFF_SIGMA = _expected()


@inner(fastmath=True)
def look(values, seen, slopes, stripe):
    """Equivalent width, px, of the edge in the middle row of values (rows, SAMPLES): the standard deviation of the blur
    if it is a single step; FLAT if it is none.

    stripe (2, 2) <- for each side, how far along the normal the nearest opposite step looks to be, and its slope over
    that of the edge; 0, 0: there is none. slopes (rows,): work space.
    """
    zero, half, middle = np.float32(0.0), np.float32(0.5), len(values) // 2
    slopes[0] = slopes[2 * middle] = zero
    for k in range(1, 2 * middle):
        slope = zero
        for i in range(len(seen)):
            slope += seen[i] * (values[k + 1, i] - values[k - 1, i])
        slopes[k] = slope
    stripe[:] = 0.0
    steepest = slopes[middle]
    if not steepest > zero:
        return FLAT
    height = steepest
    for side in range(2):
        sign = 2 * side - 1
        for far in range(1, middle):
            if not slopes[middle + sign * far] > zero:
                break
            height += slopes[middle + sign * far]
        for far in range(2, middle - 1):
            at = middle + sign * far
            before, depth, after = -slopes[at - sign], -slopes[at], -slopes[at + sign]
            if depth > zero and depth >= before and depth > after:
                stripe[side, 0] = sign * (far + half * (before - after) / (before - depth - depth + after))
                stripe[side, 1] = depth / steepest
                break
    return height / (steepest * ROOT_TWO_PI)


def blur_of(widths: F64, stripes: F64, before: float | None) -> float | None:
    """The blur, px, after an image with edges of such widths (M,) and stripes (M, 2, 2), see look(); None: unknown."""
    steps = widths[(widths < FLAT) & (stripes[:, :, 1] == 0.0).all(axis=1)]
    if len(steps) < STEPS:
        return before
    found = float(np.quantile(steps, SHARPEST))
    return found if before is None else before + SOON * (found - before)


def displacement(stripes: F64, blur: float) -> tuple[F64, F64]:
    """How far along their normals edges with such stripes (M, 2, 2) are from where they look to be, (M,) px, and the
    standard deviation of this.

    The less steep side of a stripe moves the other one less, in proportion. By how much the steeper one moves the other
    is hardly known.
    """
    side, apart, ratio = np.sign(stripes[:, :, 0]), np.abs(stripes[:, :, 0]) / blur, stripes[:, :, 1]
    share = blur * np.minimum(ratio, 1.0)
    off = (side * share * np.interp(apart, APART, OFF)).sum(axis=1)
    doubts = np.hypot(share * np.interp(apart, APART, OFF_SIGMA), STEEPER * blur * np.maximum(ratio - 1.0, 0.0))
    return off, np.linalg.norm(doubts, axis=1)
