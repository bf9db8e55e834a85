"""Solving a LineProblem by a Method: start, fit, trim; what cannot be solved keeps its place and gets a reason."""
from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from line_slam_ros.estimation.line_solver import CHI2_MEDIAN, fit_lines, normal_equations
from line_slam_ros.experiment.ends import NO_ENDS, find_ends
from line_slam_ros.experiment.methods import Method
from line_slam_ros.experiment.problem import LineProblem
from line_slam_ros.experiment.starts import Starts, start_lines
from line_slam_ros.geometry.line_forms import VALUES, store_lines, unit_world_lines
from line_slam_ros.types import F64, I64, LineSegments, Loss

FEW_VIEWS = 'too few views besides the host'
CONTRADICTED = 'most of its views contradict it'
NOT_HELD = 'the form cannot hold it'
LEAST_SIGMA_PX = 1e-4  # that the residuals are believed
AGREEING = 0.5  # share of the views that must lie within the gate
SIGMA_ROUNDS, SIGMA_SETTLED = 20, 1e-8  # fits until sigma changes by less than this part of it


@dataclass(frozen=True, slots=True)
class Result:
    """What a method made of L lines; NaN where a line has no answer, and reason says why."""

    pluecker: F64  # (L, 6) in W, |d| = 1
    ends: F64  # (L, 2, 3) m
    cost: F64  # (L,) half the sum of the losses of the line's views
    steps: I64  # (L,) Levenberg-Marquardt steps taken, in all fits together
    converged: np.ndarray  # (L,) bool, False where the last fit used all the steps it may take
    outliers: I64  # (L,) views over the gate, which do not count
    reason: np.ndarray  # (L,) of str, '' for a line with an answer
    sigma_px: float  # that weighed the residuals
    start_s: float  # wall time of the starts
    solve_s: float  # wall time of the solution alone, kernels warm

    @property
    def ok(self) -> np.ndarray:
        """Which lines (L,) have an answer."""
        return self.reason == ''

    @property
    def total_cost(self) -> float:
        """Of all lines that were solved."""
        return float(np.nansum(self.cost))

    @property
    def iterations(self) -> int:
        """Steps of the line that took the most; of all of them if they were solved jointly."""
        return int(self.steps.max(initial=0))

    def segments(self, views: I64) -> LineSegments:
        """The lines with an answer as a map; views (L,) of each. Nothing is known of their sigma."""
        ids = np.flatnonzero(self.ok)
        return LineSegments(ids, self.pluecker[ids], self.ends[ids], views[ids], np.full(len(ids), np.nan))


def solve_lines(problem: LineProblem, method: Method) -> Result:
    """Start, solve and trim every line. Lines that cannot be solved stay in the result, with a reason."""
    started = perf_counter()
    starts = start_lines(problem, method.start, method.min_parallax_deg)
    start_s = perf_counter() - started
    rows, values, reason = store(problem, method, starts)
    lines = len(reason)
    pluecker, cost, steps = np.full((lines, 6), np.nan), np.full(lines, np.nan), np.zeros(lines, np.int64)
    converged = np.zeros(lines, bool)
    fitted = fit(problem, method, rows, values)
    contradicted = rows[_contradicted(problem, method, fitted.counted)[rows]]
    reason[contradicted] = CONTRADICTED
    steps[rows], converged[rows] = fitted.steps, fitted.steps_last < method.iterations
    cost[rows] = fitted.cost
    pluecker[rows] = unit_world_lines(int(method.form), values, problem.origin()[rows])[0]
    cost[contradicted], pluecker[contradicted] = np.nan, np.nan
    counted = problem.only(fitted.counted)
    ends = find_ends(counted, pluecker, method.ends, method.end_share, fitted.sigma)
    reason[(reason == '') & np.isnan(ends).any(axis=(1, 2))] = NO_ENDS
    return Result(pluecker, ends, cost, steps, converged, problem.count - counted.count, reason,
                  fitted.sigma * method.focal, start_s, fitted.seconds)


def _contradicted(problem: LineProblem, method: Method, counted: np.ndarray) -> np.ndarray:
    """Lines (L,) of whose views too few count: not more than fix it, or not most."""
    counts = np.arange(len(counted)) >= _first(problem, method)[problem.line]
    used = np.bincount(problem.line[counts], minlength=len(problem.first))
    left = np.bincount(problem.line[counts & counted], minlength=len(problem.first))
    return (left < used) & ((2 * left <= method.form.freedom) | (left <= AGREEING * used))


def store(problem: LineProblem, method: Method, starts: Starts) -> tuple[I64, F64, np.ndarray]:
    """Rows (N,) of the lines to solve, their starts as values (N, VALUES) of the form, and what is wrong with each of
    all lines (L,)."""
    reason = starts.reason.copy()
    used = problem.last - _first(problem, method)
    reason[(reason == '') & (2 * used < method.form.freedom)] = FEW_VIEWS
    rows = np.flatnonzero(reason == '')
    host = problem.first[rows]
    values, held = np.empty((len(rows), VALUES)), np.empty(len(rows), np.bool_)
    store_lines(int(method.form), starts.pluecker[rows], np.ascontiguousarray(problem.poses[host, :, :3]),
                problem.ends[host], values, held)
    reason[rows[~held]] = NOT_HELD
    return rows[held], values[held], reason


@dataclass(frozen=True, slots=True)
class Fit:
    """Of N lines and M views."""

    cost: F64  # (N,)
    steps: I64  # (N,)
    steps_last: I64  # (N,) of the last fit alone
    sigma: float  # normalised
    counted: np.ndarray  # (M,) bool, False for views over the gate
    seconds: float


def fit(problem: LineProblem, method: Method, rows: I64, values: F64) -> Fit:
    """Moves values (N, VALUES) to the minimum.

    What is not given is found on the way, with a loss that wrong views hardly touch: first sigma from the scatter of
    the residuals, then the views over the gate. The last fit, by the loss of the method, does not count these.
    """
    counted, steps = np.ones(len(problem.poses), bool), np.zeros(len(rows), np.int64)
    search = method if method.gate is None else replace(method, loss=Loss.CAUCHY)
    _descend(problem, search, rows[:1], values[:1].copy(), 1.0, counted)  # compile or load the kernels
    _distances2(problem, search, rows[:1], values[:1])
    started = perf_counter()
    if method.sigma_px is None:
        sigma = _scatter(problem, search, rows, values)
        for _ in range(SIGMA_ROUNDS):
            before = sigma
            steps += _descend(problem, search, rows, values, sigma, counted)[1]
            sigma = _scatter(problem, search, rows, values)
            if abs(sigma - before) <= SIGMA_SETTLED * before:
                break
    else:
        sigma = method.sigma_px / method.focal
    if method.gate is not None:
        steps += _descend(problem, search, rows, values, sigma, counted)[1]
        counted = ~(_distances2(problem, search, rows, values) > method.gate * sigma**2)
    cost, last = _descend(problem, method, rows, values, sigma, counted)
    return Fit(cost, steps + last, last, sigma, counted, perf_counter() - started)


def _descend(problem: LineProblem, method: Method, rows: I64, values: F64, sigma: float,
             counted: np.ndarray) -> tuple[F64, I64]:
    """Cost (N,) and steps (N,) of a fit to the views that count."""
    cost, steps = np.zeros(len(rows)), np.zeros(len(rows), np.int64)
    sigmas = np.where(counted, sigma, np.inf)[:, None].repeat(2, axis=1)
    fit_lines(int(method.form), int(method.loss), method.loss_scale**2, method.joint, _first(problem, method)[rows],
              problem.last[rows], problem.poses, problem.ends, sigmas, values, problem.origin()[rows],
              method.iterations, method.tolerance, cost, steps)
    return cost, steps


def _scatter(problem: LineProblem, method: Method, rows: I64, values: F64) -> float:
    """Standard deviation (normalised) of an observed end across its line, from the median over all views."""
    least = LEAST_SIGMA_PX / method.focal
    if not len(rows):
        return least
    return max(float(np.sqrt(np.nanmedian(_distances2(problem, method, rows, values)) / CHI2_MEDIAN)), least)


def _distances2(problem: LineProblem, method: Method, rows: I64, values: F64) -> F64:
    """Squared distances (M,), both ends together, of the views from their lines in the normalised image; NaN for views
    that do not count."""
    e2, H, g = np.full(len(problem.poses), np.nan), np.empty((4, 4)), np.empty(4)
    one, origin, first = np.ones((len(problem.poses), 2)), problem.origin(), _first(problem, method)
    for i, line in zip(rows, values, strict=True):
        own = slice(first[i], problem.last[i])
        normal_equations(int(method.form), int(Loss.L2), 1.0, problem.poses[own], problem.ends[own], one[own], line,
                         origin[i], H, g, e2[own])
    return e2


def _first(problem: LineProblem, method: Method) -> I64:
    """First view (L,) that counts."""
    return problem.first if method.use_host else np.minimum(problem.first + 1, problem.last)
