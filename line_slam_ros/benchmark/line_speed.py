"""Time of the joint line solver on a line experiment, against a fixed kernel's on the same machine at the same time."""
from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from line_slam_ros.benchmark.calibration_kernel import in_turns, kernel_seconds
from line_slam_ros.benchmark.sections import table
from line_slam_ros.experiment.files import Experiment, LineViews, read_experiment
from line_slam_ros.experiment.methods import PRESETS
from line_slam_ros.experiment.problem import LineProblem
from line_slam_ros.experiment.sweep import time_joint
from line_slam_ros.simulation.house import Effects, Pinhole, closed_loop, observe, random_house
from line_slam_ros.types import LineForm

FORMS = {'4 parameters': LineForm.ORTHONORMAL, '2 parameters': LineForm.HOST}
LINES, NOISE_PX = 90, 1.5  # of the simulated house
ITERATIONS = 10


@dataclass(frozen=True, slots=True)
class LineSpeed:
    """Medians over the repeats, taken in turns with the kernel."""

    lines: int
    observations: int
    iterations: int
    repeats: int
    kernel_s: float
    solver_s: dict[str, float]  # by form
    ratio: dict[str, float]  # median of solver over kernel, turn by turn


def problem(directory: Path | None) -> LineProblem:
    """The experiment in a directory, or a simulated house with all lines in front of the camera seen whole."""
    if directory is not None:
        return LineProblem.of(read_experiment(directory))
    segments, (stamps, T_WC) = random_house(0, LINES), closed_loop(0)
    views = LineViews(*observe(segments, T_WC, Pinhole.centred(), Effects(NOISE_PX, fov_limit=False), 0))
    return LineProblem.of(Experiment(T_WC, stamps, segments, views))


def measure(lines: LineProblem, repeats: int) -> LineSpeed:
    """Solves as the line code base does (Cauchy loss, host left out), in both forms."""
    methods = [replace(PRESETS['authors'], form=form) for form in FORMS.values()]
    works = [lambda method=method: time_joint(lines, method, ITERATIONS, repeats=1) for method in methods]
    seconds = in_turns([kernel_seconds, *works], repeats)
    kernel_s, *solver_s = np.median(seconds, axis=0).tolist()
    ratio = np.median(seconds[:, 1:] / seconds[:, :1], axis=0).tolist()
    return LineSpeed(len(lines.segments), len(lines.poses), ITERATIONS, repeats, kernel_s,
                     dict(zip(FORMS, solver_s, strict=True)), dict(zip(FORMS, ratio, strict=True)))


def lines_section(speed: LineSpeed) -> str:
    """As Markdown."""
    rows = [[form, f'{speed.solver_s[form]:.4f}', f'{speed.ratio[form]:.3f}'] for form in speed.solver_s]
    return (f'{speed.iterations} joint iterations on {speed.lines} lines with {speed.observations} observations, '
            f'medians of {speed.repeats} repeats in turns with the calibration kernel, which takes '
            f'{1e3 * speed.kernel_s:.1f} ms:\n\n' + table(['line with', 'seconds', 'times the kernel'], rows))
