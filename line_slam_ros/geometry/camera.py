"""Camera models: pixels of the received image <-> normalised, undistorted coordinates on the plane z = 1.

radtan (Brown-Conrady; ROS plumb_bob, rational_polynomial), with r^2 = x.x:

    x_d = g x + [2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y],
    g   = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)

equidistant (Kannala-Brandt; OpenCV fisheye), with theta = atan r:

    x_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) x / r

Both are used only where the radius of x_d grows with that of x: beyond, two rays share a pixel and the result is NaN.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from line_slam_ros.kernel_cache import inner, kernel
from line_slam_ros.types import F64, Calibration

WIDEST_CANVAS = 1.25  # of the received image, on each side of the principal point
NEWTON_STEPS = 20
CONVERGED = 1e-8  # last Newton step, normalised units; what is left is about its square


@dataclass(frozen=True, slots=True)
class Canvas:
    """A pinhole image without distortion."""

    fx: float  # px
    fy: float
    cx: float
    cy: float
    size: tuple[int, int]  # W, H px

    def normalise(self, uv: F64) -> F64:
        """Pixels (..., 2) of the canvas to normalised coordinates (..., 2)."""
        return (np.asarray(uv, float) - (self.cx, self.cy)) / (self.fx, self.fy)

    def project(self, x: F64) -> F64:
        """Normalised coordinates (..., 2) to pixels (..., 2) of the canvas."""
        return np.asarray(x, float) * (self.fx, self.fy) + (self.cx, self.cy)


class Camera:
    """One calibrated camera. Raises ValueError when the calibration cannot be used, saying what to do."""

    def __init__(self, calibration: Calibration) -> None:
        _check(calibration)
        self.calibration = calibration
        fx, fy, cx, cy = calibration.intrinsics
        self._focals, self._centre = np.array([fx, fy]), np.array([cx, cy])
        self._lens: _Lens = MODELS[calibration.model](np.array(calibration.distortion, float))

    @property
    def focal(self) -> float:
        """Mean focal length, px."""
        return float(self._focals.mean())

    def normalise(self, uv: F64) -> F64:
        """Pixels (N, 2) to undistorted normalised coordinates (N, 2); NaN where the model has no inverse."""
        return self._lens.undistort((np.asarray(uv, float) - self._centre) / self._focals)

    def project(self, x: F64) -> F64:
        """Normalised coordinates (N, 2) to pixels (N, 2); NaN outside the region where the model is one to one."""
        return self._lens.distort(np.asarray(x, float)) * self._focals + self._centre

    def canvas(self, scale: float = 1.0) -> Canvas:
        """The one with focal length * scale that keeps the field of view, up to WIDEST_CANVAS per side."""
        (left, top), (right, bottom) = (reach * scale for reach in self._reach())
        fx, fy = self._focals * scale
        return Canvas(float(fx), float(fy), float(left), float(top), (round(left + right) + 1, round(top + bottom) + 1))

    def maps(self, canvas: Canvas) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
        """Two, of (H, W, 2) and (H, W), that make the canvas: cv2.remap(image, *maps, cv2.INTER_LINEAR)."""
        width, height = canvas.size
        v, u = np.mgrid[:height, :width]
        uv = self.project(canvas.normalise(np.stack([u, v], axis=-1).reshape(-1, 2)))
        outside = -2.0  # px; far enough from the image that interpolation does not touch it
        limit = np.array([self.calibration.width, self.calibration.height]) + 1.0
        uv = np.clip(np.nan_to_num(uv, nan=outside), outside, limit).astype(np.float32).reshape(height, width, 2)
        return cv2.convertMaps(uv[..., 0], uv[..., 1], cv2.CV_16SC2)

    def _reach(self) -> tuple[F64, F64]:
        """Field of view in px of the canvas from the principal point: ([left, top], [right, bottom])."""
        width, height = self.calibration.width, self.calibration.height
        u, v = np.linspace(0.0, width - 1.0, 64), np.linspace(0.0, height - 1.0, 64)

        def furthest(edge_u: F64 | float, edge_v: F64 | float, axis: int) -> float:
            x = self.normalise(np.column_stack(np.broadcast_arrays(edge_u, edge_v)))[:, axis]
            return float(np.max(np.nan_to_num(np.abs(x), nan=np.inf)) * self._focals[axis])  # NaN: past any canvas

        low = np.array([furthest(0.0, v, 0), furthest(u, 0.0, 1)])
        high = np.array([furthest(width - 1.0, v, 0), furthest(u, height - 1.0, 1)])
        limit = WIDEST_CANVAS * self._centre, WIDEST_CANVAS * (np.array([width, height]) - self._centre)
        return np.minimum(low, limit[0]), np.minimum(high, limit[1])


class _Lens(Protocol):
    """Distortion of the normalised plane."""

    def distort(self, x: F64) -> F64:
        """(N, 2) to (N, 2)."""

    def undistort(self, x_d: F64) -> F64:
        """(N, 2) to (N, 2)."""


class _Radtan:
    """k1 k2 p1 p2 [k3 [k4 k5 k6]]; see the module."""

    def __init__(self, coefficients: F64) -> None:
        self._coefficients = np.pad(coefficients, (0, 8 - len(coefficients)))
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients
        s, over, under = Polynomial([0.0, 1.0]), Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])
        growth = over * under + 2.0 * s * (over.deriv() * under - over * under.deriv())  # d(g r)/dr times under^2
        self._widest = np.sqrt(min(_first_positive_root(growth), _first_positive_root(under)))
        self._table = np.linspace(0.0, min(self._widest, 10.0), 1024)
        self._table_d = self._table * over(self._table**2) / under(self._table**2)

    def distort(self, x: F64) -> F64:
        _distort_radtan(self._coefficients, self._widest, x, x_d := np.empty(x.shape))
        return x_d

    def undistort(self, x_d: F64) -> F64:
        """Newton's method from the inverse of the radial part; NaN where it does not converge in the valid region."""
        _undistort_radtan(self._coefficients, self._widest, self._table, self._table_d, x_d, x := np.empty(x_d.shape))
        return x


class _Equidistant:
    """k1 k2 k3 k4; see the module."""

    def __init__(self, coefficients: F64) -> None:
        self._coefficients = np.array(coefficients)
        odd = np.zeros(10)
        odd[1::2] = [1.0, *coefficients]
        angle_d = Polynomial(odd)  # of theta
        self._widest = min(_first_positive_root(angle_d.deriv()), np.pi / 2.0)
        self._table = np.linspace(0.0, self._widest, 1024)
        self._table_d = angle_d(self._table)

    def distort(self, x: F64) -> F64:
        _distort_equidistant(self._coefficients, self._widest, x, x_d := np.empty(x.shape))
        return x_d

    def undistort(self, x_d: F64) -> F64:
        """Newton's method on the angle; NaN at and beyond 90 degrees, where the plane z = 1 ends."""
        _undistort_equidistant(self._coefficients, self._widest, self._table, self._table_d, x_d,
                               x := np.empty(x_d.shape))
        return x


@inner
def _look_up(at, table_at, table):
    """Value of table at a place between those of the growing table_at, linear between; constant beyond them."""
    k, beyond = 1, len(table)
    while k + 1 < beyond:  # halving what is left
        middle = (k + beyond) // 2
        if table_at[middle - 1] < at:
            k = middle
        else:
            beyond = middle
    share = (at - table_at[k - 1]) / (table_at[k] - table_at[k - 1])
    return table[k - 1] + min(max(share, 0.0), 1.0) * (table[k] - table[k - 1])


@inner
def _bend(coefficients, x, y):
    """Distorted x, y and the symmetric derivative dx_d/dx, dx_d/dy = dy_d/dx, dy_d/dy; radtan."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    s = x * x + y * y
    under = 1.0 + s * (k4 + s * (k5 + s * k6))
    gain = (1.0 + s * (k1 + s * (k2 + s * k3))) / under
    slope = (k1 + s * (2.0 * k2 + 3.0 * s * k3) - gain * (k4 + s * (2.0 * k5 + 3.0 * s * k6))) / under  # dg/ds
    return (gain * x + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
            gain * y + 2.0 * p2 * x * y + p1 * (s + 2.0 * y * y),
            gain + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
            2.0 * slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
            gain + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x)


@kernel
def _distort_radtan(coefficients, widest, x, x_d):
    """Fill x_d (N, 2) from x (N, 2)."""
    k = (coefficients[0], coefficients[1], coefficients[2], coefficients[3], coefficients[4], coefficients[5],
         coefficients[6], coefficients[7])
    for i in range(len(x)):
        x_d[i, 0], x_d[i, 1] = np.nan, np.nan
        if x[i, 0] * x[i, 0] + x[i, 1] * x[i, 1] < widest * widest:
            x_d[i, 0], x_d[i, 1], _, _, _ = _bend(k, x[i, 0], x[i, 1])


@kernel
def _undistort_radtan(coefficients, widest, table, table_d, x_d, x):
    """Fill x (N, 2) from x_d (N, 2)."""
    k = (coefficients[0], coefficients[1], coefficients[2], coefficients[3], coefficients[4], coefficients[5],
         coefficients[6], coefficients[7])
    for i in range(len(x_d)):
        r_d = np.sqrt(x_d[i, 0] * x_d[i, 0] + x_d[i, 1] * x_d[i, 1])
        scale = _look_up(r_d, table_d, table) / r_d if r_d > 0.0 else 1.0
        u, v, step, determinant = scale * x_d[i, 0], scale * x_d[i, 1], np.inf, 0.0
        for _ in range(NEWTON_STEPS):
            bent_u, bent_v, uu, uv, vv = _bend(k, u, v)
            error_u, error_v, determinant = bent_u - x_d[i, 0], bent_v - x_d[i, 1], uu * vv - uv * uv
            step_u, step_v = (vv * error_u - uv * error_v) / determinant, (uu * error_v - uv * error_u) / determinant
            u, v, step = u - step_u, v - step_v, abs(step_u) + abs(step_v)
            if not step > CONVERGED:
                break
        found = step <= CONVERGED and determinant > 0.0 and u * u + v * v < widest * widest
        x[i, 0], x[i, 1] = (u, v) if found else (np.nan, np.nan)


@inner
def _angle(coefficients, theta):
    """Distorted angle of theta and its derivative; equidistant."""
    k1, k2, k3, k4 = coefficients
    s = theta * theta
    return (theta * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))),
            1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4))))


@kernel
def _distort_equidistant(coefficients, widest, x, x_d):
    """Fill x_d (N, 2) from x (N, 2)."""
    k = coefficients[0], coefficients[1], coefficients[2], coefficients[3]
    for i in range(len(x)):
        r = np.sqrt(x[i, 0] * x[i, 0] + x[i, 1] * x[i, 1])
        scale = np.nan
        if np.arctan(r) < widest:
            scale = _angle(k, np.arctan(r))[0] / r if r > 0.0 else 1.0
        x_d[i, 0], x_d[i, 1] = scale * x[i, 0], scale * x[i, 1]


@kernel
def _undistort_equidistant(coefficients, widest, table, table_d, x_d, x):
    """Fill x (N, 2) from x_d (N, 2)."""
    k = coefficients[0], coefficients[1], coefficients[2], coefficients[3]
    for i in range(len(x_d)):
        r_d = np.sqrt(x_d[i, 0] * x_d[i, 0] + x_d[i, 1] * x_d[i, 1])
        theta, step = _look_up(r_d, table_d, table), np.inf
        for _ in range(NEWTON_STEPS):
            angle_d, growth = _angle(k, theta)
            step = (angle_d - r_d) / growth
            theta -= step
            if not abs(step) > CONVERGED:
                break
        scale = np.nan
        if abs(step) <= CONVERGED and theta < widest:
            scale = np.tan(theta) / r_d if r_d > 0.0 else 1.0
        x[i, 0], x[i, 1] = scale * x_d[i, 0], scale * x_d[i, 1]


MODELS = {'radtan': _Radtan, 'equidistant': _Equidistant}
COEFFICIENTS = {'radtan': (0, 4, 5, 8), 'equidistant': (4,)}


def _first_positive_root(polynomial: Polynomial) -> float:
    """Smallest positive real root, or infinity; of a polynomial with constant term 1, solved for the reciprocals."""
    reciprocals = Polynomial(polynomial.coef[::-1]).roots()
    positive = reciprocals.real[(np.abs(reciprocals.imag) < 1e-9) & (reciprocals.real > 1e-6)]
    return float(1.0 / np.max(positive)) if len(positive) else np.inf


def _check(calibration: Calibration) -> None:
    """Raise ValueError naming the value and the remedy."""
    model, distortion = calibration.model, calibration.distortion
    if model not in MODELS:
        raise ValueError(f'unknown distortion model {model!r}: recalibrate with one of {", ".join(MODELS)} '
                         '(ROS: plumb_bob, rational_polynomial, equidistant or fisheye)')
    if len(distortion) not in COEFFICIENTS[model]:
        raise ValueError(f'{model} takes {" or ".join(map(str, COEFFICIENTS[model]))} distortion coefficients, '
                         f'got {len(distortion)}: {tuple(distortion)}')
    if not np.all(np.isfinite([*calibration.intrinsics, *distortion])):
        raise ValueError(f'intrinsics {calibration.intrinsics} or distortion {tuple(distortion)} are not finite: '
                         'calibrate the camera')
    if not min(calibration.intrinsics[:2]) > 0.0:
        raise ValueError(f'focal lengths must be positive, got {calibration.intrinsics[:2]} px: the camera is not '
                         'calibrated; calibrate it and publish its camera_info, or give a Kalibr file')
    if not min(calibration.width, calibration.height) > 0:
        raise ValueError(f'image size must be positive, got {calibration.width} x {calibration.height} px: '
                         'set the width and height of the calibration')


def warm_up_lenses() -> None:
    """Compile or load the kernels of every lens: that of the camera may be known only later."""
    for model, size in ((_Radtan, 5), (_Equidistant, 4)):
        lens = model(np.zeros(size))
        lens.undistort(lens.distort(np.zeros((1, 2))))
