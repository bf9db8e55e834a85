"""Compiled search for patches from image to image: as they were learned, or as they were in the previous image."""
from __future__ import annotations

import numpy as np

from line_slam_ros.frontend.affine_kernels import align, workspace
from line_slam_ros.frontend.patch_kernels import AREA, LANES, SETTLED, SIZE, descend
from line_slam_ros.kernel_cache import inner, kernel

SAME_PATCH = 0.85  # correlation above which a patch still shows what it showed when it was learned
STRAY_PX = 1.5  # the learned patch must be found this near to where the previous image puts it
FAITH_PX = 3.0  # or this near to where it is expected by its motion
DECIDED = 0.2  # of the distance allowed after the way back: the steps after a smaller one decide nothing
SMALLEST, LARGEST = 0.5, 2.0  # range of the area ratio for which the learned patch is kept


@inner
def shows_the_same(score, uv, guess, reach, A):
    """Is the learned patch there, near enough to the guess and not too much deformed?"""
    area = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    return score > SAME_PATCH and (uv[0] - guess[0])**2 + (uv[1] - guess[1])**2 < reach * reach \
        and SMALLEST < area < LARGEST


@kernel
def predict(R, x, motion, pace, x_turned, x_expected, turns):
    """Where normalised points x (N, 2) are after the rotation R of the camera, and with pace times their motion (N, 2).

    Fills x_turned, x_expected (N, 2), NaN behind the camera, and turns (N, 2, 2), the derivative of the first by x.
    """
    for i in range(len(x)):
        u, v = x[i]
        z = R[2, 0] * u + R[2, 1] * v + R[2, 2]
        z = z if z > 0.0 else np.nan
        for p in range(2):
            x_turned[i, p] = (R[p, 0] * u + R[p, 1] * v + R[p, 2]) / z
            x_expected[i, p] = x_turned[i, p] + pace * motion[i, p]
            for q in range(2):
                turns[i, p, q] = (R[p, q] - x_turned[i, p] * R[2, q]) / z


@kernel
def match(previous, newest, start, turns, rotated, moved_on, slots, templates, moments, inverses, round_trip,
          border, uv, shapes, found):
    """Find the patches that were at start (N, 2) in the previous image in the newest one.

    previous, newest: pyramids; turns (N, 2, 2): what is at x from a patch's middle will be at turns x; rotated and
    moved_on (N, 2): where patches are expected by the rotation and by their motion. uv (N, 2) <- where they are, shapes
    (N, 2, 2) are carried on. found (N,): 0 no, 1 as it was learned, 2 only as it was in the previous image; only if it
    is as far from the rim as border px and the way back ends within round_trip px.
    """
    patch, J = np.zeros((SIZE + 2, LANES + 2), np.float32), np.empty((3, AREA), np.float32)
    A, M, here, guess, back = np.empty((2, 2)), np.empty((2, 2)), np.empty(2), np.empty(2), np.empty(2)
    image, work = newest[0], workspace()
    (height, width), near_enough = image.shape, (DECIDED * round_trip)**2
    for i in range(len(start)):
        slot, T, found[i] = slots[i], turns[i], 0
        determinant = T[0, 0] * T[1, 1] - T[0, 1] * T[1, 0]
        M[0, 0], M[0, 1] = T[1, 1] / determinant, -T[0, 1] / determinant
        M[1, 0], M[1, 1] = -T[1, 0] / determinant, T[0, 0] / determinant
        for way in range(2):
            u, v = moved_on[i] if way == 0 else rotated[i]
            known = abs(u + v) < np.inf
            guess[0], guess[1] = u if known else start[i, 0], v if known else start[i, 1]
            if way == 1:
                descend(previous, newest, start[i], M, guess, 1, SETTLED, patch, J)
            for p in range(2):
                here[p] = guess[p]
                for q in range(2):
                    A[p, q] = T[p, 0] * shapes[i, 0, q] + T[p, 1] * shapes[i, 1, q]
            score = align(image, templates[slot], moments[slot], inverses[slot], here, A, work)
            found[i] = shows_the_same(score, here, guess, FAITH_PX if way == 0 else STRAY_PX, A)
            if found[i]:
                break
        if found[i] == 0:
            here[0], here[1] = guess[0], guess[1]
            if not descend(previous, newest, start[i], M, here, 0, SETTLED, patch, J):
                continue
            found[i], A[0, 0], A[0, 1], A[1, 0], A[1, 1] = 2, 1.0, 0.0, 0.0, 1.0
        for p in range(2):
            uv[i, p], back[p] = here[p], start[i, p]
            for q in range(2):
                shapes[i, p, q] = A[p, q]
        good = border < here[0] < width - 1.0 - border and border < here[1] < height - 1.0 - border
        good = good and descend(newest, previous, here, T, back, 0, near_enough, patch, J)
        if not (good and (back[0] - start[i, 0])**2 + (back[1] - start[i, 1])**2 < round_trip * round_trip):
            found[i] = 0
