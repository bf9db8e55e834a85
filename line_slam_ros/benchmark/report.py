"""The rows of the recordings' benchmark as Markdown."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from line_slam_ros.benchmark.rows import MISSING, OK, Row
from line_slam_ros.benchmark.sections import number, table

EXPLANATION = """\
Trajectory figures are evo's after SE(3) alignment of all poses: ATE and rotation RMSE, relative pose error (RPE) over
all pairs one second, and a tenth of the path, apart. Start: time from the first image to the first pose. Tracked: share
of the images with a pose. Scale: how far the factor that would fit the truth best is from 1. Precision: share of the
mapped length within that distance of a true segment and within 10 degrees of its direction; recall: share of the length
of the true segments (those that are visible, seen in five frames or more) within that distance of a mapped one."""

TIMES = ('Time per frame, median / 95 %, one thread, decoding of images not included (the calibration kernel of '
         '`line_slam benchmark lines` takes {:.1f} ms on this machine):')


def recordings_section(rows: Sequence[Row], machine_ms: float) -> str:
    """All of it: accuracy, lines, degraded copies, times, and what did not run."""
    good, worse = [r for r in rows if not r.copy_of], [r for r in rows if r.copy_of]
    parts = [EXPLANATION, _accuracy(_ran(good))]
    mapping = [r for r in good if r.lines and r.run['settings']['use_lines']]
    if mapping:
        parts += ['Line maps:', _lines(mapping)]
    if _ran(worse):
        parts += ['Copies made worse, same parameters:', _accuracy(_ran(worse))]
    if any(r.run for r in rows):
        parts += [TIMES.format(machine_ms), _times(good)]
    absent = [f'- {_name(r)}: {r.status}, {r.reason}' for r in rows if r.status == MISSING]
    remarks = [f'- {_name(r)}: {r.reason}' for r in rows if r.reason and r.status != MISSING]
    for title, lines in (('Not measured, since the data are not here:', absent), ('Remarks:', remarks)):
        parts += [title, '\n'.join(lines)] if lines else []
    return '\n\n'.join(part for part in parts if part)


def _ran(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row.status != MISSING]


def _name(row: Row) -> str:
    return f'{row.recording}, {row.variant}' if row.variant else row.recording


Column = tuple[str, Callable[[Row], str]]


def _accuracy(rows: Sequence[Row]) -> str:
    return _table(rows, (
        ('ATE (max), m', lambda r: _pair(r, 'ate_rmse_m', 'ate_max_m', '.4f', '{} ({})')),
        ('rotation, deg', lambda r: _figure(r.trajectory, 'rotation_rmse_deg', '.2f')),
        ('RPE 1 s, m / deg', lambda r: _pair(r, 'rpe_1s_translation_rmse_m', 'rpe_1s_rotation_rmse_deg', '.4f',
                                             '{} / {}', '.2f')),
        ('RPE 10 %, m / deg', lambda r: _pair(r, 'rpe_10pct_translation_rmse_m', 'rpe_10pct_rotation_rmse_deg', '.4f',
                                              '{} / {}', '.2f')),
        ('scale, %', lambda r: number(r.trajectory and 100.0 * (r.trajectory['scale'] - 1.0), '+.2f')),
        ('start, s', lambda r: _figure(r.run, 'first_estimate_after_s', '.2f') if r.status == OK else r.status),
        ('tracked, %', lambda r: number(_tracked(r), '.1f')),
        ('resets', lambda r: _figure(r.run, 'resets', 'd'))))


def _lines(rows: Sequence[Row]) -> str:
    def at(row: Row, name: str) -> str:
        return ' / '.join(number(None if share is None else 100.0 * share, '.0f') for share in row.lines[name])

    distances = ' / '.join(f'{100 * t:g}' for t in rows[0].lines['thresholds'])
    return _table(rows, (
        ('lines', lambda r: _figure(r.lines, 'count', 'd')),
        ('mean length, m', lambda r: _figure(r.lines, 'mean_length', '.2f')),
        ('duplicates', lambda r: _figure(r.lines, 'duplicates', 'd')),
        (f'precision within {distances} cm, %', lambda r: at(r, 'precision')),
        (f'recall within {distances} cm, %', lambda r: at(r, 'recall')),
        ('recall within 5 cm, m', lambda r: number(_at_5_cm(r), '.1f'))))


def _at_5_cm(row: Row) -> float | None:
    found = dict(zip(row.lines['thresholds'], row.lines['recall_m'], strict=True))
    return found.get(0.05)


def _times(rows: Sequence[Row]) -> str:
    rows = [r for r in rows if r.run and r.run['stages_ms']]
    stages = list(dict.fromkeys(stage for r in rows for stage in r.run['stages_ms']))

    def column(stage: str) -> Column:
        return f'{stage}, ms', lambda r: _percentiles(r.run['stages_ms'].get(stage))

    return _table(rows, (*map(column, stages),
                         ('times real time', lambda r: _figure(r.run, 'times_real_time', '.1f'))))


def _table(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    """A row per run; the recording is named where it changes."""
    if not rows:
        return ''
    cells, last = [], ''
    for row in rows:
        name, last = (row.recording if row.recording != last else ''), row.recording
        cells.append([name, row.variant, *(cell(row) for _, cell in columns)])
    return table(['recording', 'variant', *(title for title, _ in columns)], cells)


def _tracked(row: Row) -> float | None:
    return 100.0 * row.run['estimates'] / row.run['frames'] if row.run and row.run['frames'] else None


def _figure(values: dict[str, Any] | None, name: str, form: str) -> str:
    return number(values[name] if values else None, form)


def _pair(row: Row, first: str, second: str, form: str, pattern: str, second_form: str = '') -> str:
    if row.trajectory is None:
        return number(None)
    return pattern.format(number(row.trajectory[first], form), number(row.trajectory[second], second_form or form))


def _percentiles(stage: dict[str, float] | None) -> str:
    return f'{stage["p50"]:.1f} / {stage["p95"]:.1f}' if stage else number(None)
