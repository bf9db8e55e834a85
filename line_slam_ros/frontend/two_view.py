"""Which matches agree with one rigid motion between two images whose relative rotation is roughly known.

With rays X1 = R_21 x1 turned into the second camera, a static point obeys x2 . (t x X1) = 0. Two matches give the
direction of t = (X1a x x2a) x (X1b x x2b), so a few dozen hypotheses suffice. The distance of x2 to its epipolar line
never exceeds |x2 - X1|: at a standstill or in a pure rotation every good match passes.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from line_slam_ros.geometry.lie_kernels import retract_rotation
from line_slam_ros.geometry.small_systems import solve_positive
from line_slam_ros.kernel_cache import inner, kernel
from line_slam_ros.types import F64

FEWEST = 8  # matches; fewer than this cannot contradict each other
HYPOTHESES = 60
BLOCK = 64  # matches after which a hypothesis that is worse already is given up
REFINEMENTS = 4  # at most
SETTLED = 1e-3  # of the threshold: a smaller step is the last
UNKNOWN_ROTATION = 0.05  # rad, what is left uncertain after the rotation has been fitted to the matches


def static_matches(x1: F64, x2: F64, R_21: F64 | None, rotation_sigma: float,
                   threshold: float) -> tuple[NDArray[np.bool_], F64]:
    """Mask (N,) of the matches x1 -> x2 (N, 2), normalised, within threshold of their epipolar lines; improved R_21.

    R_21 (3, 3) turns rays of the first camera into the second, rotation_sigma rad is its standard deviation (the
    gyro may not be calibrated yet): it is estimated together with the direction of translation. None: unknown.
    """
    R = np.eye(3) if R_21 is None else np.array(R_21, float)
    keep = np.ones(len(x1), np.bool_)
    if len(x1) >= FEWEST:
        x1, x2 = np.ascontiguousarray(x1), np.ascontiguousarray(x2)
        if R_21 is None:
            _fit_rotation(x1, x2, threshold, R)
            _consensus(x1, x2, 4.0 * threshold, UNKNOWN_ROTATION, R, keep)
        _consensus(x1, x2, threshold, UNKNOWN_ROTATION if R_21 is None else rotation_sigma, R, keep)
    return keep, R


@inner(forceinline=True)
def _turn(R, x):
    """Ray R (x, 1) as three numbers."""
    return (R[0, 0] * x[0] + R[0, 1] * x[1] + R[0, 2], R[1, 0] * x[0] + R[1, 1] * x[1] + R[1, 2],
            R[2, 0] * x[0] + R[2, 1] * x[1] + R[2, 2])


@kernel
def _fit_rotation(x1, x2, threshold, R):
    """Improve R (3, 3), in place, until R x1 best explains x2 (N, 2): Cauchy weights whose scale falls to threshold."""
    J, A, b, e, d = np.empty((2, 3)), np.empty((3, 3)), np.empty((3, 1)), np.empty(2), np.empty((3, 1))
    turn = np.empty(3)
    for step in range(8):
        scale = max(threshold, 0.2 * 0.5**step)
        A[:], b[:] = 0.0, 0.0
        A[0, 0] = A[1, 1] = A[2, 2] = 1e-9
        for i in range(len(x1)):
            X0, X1, X2 = _turn(R, x1[i])
            e[0], e[1] = x2[i, 0] - X0 / X2, x2[i, 1] - X1 / X2
            weight = 1.0 / (1.0 + (e[0] * e[0] + e[1] * e[1]) / (scale * scale))
            for q in range(3):  # d (R x1) = R (d x x1): column q of -R [x1]x
                p, s = (q + 1) % 3, (q + 2) % 3
                xp, xs = x1[i, p] if p < 2 else 1.0, x1[i, s] if s < 2 else 1.0
                d2 = R[2, s] * xp - R[2, p] * xs
                J[0, q] = (R[0, s] * xp - R[0, p] * xs - d2 * X0 / X2) / X2
                J[1, q] = (R[1, s] * xp - R[1, p] * xs - d2 * X1 / X2) / X2
            for p in range(3):
                b[p, 0] += weight * (J[0, p] * e[0] + J[1, p] * e[1])
                for q in range(3):
                    A[p, q] += weight * (J[0, p] * J[0, q] + J[1, p] * J[1, q])
        solve_positive(A, b, d)
        for p in range(3):
            turn[p] = d[p, 0]
        retract_rotation(R, turn, R)


@inner
def _epipolar_distance(X, x2, t):
    """Signed distance of x2 (2,) to the line t x X of a turned ray X (3 numbers); 0 where that line is undefined."""
    n0, n1, n2 = t[1] * X[2] - t[2] * X[1], t[2] * X[0] - t[0] * X[2], t[0] * X[1] - t[1] * X[0]
    rho = np.sqrt(n0 * n0 + n1 * n1)
    if rho < 1e-12:
        return 0.0
    return (n0 * x2[0] + n1 * x2[1] + n2) / rho


@inner(fastmath=True)
def _cost(X, x2, t, limit, best):
    """Sum of squared distances, limit at most, of x2 (2, N) to the lines t x X of turned rays X (3, N); as soon as it
    exceeds best, any number that does."""
    n, total = X.shape[1], 0.0
    for first in range(0, n, BLOCK):
        for k in range(first, min(first + BLOCK, n)):
            n0, n1 = t[1] * X[2, k] - t[2] * X[1, k], t[2] * X[0, k] - t[0] * X[2, k]
            e = n0 * x2[0, k] + n1 * x2[1, k] + t[0] * X[1, k] - t[1] * X[0, k]
            total += min(e * e / (n0 * n0 + n1 * n1 + 1e-24), limit)
        if total > best:
            break
    return total


@kernel
def _consensus(x1, x2, threshold, rotation_sigma, R, keep):
    """Fill keep (N,) and improve R: the best two-point hypothesis, refined together with the rotation, then gated."""
    n = len(x1)
    X, moment, seen = np.empty((3, n)), np.empty((n, 3)), np.empty((2, n))
    for i in range(n):
        X[0, i], X[1, i], X[2, i] = _turn(R, x1[i])
        seen[0, i], seen[1, i] = x2[i]
        moment[i, 0] = X[1, i] - X[2, i] * x2[i, 1]
        moment[i, 1] = X[2, i] * x2[i, 0] - X[0, i]
        moment[i, 2] = X[0, i] * x2[i, 1] - X[1, i] * x2[i, 0]
    t, guess, best = np.array([0.0, 0.0, 1.0]), np.empty(3), np.inf
    state = np.uint64(88172645463325252)  # xorshift64 (Marsaglia, 2003): the same draws in every run
    for _ in range(HYPOTHESES):
        state ^= state << np.uint64(13)
        state ^= state >> np.uint64(7)
        state ^= state << np.uint64(17)
        a, b = moment[int(state % np.uint64(n))], moment[int((state >> np.uint64(32)) % np.uint64(n))]
        for p in range(3):
            q, r = (p + 1) % 3, (p + 2) % 3
            guess[p] = a[q] * b[r] - a[r] * b[q]
        length = np.sqrt(guess[0] ** 2 + guess[1] ** 2 + guess[2] ** 2)
        if length < 1e-14:
            continue
        for p in range(3):
            guess[p] /= length
        cost = _cost(X, seen, guess, 4.0 * threshold * threshold, best)
        if cost < best:
            best = cost
            for p in range(3):
                t[p] = guess[p]
    _refine(x1, x2, threshold, rotation_sigma, R, t)
    for k in range(n):
        keep[k] = abs(_epipolar_distance(_turn(R, x1[k]), x2[k], t)) < threshold


@kernel
def _refine(x1, x2, threshold, rotation_sigma, R, t):
    """Gauss-Newton on R <- R Exp(d) (prior: no change, rotation_sigma) and on the direction t (3,), in place.

    r = x2 . (t x X1) / rho with rho = |(t x X1)_xy|; the small change of r through rho is left out.
    """
    A, b, d, J = np.empty((5, 5)), np.empty((5, 1)), np.empty((5, 1)), np.empty(5)
    change, turn, c, e1, e2 = np.zeros(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for _ in range(REFINEMENTS):
        _axes_across(t, e1, e2)
        A[:], b[:] = 0.0, 0.0
        for p in range(3):
            A[p, p] = (threshold / rotation_sigma) ** 2
            b[p, 0] = -A[p, p] * change[p]
        A[3, 3] = A[4, 4] = 1e-9
        for i in range(len(x1)):
            X0, X1, X2 = _turn(R, x1[i])
            y0, y1 = x2[i]
            n0, n1 = t[1] * X2 - t[2] * X1, t[2] * X0 - t[0] * X2
            rho = np.sqrt(n0 * n0 + n1 * n1)
            if rho < 1e-12:
                continue
            c[0], c[1], c[2] = X1 - X2 * y1, X2 * y0 - X0, X0 * y1 - X1 * y0  # X1 x x2
            r = (t[0] * c[0] + t[1] * c[1] + t[2] * c[2]) / rho
            if abs(r) > 4.0 * threshold:
                continue
            m0, m1, m2 = y1 * t[2] - t[1], t[0] - y0 * t[2], y0 * t[1] - y1 * t[0]  # x2 x t
            k0, k1, k2 = X1 * m2 - X2 * m1, X2 * m0 - X0 * m2, X0 * m1 - X1 * m0  # X1 x (x2 x t)
            for p in range(3):
                J[p] = (R[0, p] * k0 + R[1, p] * k1 + R[2, p] * k2) / rho
            J[3] = (e1[0] * c[0] + e1[1] * c[1] + e1[2] * c[2]) / rho
            J[4] = (e2[0] * c[0] + e2[1] * c[1] + e2[2] * c[2]) / rho
            weight = 1.0 / (1.0 + (r / threshold) ** 2)
            for p in range(5):
                b[p, 0] -= weight * J[p] * r
                for q in range(p + 1):
                    A[p, q] += weight * J[p] * J[q]
        solve_positive(A, b, d)  # of A it takes the lower triangle
        turned, moved = 0.0, d[3, 0] * d[3, 0] + d[4, 0] * d[4, 0]
        for p in range(3):
            turn[p] = d[p, 0]
            change[p] += turn[p]
            turned += turn[p] * turn[p]
            t[p] = (t[p] + d[3, 0] * e1[p] + d[4, 0] * e2[p]) / np.sqrt(1.0 + moved)
        retract_rotation(R, turn, R)
        if turned < SETTLED * SETTLED * threshold * threshold and moved < SETTLED * SETTLED:
            break


@inner
def _axes_across(t, e1, e2):
    """Fill e1, e2 (3,) with unit vectors at right angles to the unit vector t and to each other."""
    if abs(t[0]) < 0.7:
        e1[0], e1[1], e1[2] = 0.0, t[2], -t[1]
    else:
        e1[0], e1[1], e1[2] = -t[2], 0.0, t[0]
    length = np.sqrt(e1[0] * e1[0] + e1[1] * e1[1] + e1[2] * e1[2])
    for p in range(3):
        e1[p] /= length
    for p in range(3):
        q, r = (p + 1) % 3, (p + 2) % 3
        e2[p] = t[q] * e1[r] - t[r] * e1[q]
