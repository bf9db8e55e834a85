"""Figures of the Monte Carlo runs: JSON, Markdown, plot."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from line_slam_ros import evaluation
from line_slam_ros.benchmark.consistency import Trace
from line_slam_ros.benchmark.nees import FREEDOM, bounds
from line_slam_ros.benchmark.sections import number, table
from line_slam_ros.types import F64

EXPLANATION = """\
Simulated features, no images; noise of the IMU as EuRoC's, biases at random, every other run starts from rest. Position
and heading are known only relative to the start, so the truth is moved to the estimate's first state by position and
heading (four numbers) before errors are taken; ATE is evo's, after SE(3) alignment. NEES per degree of freedom is 1 if
the covariance is right and more if it is too small; its mean over the runs, at their end, lies within the 95 % bounds
if the runs are independent and the covariance is right. The average over time has no such bounds: it is correlated.
Of lines, those good enough for the map count, by their offset across at both true ends. Their covariance is that
as the newest camera knows them: seen from the newest pose, that pose's own error is taken out."""


@dataclass(frozen=True, slots=True)
class Level:
    """All runs with the same noise, with or without lines."""

    pixel_sigma: float
    lines: bool
    runs: int
    failures: tuple[str, ...]
    ate_m: tuple[float, ...]  # of each run that started
    t_s: tuple[float, ...]  # whole seconds
    over_time: dict[str, tuple[float, ...]]  # quantity -> mean NEES per degree of freedom at t_s; NaN where none
    at_end: dict[str, float]  # quantity -> mean over the runs' ends, per degree of freedom
    average: dict[str, float]  # the same over all runs and times
    bounds: dict[str, tuple[float, float]]  # of at_end


def level_of(traces: Sequence[Trace]) -> Level:
    """Traces of one noise level, all with or all without lines."""
    world, whole = traces[0].world, [t for t in traces if not t.failure]
    seconds = np.arange(1, int(world.seconds) + 1)
    started = [t for t in traces if len(t.t_s) > 2]
    names = [name for name in FREEDOM if any(name in t.nees for t in whole)]
    over_time = {name: tuple(_over_time(whole, name, seconds).tolist()) for name in names}
    at_end = {name: _mean([_last(t.nees[name]) for t in whole]) / FREEDOM[name] for name in names}
    average = {name: _mean([_mean(t.nees[name]) for t in whole]) / FREEDOM[name] for name in names}
    return Level(world.pixel_sigma, world.lines, len(traces), tuple(t.failure for t in traces if t.failure),
                 tuple(map(_ate, started)), tuple(seconds.tolist()), over_time, at_end, average,
                 {name: bounds(FREEDOM[name], len(whole)) for name in names})


def _ate(trace: Trace) -> float:
    stamps = np.array(trace.t_s)
    return evaluation.ate_rmse_m(evaluation.trajectory(stamps, np.array(trace.T_EB)),
                                 evaluation.trajectory(stamps, np.array(trace.true_T_EB)))


def _over_time(traces: Sequence[Trace], name: str, seconds: np.ndarray) -> F64:
    """Mean over the runs of what is known within the second that ends at each of the given (S,), per freedom."""
    means = np.full((len(traces), len(seconds)), np.nan)
    for row, trace in zip(means, traces, strict=True):
        t, values = np.array(trace.t_s), np.array(trace.nees[name])
        for k, end in enumerate(seconds):
            row[k] = _mean(values[(t > end - 1) & (t <= end)])
    return np.array([_mean(column) for column in means.T]) / FREEDOM[name]


def _mean(values: Any) -> float:
    """Of the finite ones; NaN if there is none."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else float('nan')


def _last(values: list[float]) -> float:
    """The last that is known."""
    return next((v for v in reversed(values) if np.isfinite(v)), float('nan'))


def consistency_section(levels: Sequence[Level], what: str) -> str:
    """Accuracy against noise, and NEES; what: one line about the runs."""
    accuracy = [[f'{v.pixel_sigma:g}', _with(v), str(v.runs), str(len(v.failures)),
                 *(number(_quantile(v.ate_m, q), '.4f') for q in (0.5, 0.9, 1.0)),
                 number(_mean(v.ate_m), '.4f')] for v in levels]
    honest = [[f'{v.pixel_sigma:g}', _with(v), name, str(FREEDOM[name]), number(v.at_end[name], '.2f'),
               '{:.2f} to {:.2f}'.format(*v.bounds[name]), number(v.average[name], '.2f')]
              for v in levels for name in v.at_end]
    failures = [f'- {v.pixel_sigma:g} px, {_with(v)}: {reason}' for v in levels for reason in v.failures]
    parts = [EXPLANATION, f'{what}:',
             table(['noise, px', 'with', 'runs', 'failed', 'ATE median, m', 'ATE 90 %, m', 'ATE max, m', 'ATE mean, m'],
                   accuracy),
             table(['noise, px', 'with', 'quantity', 'freedom', 'NEES at the end', '95 % bounds', 'average'], honest)]
    return '\n\n'.join(parts + (['Failures:\n\n' + '\n'.join(failures)] if failures else []))


def _with(level: Level) -> str:
    return 'points and lines' if level.lines else 'points'


def _quantile(values: Sequence[float], q: float) -> float | None:
    return float(np.quantile(values, q)) if values else None


def plot(path: Path, levels: Sequence[Level]) -> None:
    """NEES over time with its bounds, and ATE against noise, as a PNG."""
    names = list(dict.fromkeys(name for v in levels for name in v.over_time))
    sheet = Figure(figsize=(15, 8), layout='constrained')
    FigureCanvasAgg(sheet)
    axes = sheet.subplots(2, -(-(len(names) + 1) // 2), squeeze=False).ravel()
    for ax, name in zip(axes, names, strict=False):
        _draw_nees(ax, name, [v for v in levels if name in v.over_time])
    _draw_accuracy(axes[len(names)], levels)
    for ax in axes[len(names) + 1:]:
        ax.set_axis_off()
    sheet.savefig(path, dpi=100, metadata={'Software': None})


def _draw_nees(axes: Any, name: str, levels: Sequence[Level]) -> None:
    for v in levels:
        axes.plot(v.t_s, v.over_time[name], label=f'{v.pixel_sigma:g} px, {_with(v)}')
    axes.axhspan(*levels[0].bounds[name], color='0.85', zorder=0)
    axes.axhline(1.0, color='0.4', linewidth=0.8)
    axes.set(title=name, xlabel='time [s]', ylabel='NEES per degree of freedom', yscale='log')
    axes.legend(fontsize='small')


def _draw_accuracy(axes: Any, levels: Sequence[Level]) -> None:
    for lines in sorted({v.lines for v in levels}):
        chosen = [v for v in levels if v.lines == lines and v.ate_m]
        axes.plot([v.pixel_sigma for v in chosen], [np.median(v.ate_m) for v in chosen], 'o-',
                  label=_with(chosen[0]) if chosen else '')
    axes.set(title='accuracy', xlabel='noise [px]', ylabel='median ATE [m]')
    axes.legend(fontsize='small')
