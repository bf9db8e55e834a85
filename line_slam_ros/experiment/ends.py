"""Where the estimated lines begin and end: every view's feet on the line, then a rule over the views.

    shrink      the innermost feet of all views: what every view saw
    median      the middle of the feet of all views, per end
    extend      the outermost feet of all views: what any view saw
    quantile    all but a share of the feet lie inside
    vote        the outermost position that a share of the views confirm: mapping/trimming.py

Feet by the third form of geometry.lines.trim, gated view by view: in front of the camera, within reach, and not seen
at too flat an angle to the line. One bad view costs itself, not the line. The first three rules are those of the line
code base and of the equation document; noise moves the first and the third without bound, clipped views the second.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.experiment.methods import END_RULES
from line_slam_ros.experiment.problem import LineProblem
from line_slam_ros.geometry.lie import rigid, rigid_inverse
from line_slam_ros.geometry.lines import closest_point, transform_lines, trim
from line_slam_ros.mapping import trimming
from line_slam_ros.types import F64

NO_ENDS = 'no view shows its ends'
FURTHEST = 100.0  # m, feet further from the camera are not used


def find_ends(problem: LineProblem, pluecker: F64, rule: str, share: float, sigma: float) -> F64:
    """End points (L, 2, 3) m of lines (L, 6) in W with |d| = 1; NaN where no view has usable feet, or the line is NaN.

    share: of the views, outside of a quantile or confirming a vote; sigma: smallest standard deviation of an observed
    end, normalised. ValueError for a rule that is none of END_RULES.
    """
    if rule not in END_RULES:
        raise ValueError(f'rule for end points must be one of {", ".join(END_RULES)}, got {rule!r}')
    if rule == 'vote':
        extents = _by_vote(problem, pluecker, share, sigma)
    else:
        level = {'shrink': 1.0, 'median': 0.5, 'extend': 0.0, 'quantile': share}[rule]  # from the outermost inwards
        extents = _by_quantile(problem, extents_of_views(problem, pluecker), level)
    return closest_point(pluecker)[:, None] + extents[..., None] * pluecker[:, None, 3:]


def extents_of_views(problem: LineProblem, pluecker: F64) -> F64:
    """Positions p . d (M, 2) of both ends of each view on its line, the lower one first; NaN for an unusable one."""
    T_CW = rigid_inverse(rigid(problem.poses[..., :3], problem.poses[..., 3]))
    lines = pluecker[problem.line]
    L_C = transform_lines(T_CW, lines[:, None])[:, 0]
    feet = trim(L_C, problem.ends, 'projected', trimming.NEAREST)
    reach, distance = np.linalg.norm(feet, axis=-1), np.linalg.norm(L_C[:, None, :3], axis=-1)
    usable = (reach < FURTHEST) & (distance > trimming.STEEPEST * reach)
    along = np.sum(feet * L_C[:, None, 3:], axis=-1) + np.sum(problem.poses[..., 3] * lines[:, 3:], axis=1)[:, None]
    return np.sort(np.where(usable, along, np.nan), axis=1)


def _by_quantile(problem: LineProblem, positions: F64, level: float) -> F64:
    """Extents (L, 2) of positions (M, 2): 0 is the outermost of each end, 1 the innermost."""
    extents = np.full((len(problem.first), 2), np.nan)
    for i, (a, b) in enumerate(zip(problem.first, problem.last, strict=True)):
        low, high = positions[a:b][np.isfinite(positions[a:b]).all(axis=1)].T
        if len(low):
            extents[i] = np.quantile(low, level), np.quantile(high, 1.0 - level)
    return extents


def _by_vote(problem: LineProblem, pluecker: F64, share: float, sigma: float) -> F64:
    trimmed, parallax = np.empty((len(pluecker), 2, 3)), np.empty(len(pluecker))
    trimming.trim(np.arange(len(pluecker)), np.ascontiguousarray(pluecker), problem.padded(problem.poses),
                  problem.padded(problem.ends), problem.count, FURTHEST, share, sigma, trimmed, parallax)
    return np.einsum('lej,lj->le', trimmed, pluecker[:, 3:])
