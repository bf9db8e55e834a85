"""Resident memory over a long time."""
from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from line_slam_ros.benchmark.sections import number, table

MIB = 1 << 20
GROWTH_S = 600.0  # growth is told per this


@dataclass(frozen=True, slots=True)
class Memory:
    """Samples while a recording was shown to and fro."""

    t_s: tuple[float, ...]  # of data
    rss_mib: tuple[float, ...]
    lines: tuple[int, ...]  # in the map
    frames: int
    resets: int
    wall_s: float
    recording_mib: float  # of the resident memory, held by the benchmark itself


def resident_mib(pid: int | str = 'self') -> float:
    """Of a process (Linux)."""
    pages = int(Path(f'/proc/{pid}/statm').read_text(encoding='ascii').split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / MIB


@dataclass(frozen=True, slots=True)
class Growth:
    """By a straight line through the samples after the warm-up."""

    warm_mib: float  # at the end of the warm-up
    per_10_min_mib: float
    per_10_min_percent: float  # of warm_mib


def growth_of(memory: Memory, warm_up_s: float) -> Growth | None:
    """None if fewer than two samples come after the warm-up."""
    t, rss = np.array(memory.t_s), np.array(memory.rss_mib)
    late = t >= warm_up_s
    if late.sum() < 2:
        return None
    slope, start = np.polyfit(t[late] - warm_up_s, rss[late], 1)
    return Growth(float(start), float(GROWTH_S * slope), float(100.0 * GROWTH_S * slope / start))


def memory_section(memory: Memory, warm_up_s: float, figure: str) -> str:
    """Table; figure: where the plot is, seen from the page."""
    growth = growth_of(memory, warm_up_s)
    rows = [['data shown, min', f'{memory.t_s[-1] / 60.0:.1f}'],
            ['frames (resets)', f'{memory.frames} ({memory.resets})'],
            ['lines in the map at the end', str(memory.lines[-1])],
            ['resident memory before the first frame, MiB', f'{memory.rss_mib[0]:.0f}'],
            [f'after {warm_up_s / 60.0:.2g} min', number(growth and growth.warm_mib, '.0f')],
            ['at the end', f'{memory.rss_mib[-1]:.0f}'], ['most', f'{max(memory.rss_mib):.0f}'],
            ['of it the recording itself', f'{memory.recording_mib:.0f}'],
            [f'growth per 10 min after the first {warm_up_s / 60.0:.2g} min, MiB',
             number(growth and growth.per_10_min_mib, '+.1f')],
            ['the same, %', number(growth and growth.per_10_min_percent, '+.2f')]]
    return (f'{EXPLANATION}\n\n{table(["", ""], rows)}\n\n![Resident memory over time]({figure})')


EXPLANATION = """\
Resident memory of a process that estimates and maps as the node does, without ROS: the recording is shown forwards and
backwards without end. A body that turns round smoothly and goes back the way it came has the same accelerations and the
opposite angular velocities, so the inertial data stay true (`benchmark/speed_motion.py`)."""


def plot(path: Path, memory: Memory) -> None:
    """Memory and lines over time, as a PNG."""
    sheet = Figure(figsize=(8, 3.2), layout='constrained')
    FigureCanvasAgg(sheet)
    left, right = sheet.subplots(1, 2)
    minutes = np.array(memory.t_s) / 60.0
    left.plot(minutes, memory.rss_mib)
    left.set(xlabel='data [min]', ylabel='resident memory [MiB]', ylim=(0.0, 1.15 * max(memory.rss_mib)))
    right.plot(minutes, memory.lines)
    right.set(xlabel='data [min]', ylabel='lines in the map', ylim=(0.0, None))
    sheet.savefig(path, dpi=80, metadata={'Software': None})
