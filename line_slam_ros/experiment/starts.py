"""First estimates of lines from planes through the cameras and the segments that they saw.

    two-plane       the host's plane and the one at the widest angle to it
    best-parallax   the two planes at the widest angle of all
    svd             all planes at once, in the algebraic sense
    consensus       of many pairs the one whose line most planes come near to, so that wrong views do not matter
    truth           the true line, to tell what a start costs

Angles are compared by |cos|, so the order in which a segment's ends were observed does not matter.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from line_slam_ros.experiment.methods import STARTS
from line_slam_ros.experiment.problem import LineProblem
from line_slam_ros.geometry.lie import rigid, rigid_inverse
from line_slam_ros.geometry.lines import (
    line_from_many_planes,
    line_from_planes,
    line_from_points,
    observation_plane,
    plane_cosine,
    transform_lines,
    trim,
    unit_direction,
    widest_pair,
)
from line_slam_ros.types import F64

PAIRS, JUDGES = 64, 64  # tried by consensus, and views that judge them
TOGETHER = 100  # lines judged at a time, to bound memory
IN_FRONT = 0.5  # share of the feet that must lie in front of their cameras
FEW_FRAMES, NO_PARALLAX, BEHIND = 'seen in fewer than 2 frames', 'no parallax', 'behind the cameras'


@dataclass(frozen=True, slots=True)
class Starts:
    """pluecker (L, 6) about each line's origin with the axes of W, |d| = 1; reason (L,) is '' where it holds."""

    pluecker: F64
    reason: np.ndarray  # (L,) of str objects


def start_lines(problem: LineProblem, name: str, min_parallax_deg: float) -> Starts:
    """A start for every line that can have one. ValueError for a name that is none of STARTS."""
    if name not in STARTS:
        raise ValueError(f'start must be one of {", ".join(STARTS)}, got {name!r}')
    T_OC = rigid(problem.poses[..., :3], problem.poses[..., 3] - problem.origin()[problem.line])
    planes = observation_plane(T_OC, problem.ends)
    bounds = zip(problem.first, problem.last, strict=True)
    pairs = np.array([_pair(planes[first:last], name == 'two-plane') for first, last in bounds])
    rows = np.minimum(problem.first + pairs.T, len(planes) - 1)  # those of a line without views mean nothing
    if name == 'svd':
        lines = line_from_many_planes(_stacked(problem, planes))
    elif name == 'consensus':
        lines = _from_consensus(problem, planes)
    elif name == 'truth':
        lines = _true_lines(problem)
    else:
        lines = line_from_planes(*planes[rows])
    parallax_deg = np.degrees(np.arccos(np.minimum(plane_cosine(*planes[rows]), 1.0)))
    flat = ~(parallax_deg >= min_parallax_deg) | np.isnan(lines).any(axis=1)
    behind = _share_in_front(problem, T_OC, lines) <= IN_FRONT
    reasons = [FEW_FRAMES, f'{NO_PARALLAX}: all planes within {min_parallax_deg:g} deg', BEHIND]
    return Starts(lines, np.select([problem.count < 2, flat, behind], reasons, '').astype(object))


def _pair(planes: F64, from_host: bool) -> tuple[int, int]:
    """Rows of the two of a line's planes (K, 4) at the widest angle, one of them the host's if asked for."""
    if len(planes) < 2:
        return 0, 0
    if from_host:
        return 0, int(np.argmin(np.nan_to_num(plane_cosine(planes, planes[0]), nan=1.0)))  # NaN: no plane
    return widest_pair(planes)[:2]


def _stacked(problem: LineProblem, planes: F64) -> F64:
    """Four rows (L, 4, 4) with the same null space as all planes (M, 4) of each line: the triangle of their QR."""
    rows = np.arange(max(4, problem.count.max())) < problem.count[:, None]
    table = np.zeros((*rows.shape, 4))
    table[rows] = np.nan_to_num(planes)
    return np.linalg.qr(table, mode='r')


def _from_consensus(problem: LineProblem, planes: F64) -> F64:
    """Of random pairs of planes the line (L, 6) for which the median angle is least between the observation planes and
    those that the line itself has with the cameras. Same views, same pairs."""
    parts = [slice(k, k + TOGETHER) for k in range(0, len(problem.first), TOGETHER)]
    return np.concatenate([_judged(problem, planes, part) for part in parts])


def _judged(problem: LineProblem, planes: F64, part: slice) -> F64:
    """_from_consensus for some of the lines."""
    first, count, last = problem.first[part, None], problem.count[part, None], len(planes) - 1
    choice = np.random.default_rng(0).random((2, PAIRS))
    i, j = (np.minimum(first + (u * count).astype(np.int64), last) for u in choice)
    lines = line_from_planes(planes[i], planes[j])
    judges = np.minimum(first + (np.linspace(0.0, 1.0, JUDGES, endpoint=False) * count).astype(np.int64), last)
    centre = problem.poses[judges, :, 3] - problem.origin()[part, None]
    n = lines[:, :, None, :3] - np.cross(centre[:, None], lines[:, :, None, 3:])  # (L, PAIRS, JUDGES, 3)
    with np.errstate(invalid='ignore'):  # no plane holds the camera and a line through its centre
        cosine2 = np.einsum('lpvi,lvi->lpv', n, planes[judges, :3]) ** 2 / np.sum(n * n, axis=-1)
    agreement = np.median(np.nan_to_num(cosine2), axis=-1)
    return lines[np.arange(len(lines)), np.argmax(agreement, axis=1)]


def _true_lines(problem: LineProblem) -> F64:
    ends = problem.segments - problem.origin()[:, None]
    return unit_direction(line_from_points(ends[:, 0], ends[:, 1]))


def _share_in_front(problem: LineProblem, T_OC: F64, lines: F64) -> F64:
    """Share (L,) of the observed ends whose feet on the line lie in front of their cameras; 0 without views."""
    feet = trim(transform_lines(rigid_inverse(T_OC), lines[problem.line, None])[:, 0], problem.ends)
    good = np.isfinite(feet).all(axis=-1).mean(axis=-1)
    return np.bincount(problem.line, good, len(lines)) / np.maximum(problem.count, 1)
