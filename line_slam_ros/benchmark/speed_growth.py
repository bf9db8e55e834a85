"""How the stages grow: the estimator with points, lines and window by simulated features, the map with its lines."""
from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from line_slam_ros.benchmark.sections import number, table
from line_slam_ros.benchmark.speed_stages import beside_kernel
from line_slam_ros.config import Estimator as Options
from line_slam_ros.config import Mapping
from line_slam_ros.estimation.bootstrap import Bootstrap
from line_slam_ros.estimation.estimator import Estimator
from line_slam_ros.mapping.line_map import LineMap
from line_slam_ros.simulation.features import Room, Trajectory, calibration
from line_slam_ros.simulation.features import Sequence as Simulated
from line_slam_ros.types import F64, LineObservations

FOCAL_PX = 450.0  # of simulation.features.calibration
USUAL = {'points': 120, 'lines': 30}  # seen at a time, while something else grows
IN_VIEW = 15  # times as many are in the room: enough to see so many from everywhere
WARM_S = 3.0  # of a sequence; the window fills
COLUMNS = 4  # of the plot
NOMINAL_S = 0.05  # times are told as of a machine whose kernel takes this long
SPACING_M, LENGTH_M, RANGE_M = 1.0, 0.8, 2.0  # of the lines of a synthetic map, and how far the camera is


@dataclass(frozen=True)
class Sizes:
    """What is measured."""

    points: tuple[int, ...] = (25, 50, 100, 200, 400)
    lines: tuple[int, ...] = (0, 20, 40, 80, 160)
    window: tuple[int, ...] = (6, 9, 13, 20, 30)
    image: tuple[float, ...] = (0.25, 0.5, 0.75, 1.0)  # of a recording: factors on width and height,
    corners: tuple[int, ...] = (50, 100, 200, 400)  # points.max_count
    segments: tuple[int, ...] = (20, 40, 80, 160)  # and lines.max_count
    map: tuple[int, ...] = (100, 1000, 5000, 10_000, 20_000)
    seconds: float = 8.0  # of each simulated sequence; the first WARM_S do not count
    clip_s: float = 10.0  # of the recording


@dataclass(frozen=True, slots=True)
class Curve:
    """Nominal CPU time of some stages against one size."""

    what: str  # grows
    sizes: tuple[float, ...]
    stages_ms: dict[str, tuple[float, ...]]  # stage -> at each size


def curve(what: str, sizes: Sequence[float], costs_ms: Sequence[dict[str, float]]) -> Curve:
    """From the costs at each size; stages that are missing somewhere are NaN there."""
    names = dict.fromkeys(name for cost in costs_ms for name in cost)
    return Curve(what, tuple(sizes), {name: tuple(cost.get(name, float('nan')) for cost in costs_ms)
                                      for name in names})


def estimator_curves(sizes: Sizes, options: Options) -> Iterator[Curve]:
    """Points, lines and window, one after the other; the others as USUAL and in ``options``."""
    for name in ('points', 'lines'):
        counts = getattr(sizes, name)
        yield curve(f'{name} seen', counts, [beside(partial(
            estimator_ms, **(USUAL | {name: count}), options=options, seconds=sizes.seconds)) for count in counts])
    yield curve('states in the window', sizes.window, [beside(partial(
        estimator_ms, **USUAL, options=replace(options, window=n), seconds=sizes.seconds)) for n in sizes.window])


def beside(work: Callable[[], dict[str, float]]) -> dict[str, float]:
    """Nominal costs of a work that gives CPU times."""
    costs_ms, kernel = beside_kernel(work)
    return nominal(costs_ms, kernel.cpu)


def nominal(costs_ms: dict[str, float], kernel_s: float) -> dict[str, float]:
    """As they would be where the kernel takes NOMINAL_S: a machine's speed changes from size to size."""
    return {stage: ms * NOMINAL_S / kernel_s for stage, ms in costs_ms.items()}


def estimator_ms(points: int, lines: int, options: Options, seconds: float) -> dict[str, float]:
    """Mean CPU time per frame of the estimator's stages, ms, with so many points and lines in view at a time.

    ValueError if the simulated run does not start, or is lost.
    """
    room = Room.random(3, points=max(IN_VIEW * points, 1), lines=max(IN_VIEW * lines, 1))
    sequence = Simulated(Trajectory.random(3), room, calibration(), seconds, max_points=points)
    estimator = Estimator(options, sequence.calibration, FOCAL_PX, max(points, 1), max(lines, 1))
    bootstrap, started, spent = Bootstrap(estimator, sequence.calibration), False, defaultdict(list)
    for seen, samples in sequence.steps():
        s = seen.lines
        seen = replace(seen, lines=LineObservations(s.ids[:lines], s.ends[:lines], s.sigma[:lines]))
        if not started:
            started = bootstrap.add(seen, samples, None)
            continue
        for stage, work in {'optimise': lambda seen=seen, samples=samples: estimator.step(seen, samples, False),
                            'covariance': estimator.covariance, 'lines for the map': estimator.lines,
                            'marginalise': estimator.marginalise}.items():
            if stage == 'lines for the map' and not estimator.newest_is_keyframe:
                continue
            began = time.process_time()
            work()
            if seen.t_ns * 1e-9 >= WARM_S:
                spent[stage].append(time.process_time() - began)
        if estimator.failure:
            raise ValueError(f'the simulated run with {points} points and {lines} lines failed: {estimator.failure}')
    if not spent:
        raise ValueError(f'the simulated run with {points} points and {lines} lines did not start in {seconds:g} s')
    return {stage: 1e3 * float(np.mean(values)) for stage, values in spent.items()}


def map_curve(sizes: Sequence[int], publish: Callable[[F64], object], repeats: int = 15) -> Curve:
    """One line leaves the window, the map is collected and published: median CPU time of each.

    publish: makes the message of ends (L, 2, 3) m.
    """
    line_map, lines, costs = LineMap(Mapping()), Grid(sizes[-1] + repeats * len(sizes)), []
    for first, last in pairwise((0, *sizes)):
        lines.fill(line_map, last - first)
        costs.append(beside(partial(_map_ms, line_map, lines, publish, repeats)))
    return curve('lines in the map', sizes, costs)


def _map_ms(line_map: LineMap, lines: Grid, publish: Callable[[F64], object], repeats: int) -> dict[str, float]:
    spent = []
    for _ in range(repeats):
        ids = lines.see(line_map, 1)
        times = [time.process_time()]
        line_map.retire(ids)
        times.append(time.process_time())
        segments = line_map.segments()
        times.append(time.process_time())
        publish(segments.ends)
        times.append(time.process_time())
        spent.append(np.diff(times))
    names = 'retire one line', 'collect the map', 'make the message'
    return dict(zip(names, (1e3 * np.median(spent, axis=0)).tolist(), strict=True))


class Grid:
    """Lines along x, one metre apart, that a map takes for different ones; each seen from three places."""

    def __init__(self, count: int) -> None:
        self._side = int(np.ceil(count ** (1.0 / 3.0)))
        self._next = 0

    def fill(self, line_map: LineMap, count: int) -> None:
        """So many lines come and leave the window."""
        while count > 0:
            row = min(self._side - self._next % self._side, count)
            line_map.retire(self.see(line_map, row))
            count -= row

    def see(self, line_map: LineMap, count: int) -> np.ndarray:
        """The ids of the next lines, which stand above each other at the same x and z."""
        ids = np.arange(self._next, self._next + count)
        self._next += count
        first = SPACING_M * np.column_stack([ids // self._side % self._side, ids % self._side, ids // self._side**2])
        ends = np.stack([first, first + [LENGTH_M, 0.0, 0.0]], axis=1)
        d = np.tile([1.0, 0.0, 0.0], (count, 1))
        pluecker = np.concatenate([np.cross(first, d), d], axis=1)
        line_map.refine(ids, pluecker, np.tile(1e-12 * np.eye(6), (count, 1, 1)), np.full(count, 10))
        for aside in (-0.5, 0.0, 0.5):
            T_WC = np.eye(4)
            T_WC[:3, 3] = ends[0].mean(axis=0) + [0.0, aside, -RANGE_M]
            seen = ends - T_WC[:3, 3]
            line_map.observe(ids, seen[..., :2] / seen[..., 2:], T_WC)
        return ids


def growth_section(curves: Sequence[Curve], figure: str) -> str:
    """One table per curve; figure: where the plot is, seen from the page."""
    parts = [f'{EXPLANATION}\n\n![How the stages grow]({figure})']
    for c in curves:
        rows = [[f'{stage}, ms', *(number(v, '.2f') for v in values)] for stage, values in c.stages_ms.items()]
        parts.append(table([c.what, *(f'{size:g}' for size in c.sizes)], rows))
    return '\n\n'.join(parts)


EXPLANATION = f"""\
CPU time by stage, as of a machine whose calibration kernel takes {1e3 * NOMINAL_S:.0f} ms. Per frame, mean, for the
estimator with simulated features ({USUAL['points']} points and {USUAL['lines']} lines seen at a time where neither is
what grows, the default window; the lines for the map are per keyframe) and for the beginning of the recording (with
other limits on corners and segments, and with smaller images). For the map, of one line that leaves the window,
median."""


def plot(path: Path, curves: Sequence[Curve]) -> None:
    """Small multiples, as a PNG."""
    rows = -(-len(curves) // COLUMNS)
    sheet = Figure(figsize=(3.6 * COLUMNS, 3.0 * rows), layout='constrained')
    FigureCanvasAgg(sheet)
    every = sheet.subplots(rows, COLUMNS, squeeze=False).ravel()
    for axes in every[len(curves):]:
        axes.set_axis_off()
    for axes, c in zip(every, curves, strict=False):
        for stage, values in c.stages_ms.items():
            axes.plot(c.sizes, values, 'o-', markersize=3, label=stage)
        axes.set(xlabel=c.what, ylabel='CPU time [ms]', ylim=(0.0, None))
        axes.legend(fontsize='small')
    sheet.savefig(path, dpi=70, metadata={'Software': None})
