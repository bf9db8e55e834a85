"""One row of the benchmark: what a replay left behind, against the truth."""
from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from line_slam_ros import evaluation
from line_slam_ros.benchmark.suite import Recording, Variant

OK, NO_START, FAILED, TIMEOUT, MISSING = 'ok', 'no start', 'failed', 'timeout', 'missing'
_RUN = ('frames', 'estimates', 'keyframes', 'resets', 'duration_s', 'first_estimate_after_s', 'wall_s',
        'times_real_time', 'stages_ms', 'drops', 'settings')


@dataclass(frozen=True)
class Row:
    """Figures of one run; None where there is nothing to compare."""

    recording: str
    variant: str  # '' for a recording that is missing
    copy_of: str  # name of the good recording, '' for itself
    status: str
    reason: str  # for the status, or why there is no trajectory score; '' if all is well
    run: dict[str, Any] | None = None  # counts, times
    trajectory: dict[str, Any] | None = None  # see evaluation.TrajectoryScore
    lines: dict[str, Any] | None = None  # see mapping.metrics.LineScore; without truth count and mean_length alone

    @property
    def key(self) -> tuple[str, str]:
        return self.recording, self.variant


def missing_row(recording: Recording) -> Row:
    names = ', '.join(map(str, recording.missing()))
    return Row(recording.name, '', recording.copy_of, MISSING, f'not there: {names}')


def finished_row(recording: Recording, variant: Variant, directory: Path, exit_code: int, last_words: str,
                 truth: Path | None) -> Row:
    """Scores what a replay wrote into its directory; truth: TUM file or None. Never raises for what a run left."""
    name = recording.name, variant.name, recording.copy_of
    path = directory / 'metrics.json'
    if not path.is_file():
        return Row(*name, FAILED, f'exit code {exit_code}: {last_words}')
    report = json.loads(path.read_text(encoding='utf-8'))
    run = {key: report[key] for key in _RUN}
    if report['estimates'] == 0:
        return Row(*name, NO_START, last_words.rpartition('no pose was estimated: ')[2], run)
    if exit_code != 0:
        return Row(*name, FAILED, f'exit code {exit_code}: {last_words}', run)
    try:
        trajectory, lines = _scores(directory, truth, recording.lines)
    except ValueError as error:
        return Row(*name, OK, f'no score: {error}', run)
    return Row(*name, OK, '', run, trajectory, lines)


def timeout_row(recording: Recording, variant: Variant, seconds: float) -> Row:
    return Row(recording.name, variant.name, recording.copy_of, TIMEOUT, f'stopped after {seconds:g} s')


def _scores(directory: Path, truth: Path | None, true_lines: tuple[Path, ...]) -> tuple[dict | None, dict | None]:
    if truth is None:
        return None, None
    trajectory, T_TE = evaluation.score_trajectory(evaluation.read_trajectory(directory / 'trajectory.tum'),
                                                   evaluation.read_trajectory(truth))
    lines = None
    if true_lines:
        segments = evaluation.read_true_lines(list(true_lines))
        lines = asdict(evaluation.score_lines(directory / 'lines.csv', segments, T_TE))
    return asdict(trajectory), lines


def write_rows(path: Path, rows: list[Row], machine_ms: float) -> None:
    """JSON; machine_ms is what the calibration kernel takes here (see calibration_kernel.py)."""
    document = {'calibration_kernel_ms': machine_ms, 'rows': [asdict(row) for row in rows]}
    path.write_text(evaluation.json_text(document), encoding='utf-8')


def read_rows(path: Path) -> list[Row]:
    """The rows of an earlier run; none if there is no file."""
    if not path.is_file():
        return []
    return [Row(**row) for row in json.loads(path.read_text(encoding='utf-8'))['rows']]


def merged(old: list[Row], new: list[Row]) -> list[Row]:
    """Old rows with those that were measured again replaced in place, and new ones after them."""
    latest = {row.key: row for row in new}
    replaced = [latest.pop(row.key, row) for row in old]
    found = {row.recording for row in new if row.variant}
    return [row for row in [*replaced, *latest.values()] if row.variant or row.recording not in found]
