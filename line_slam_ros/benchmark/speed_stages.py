"""Where the time of a frame goes: wall and CPU time of each stage, and both of the calibration kernel."""
from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from line_slam_ros.benchmark.calibration_kernel import calibration_kernel, rows
from line_slam_ros.benchmark.sections import number, table
from line_slam_ros.config import Config
from line_slam_ros.slam import Slam
from line_slam_ros.types import Calibration, Estimate, Frame, ImuBatch

Result = TypeVar('Result')
# As they follow each other; what is not named here comes after them.
ORDER = ('read', 'decode', 'track', 'front end: track', 'front end: detect', 'initialise', 'optimise', 'marginalise',
         'map', 'total', 'publish')
QUANTILES = {'p50': 50, 'p95': 95, 'p99': 99, 'max': 100}


class Cost(NamedTuple):
    """What a piece of work took, s; CPU time is that of all threads of the process, NaN where it is not known."""

    wall: float
    cpu: float


class Stopwatch:
    """Costs by stage, frame by frame; a stage entered several times for a frame adds up."""

    def __init__(self) -> None:
        self.frames: list[dict[str, Cost]] = []
        self._now: dict[str, Cost] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.add(name, Cost(time.perf_counter() - wall, time.process_time() - cpu))

    def add(self, name: str, cost: Cost) -> None:
        before = self._now.get(name, Cost(0.0, 0.0))
        self._now[name] = Cost(before.wall + cost.wall, before.cpu + cost.cpu)

    def end_frame(self) -> None:
        self.frames.append(self._now)
        self._now = {}


class ProfiledSlam(Slam):
    """Slam that takes the CPU time of its stages, too."""

    def __init__(self, config: Config, calibration: Calibration) -> None:
        super().__init__(config, calibration)
        self.cpu: dict[str, float] = {}  # s, by stage, of the last frame

    def process(self, frame: Frame, imu: ImuBatch) -> Estimate | None:
        self.cpu = {}
        return super().process(frame, imu)

    def costs(self) -> dict[str, Cost]:
        """Of the last frame, by stage; of the front end's parts the wall time alone."""
        parts = {f'front end: {name}': Cost(wall, float('nan')) for name, wall in self.front_end.timings.items()}
        return {name: Cost(wall, self.cpu[name]) for name, wall in self.timings.items()} | parts

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        began = time.process_time()
        with super()._timed(stage):
            yield
        self.cpu[stage] = time.process_time() - began


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage over all frames that had it, ms."""

    name: str
    frames: int
    wall_ms: dict[str, float]  # p50, p95, p99, max, mean
    cpu_ms: dict[str, float]  # the same; empty where it is not known


def kernel_cost() -> Cost:
    """One run of the calibration kernel, once it is compiled."""
    data = rows()
    wall, cpu = time.perf_counter(), time.process_time()
    calibration_kernel(data)
    return Cost(time.perf_counter() - wall, time.process_time() - cpu)


def kernel_median(repeats: int) -> Cost:
    """Median of some runs after one that does not count."""
    return median([kernel_cost() for _ in range(repeats + 1)][1:])


def beside_kernel(work: Callable[[], Result]) -> tuple[Result, Cost]:
    """What the work gives, and the kernel's cost around it: the machine's speed changes."""
    before = kernel_median(3)
    result = work()
    return result, Cost(*np.mean([before, kernel_median(3)], axis=0).tolist())


def median(costs: Sequence[Cost]) -> Cost:
    return Cost(*np.median(costs, axis=0).tolist())


def stages_of(frames: Sequence[Mapping[str, Cost]]) -> list[Stage]:
    """Quantiles by stage, in the order of the pipeline."""
    names = dict.fromkeys(name for frame in frames for name in frame)
    ordered = [name for name in ORDER if name in names] + [name for name in names if name not in ORDER]
    return [_stage(name, [frame[name] for frame in frames if name in frame]) for name in ordered]


def _stage(name: str, costs: Sequence[Cost]) -> Stage:
    wall, cpu = np.array(costs).T * 1e3
    return Stage(name, len(costs), quantiles(wall), quantiles(cpu) if np.isfinite(cpu).all() else {})


def quantiles(values: Sequence[float]) -> dict[str, float]:
    """p50, p95, p99, max and mean."""
    found = np.percentile(values, list(QUANTILES.values())).tolist()
    return dict(zip(QUANTILES, found, strict=True)) | {'mean': float(np.mean(values))}


def stages_table(stages: Sequence[Stage]) -> str:
    """Wall and CPU time, ms."""
    header = ['stage', 'frames', *(f'wall {q}' for q in QUANTILES), *(f'CPU {q}' for q in QUANTILES), 'CPU mean']
    return table(header, [[s.name, str(s.frames), *(number(s.wall_ms[q], '.2f') for q in QUANTILES),
                           *(number(s.cpu_ms.get(q), '.2f') for q in (*QUANTILES, 'mean'))] for s in stages])
