"""Pictures of the line experiment: errors line by line, and methods against noise and against time."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from line_slam_ros.experiment.score import Errors
from line_slam_ros.experiment.sweep import Run
from line_slam_ros.types import F64

_TRUE, _ESTIMATED, _FAILED = '#9a9a9a', '#0060c0', '#e04000'
_MARKERS = 'os^Dv*PX'


def save_errors(path: Path, segments: F64, ends: F64, errors: Errors) -> None:
    """A PNG of true segments (L, 2, 3) and estimated ones, NaN where there is none, and of the error of each line."""
    sheet = _sheet(18, 6)
    grid = sheet.add_gridspec(2, 3)
    _draw_lines(sheet.add_subplot(grid[:, 0], projection='3d'), segments, ends)
    angle, distance = sheet.add_subplot(grid[0, 1]), sheet.add_subplot(grid[1, 1])
    ids = np.arange(len(segments))
    angle.bar(ids, errors.angle_deg, color=_ESTIMATED)
    angle.set(title='error of each line', ylabel='angle [deg]')
    distance.bar(ids - 0.2, 100 * errors.endpoint_m, 0.4, color=_TRUE, label='end points')
    distance.bar(ids + 0.2, 100 * errors.perpendicular_m, 0.4, color=_ESTIMATED, label='perpendicular')
    distance.set(xlabel='line', ylabel='distance [cm]')
    distance.legend()
    _draw_distribution(sheet.add_subplot(grid[:, 2]), errors)
    sheet.savefig(path, dpi=100, metadata={'Software': None})


def save_sweep(path: Path, runs: Sequence[Run]) -> None:
    """A PNG of the mean errors of every method against the noise, and against time at the highest noise."""
    names = list(dict.fromkeys(run.method for run in runs))
    style = {name: {'marker': _MARKERS[k % len(_MARKERS)], 'color': f'C{k % 10}', 'label': name}
             for k, name in enumerate(names)}
    sheet = _sheet(20, 5)
    panels = (('angle_deg_mean', 1.0, 'angle [deg]'), ('perpendicular_m_mean', 100.0, 'perpendicular [cm]'),
              ('endpoint_m_mean', 100.0, 'end points [cm]'))
    for k, (figure, scale, label) in enumerate(panels):
        axes = sheet.add_subplot(1, 4, k + 1)
        for name in names:
            own = [run for run in runs if run.method == name]
            axes.plot([run.noise_px for run in own], [scale * getattr(run, figure) for run in own], alpha=0.7,
                      **style[name])
        axes.set(xlabel='noise [px]', ylabel=label, title='mean over lines and seeds')
        _set_log(axes, 'y')
        axes.grid(alpha=0.3)
    _draw_trade_off(sheet.add_subplot(1, 4, 4), runs, style)
    sheet.savefig(path, dpi=100, metadata={'Software': None})


class _Plain(LogFormatter):
    """Labels the ticks that its base class would, with plain numbers: 0.6 for 6 x 10^-1."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f'{x:g}' if super().__call__(x, pos) else ''


def _set_log(axes: Any, which: str) -> None:
    """Makes the axis 'x' or 'y' logarithmic."""
    axes.set(**{f'{which}scale': 'log'})
    axis = getattr(axes, f'{which}axis')
    axis.set_major_formatter(_Plain())
    axis.set_minor_formatter(_Plain())


def _sheet(width: float, height: float) -> Figure:
    sheet = Figure(figsize=(width, height), layout='constrained')
    FigureCanvasAgg(sheet)
    return sheet


def _draw_lines(axes: Any, segments: F64, ends: F64) -> None:
    found = np.isfinite(ends).all(axis=(1, 2))
    axes.set_title(f'{found.sum()} of {len(segments)} lines estimated')
    for lines, colour, width, label in ((segments[found], _TRUE, 3.0, 'true'),
                                        (ends[found], _ESTIMATED, 1.0, 'estimated'),
                                        (segments[~found], _FAILED, 2.0, 'true, without an estimate')):
        if len(lines):  # Matplotlib refuses an empty collection here
            axes.add_collection3d(Line3DCollection(lines, colors=colour, linewidths=width, label=label))
    low, high = segments.min(axis=(0, 1)), segments.max(axis=(0, 1))
    margin = 0.05 * (high - low).max() + 0.1
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin),
             zlim=(low[2] - margin, high[2] + margin), xlabel='x [m]', ylabel='y [m]', zlabel='z [m]')
    axes.set_box_aspect(high - low + 2 * margin)
    axes.legend(loc='upper right')


def _draw_distribution(axes: Any, errors: Errors) -> None:
    axes.set(title='share of lines with a smaller error', xlabel='angle [deg], distances [cm]')
    _set_log(axes, 'x')
    for values, label in ((errors.angle_deg, 'angle'), (100 * errors.perpendicular_m, 'perpendicular'),
                          (100 * errors.endpoint_m, 'end points')):
        known = np.sort(values[np.isfinite(values) & (values > 0.0)])
        axes.step(known, np.arange(1, len(known) + 1) / len(values), where='post', label=label)
    axes.set_ylim(0.0, 1.02)
    axes.grid(alpha=0.3)
    axes.legend()


def _draw_trade_off(axes: Any, runs: Sequence[Run], style: dict[str, dict[str, Any]]) -> None:
    highest = max(run.noise_px for run in runs)
    for run in runs:
        if run.noise_px == highest:
            axes.plot([run.solve_s], [100 * run.endpoint_m_mean], linestyle='none', markersize=9, **style[run.method])
    axes.set(title=f'trade-off at {highest:g} px', xlabel='time to solve [s]', ylabel='end points [cm]',
             xlim=(0.0, 1.1 * max(run.solve_s for run in runs if run.noise_px == highest)))
    _set_log(axes, 'y')
    axes.grid(alpha=0.3)
    axes.legend()
