"""A walk along a route: exact poses and inertial data of a body that sways and looks where it goes.

Position, heading and sway are quintic B-splines, so that velocity, acceleration and angular velocity are their
derivatives without error, and all are smooth. Same seed, same numbers.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from line_slam_ros.geometry.lie import right_jacobian, so3_exp
from line_slam_ros.simulation.features import GRAVITY_W
from line_slam_ros.types import F64

DEGREE = 5
KNOT = 0.25  # s between control points
PUSH = 1.2  # m/s^2, at most, along the route
TURN_SPEED = 1.1  # m/s, at most, at the corners of the route
TURN_KNOTS = 7  # control points over which a corner spreads the heading
EYE = 1.4  # m, mean height
SWAY = np.array([0.03, 0.04, 0.03, 0.04, 0.03, 0.05])  # m and rad, of control points


@dataclass(frozen=True, slots=True)
class Walk:
    """Control points of position, heading and the rotation vector of the sway, R_WB = Rz(heading) Exp(sway)."""

    spline: BSpline  # t to (7,)
    seconds: float

    @staticmethod
    def along(route: F64, seed: int, speed: float, sway: float = 1.0, rest: float = 1.0) -> Walk:
        """From rest at the start of a polyline (N, 2) m to rest at its end, at up to ``speed`` m/s; sway: in SWAYs."""
        if not 0.05 <= speed <= 20.0:
            raise ValueError(f'speed must lie from 0.05 to 20 m/s, got {speed:g}')
        if not 0.0 <= sway <= 5.0:
            raise ValueError(f'sway must lie from 0 to 5, got {sway:g}')
        still = round(rest / KNOT) + DEGREE
        steps, heading = _paced(route, speed)
        swaying = np.arange(len(steps))[:, None] > 0
        offset = sway * swaying * SWAY * np.random.default_rng(seed).normal(size=(len(steps), 6))
        offset[-DEGREE:] = offset[-DEGREE - 1]
        control = np.column_stack([steps + offset[:, :2], EYE + offset[:, 2], heading, offset[:, 3:]])
        control = np.concatenate([np.repeat(control[:1], still, axis=0), control])
        knots = (np.arange(len(control) + DEGREE + 1) - DEGREE) * KNOT
        return Walk(BSpline(knots, control, DEGREE), float(knots[len(control)]))

    def at(self, t: F64) -> tuple[F64, F64, F64, F64, F64]:
        """R_WB (N, 3, 3), p_W, v_W, angular velocity in B, specific force in B, each (N, 3); t in [0, seconds]."""
        t = np.clip(np.atleast_1d(np.asarray(t, float)), 0.0, self.seconds)
        x, dx, ddx = (self.spline(t, nu) for nu in range(3))
        heading, sway = so3_exp(x[:, 3:4] * [0.0, 0.0, 1.0]), so3_exp(x[:, 4:])
        R = heading @ sway
        omega = sway.transpose(0, 2, 1) @ (dx[:, 3:4] * [0.0, 0.0, 1.0])[:, :, None]
        omega += right_jacobian(x[:, 4:]) @ dx[:, 4:, None]
        force = np.einsum('nji,nj->ni', R, ddx[:, :3] - GRAVITY_W)
        return R, x[:, :3], dx[:, :3], omega[:, :, 0], force


def _paced(route: F64, speed: float) -> tuple[F64, F64]:
    """Places (K, 2) a KNOT apart in time on the route, and the heading (K,) there, rad; still at the end."""
    legs = np.diff(route, axis=0)
    ends = np.concatenate([[0.0], np.linalg.norm(legs, axis=1).cumsum()])
    s = [0.0, 0.5 * PUSH * KNOT**2]
    while ends[-1] - s[-1] > 0.01:
        slowed = TURN_SPEED**2 + 2.0 * PUSH * np.abs(ends[1:-1] - s[-1])
        free = 2.0 * PUSH * np.array([s[-1] + 0.5 * PUSH * KNOT**2, ends[-1] - s[-1]])
        s.append(min(s[-1] + KNOT * np.sqrt(min(speed**2, free.min(), slowed.min(initial=np.inf))), ends[-1]))
    at = np.concatenate([s, np.repeat(ends[-1], DEGREE)])
    directions = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
    heading = directions[np.searchsorted(ends[1:-1], at)]
    around = np.pad(heading, TURN_KNOTS // 2, mode='edge')
    return (np.column_stack([np.interp(at, ends, route[:, axis]) for axis in range(2)]),
            np.convolve(around, np.full(TURN_KNOTS, 1.0 / TURN_KNOTS), mode='valid'))
