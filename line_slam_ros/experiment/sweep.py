"""Methods against noise: the same problem, disturbed again and again by seed, solved by each method."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace

import numpy as np

from line_slam_ros.experiment.files import Experiment, add_noise
from line_slam_ros.experiment.methods import Method
from line_slam_ros.experiment.problem import LineProblem
from line_slam_ros.experiment.score import score
from line_slam_ros.experiment.solving import Result, fit, solve_lines, store
from line_slam_ros.experiment.starts import start_lines


@dataclass(frozen=True, slots=True)
class Run:
    """One method on one noisy copy of the views."""

    noise_px: float
    seed: int
    method: str
    lines: int
    failures: int
    unconverged: int  # lines that used all the steps they may take
    outliers: int  # views that do not count
    cost: float
    sigma_px: float  # that weighed the residuals
    iterations: int
    start_s: float
    solve_s: float
    angle_deg_mean: float
    angle_deg_max: float
    perpendicular_m_mean: float
    perpendicular_m_max: float
    endpoint_m_mean: float
    endpoint_m_max: float
    failed: dict[int, str]  # reason by line


def disturbed(experiment: Experiment, noise_px: float, seed: int, focal: float) -> LineProblem:
    """The problem with noise of so many pixels on its views."""
    return LineProblem.of(replace(experiment, views=add_noise(experiment.views, noise_px / focal, seed)))


def sweep(experiment: Experiment, methods: Mapping[str, Method], noise_px: Sequence[float],
          seeds: Sequence[int]) -> list[Run]:
    """Every method, by its name, at every noise level and seed; without noise all seeds are one."""
    runs = []
    for level in noise_px:
        for seed in seeds if level > 0.0 else seeds[:1]:
            for name, method in methods.items():
                problem = disturbed(experiment, level, seed, method.focal)
                runs.append(summarise(problem, solve_lines(problem, method), name, level, seed))
    return runs


def summarise(problem: LineProblem, result: Result, method: str, noise_px: float, seed: int) -> Run:
    """The figures of one result."""
    errors = score(problem.segments, result.pluecker, result.ends).summary()
    failed = {int(i): str(result.reason[i]) for i in np.flatnonzero(~result.ok)}
    unconverged = int(np.sum(result.ok & ~result.converged))
    return Run(noise_px, seed, method, len(result.reason), len(failed), unconverged, int(result.outliers.sum()),
               result.total_cost, result.sigma_px, result.iterations, result.start_s, result.solve_s, **errors,
               failed=failed)


def means(runs: Sequence[Run]) -> list[Run]:
    """One row per noise level and method: the mean over its seeds, the maximum of the maxima; seed is their number,
    failed holds the lines that failed with any of them. A seed without an answer does not enter."""
    groups: dict[tuple[float, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.noise_px, run.method), []).append(run)
    return [_mean(group) for group in groups.values()]


def _mean(group: list[Run]) -> Run:
    row = asdict(group[0])
    for name in (f.name for f in fields(Run) if f.name not in ('noise_px', 'method', 'lines', 'failed')):
        values = np.array([getattr(run, name) for run in group], float)
        known = values[np.isfinite(values)]
        row[name] = float(known.max() if name.endswith('_max') else known.mean()) if len(known) else float('nan')
    failed = {line: reason for run in reversed(group) for line, reason in run.failed.items()}
    return Run(**{**row, 'seed': len(group), 'failed': failed})


def time_joint(problem: LineProblem, method: Method, iterations: int = 10, repeats: int = 3) -> float:
    """Wall seconds of so many joint iterations on all lines that can be started, kernels warm; the best of repeats.

    ValueError when none can.
    """
    method = replace(method, joint=True, iterations=iterations, tolerance=0.0, gate=None,
                     sigma_px=method.sigma_px or 1.0)
    rows, values, _ = store(problem, method, start_lines(problem, method.start, method.min_parallax_deg))
    if not len(rows):
        raise ValueError('none of the lines can be started: there is nothing to time')
    return min(fit(problem, method, rows, values.copy()).seconds for _ in range(repeats))
