"""``line_slam optimize-lines``: lines from known camera poses, by any form, start and loss, against the truth."""
from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from line_slam_ros.experiment.methods import END_RULES, PRESETS, STARTS, Method
from line_slam_ros.types import LINE_FORMS, LineForm, Loss

if TYPE_CHECKING:
    from line_slam_ros.experiment.files import Experiment
    from line_slam_ros.experiment.problem import LineProblem
    from line_slam_ros.experiment.solving import Result
    from line_slam_ros.experiment.sweep import Run

LOSSES = tuple(loss.name.lower() for loss in Loss)
FORMS_OF = {2: LineForm.HOST, 4: LineForm.ORTHONORMAL}
COMPARED = (LineForm.HOST, LineForm.ORTHONORMAL, LineForm.HOST_FREE)  # by a sweep that is told nothing else
OVERRIDES = ('start', 'loss_scale', 'sigma_px', 'gate', 'focal', 'use_host', 'iterations', 'tolerance',
             'min_parallax_deg', 'ends', 'end_share')  # arguments named as the fields of Method


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        'optimize-lines', help='estimate 3D lines from known camera poses and score them against the truth',
        description='Reads cam_pose_tum.txt, house.txt and observations.txt of a directory (line_slam simulate makes '
                    'such), estimates every line and compares it with the true one. Writes lines.csv, summary.json, '
                    'lines.ply and errors.png; with several noise levels, seeds, forms or modes sweep.csv, sweep.json '
                    'and sweep.png instead.')
    parser.add_argument('directory', type=Path, metavar='DIR')
    parser.add_argument('--observations', metavar='FILE', help='other views, a file relative to DIR')
    parser.add_argument('--output', type=Path, required=True, metavar='OUT', help='directory for the results')
    parser.add_argument('--preset', choices=PRESETS, default='best',
                        help='authors: Cauchy(1), 3.2 px, without the view of the host, only shrinking ends; best: '
                             'our own (default); the options below change single settings of it')
    parser.add_argument('--noise-px', type=float, nargs='+', default=[0.0], metavar='PX', help='noise to add')
    parser.add_argument('--seeds', type=int, nargs='+', default=[0], metavar='SEED', help='of that noise')
    form = parser.add_mutually_exclusive_group()
    form.add_argument('--form', nargs='+', choices=LINE_FORMS, help='what is estimated of a line')
    form.add_argument('--dof', type=int, nargs='+', choices=FORMS_OF, help='short for --form host, orthonormal')
    parser.add_argument('--joint', action='store_true', help='all lines with one damping and one verdict on a step')
    parser.add_argument('--per-line', action='store_true', help='each line on its own; with --joint both are done')
    parser.add_argument('--no-figure', dest='figure', action='store_false', help='do not draw errors.png, sweep.png')
    _add_overrides(parser)


def _add_overrides(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--start', choices=STARTS, help='first estimate')
    parser.add_argument('--loss', choices=LOSSES)
    parser.add_argument('--loss-scale', type=float, help='standard deviations')
    parser.add_argument('--sigma-px', type=float, help='standard deviation of an observed end across its line; without '
                                                       'it the preset best measures the scatter of the residuals')
    parser.add_argument('--gate', type=float, help='squared whitened residual over which a view does not count; the '
                                                   'preset authors has none')
    parser.add_argument('--focal', type=float, help='px per unit of the normalised image (default 460)')
    parser.add_argument('--host', dest='use_host', action=argparse.BooleanOptionalAction,
                        help='count the first view of every line, too')
    parser.add_argument('--iterations', type=int, help='at most')
    parser.add_argument('--tolerance', type=float, help='relative decrease of the cost at which to stop, 0 for never')
    parser.add_argument('--min-parallax-deg', type=float, help='between two observation planes, to start a line')
    parser.add_argument('--ends', choices=END_RULES, help='rule for end points')
    parser.add_argument('--end-share', type=float,
                        help='share of the views outside a quantile or confirming a vote (default 0.1)')


def run(args: argparse.Namespace) -> int:
    """0; ValueError when a setting or a file cannot be used."""
    from line_slam_ros.experiment.files import read_experiment
    settings = {name: getattr(args, name) for name in OVERRIDES if getattr(args, name) is not None}
    if args.loss is not None:
        settings['loss'] = Loss[args.loss.upper()]
    method = replace(PRESETS[args.preset], **settings)
    many = len(args.noise_px) > 1 or (len(args.seeds) > 1 and args.noise_px != [0.0])
    methods = _methods(args, method, many)
    experiment = read_experiment(args.directory, args.observations)
    args.output.mkdir(parents=True, exist_ok=True)
    asked = {'directory': str(args.directory), 'observations': args.observations, 'preset': args.preset,
             'noise_px': args.noise_px, 'seeds': args.seeds}
    if many or len(methods) > 1:
        _sweep(experiment, methods, asked, args.output, args.figure)
    else:
        _single(experiment, *methods.popitem(), asked, args.output, args.figure)
    return 0


def _methods(args: argparse.Namespace, method: Method, many: bool) -> dict[str, Method]:
    """By name; a sweep that is not told compares forms and modes."""
    forms = [LineForm.of(name) for name in args.form or ()] + [FORMS_OF[dof] for dof in args.dof or ()]
    modes = [joint for joint, given in ((True, args.joint), (False, args.per_line)) if given]
    if not forms:
        forms = COMPARED if many else [method.form]
    if not modes:
        modes = [True, False] if many else [method.joint]
    return {f'{form.name.lower()} {"joint" if joint else "per line"}': replace(method, form=form, joint=joint)
            for form in forms for joint in modes}


def _single(experiment: Experiment, name: str, method: Method, asked: dict[str, Any], output: Path,
            figure: bool) -> None:
    from line_slam_ros.experiment.score import score
    from line_slam_ros.experiment.solving import solve_lines
    from line_slam_ros.experiment.sweep import disturbed, summarise
    from line_slam_ros.mapping.io import write_ply
    noise_px, seed = asked['noise_px'][0], asked['seeds'][0]
    problem = disturbed(experiment, noise_px, seed, method.focal)
    result = solve_lines(problem, method)
    errors = score(problem.segments, result.pluecker, result.ends)
    rows, figures = line_rows(problem, result, asdict(errors)), summarise(problem, result, name, noise_px, seed)
    failures = [{'id': row['id'], 'views': row['views'], 'reason': row['reason']} for row in rows if row['reason']]
    write_csv(output / 'lines.csv', rows)
    write_ply(output / 'lines.ply', result.segments(problem.count))
    _write_json(output / 'summary.json', {**asked, 'settings': _plain(method), **asdict(figures), 'failed': failures})
    if figure:
        from line_slam_ros.cli import line_figures
        line_figures.save_errors(output / 'errors.png', problem.segments, result.ends, errors)
    print('\n'.join([*line_table(rows), '', *summary_table(figures), *failure_table(failures)]))


def _sweep(experiment: Experiment, methods: Mapping[str, Method], asked: dict[str, Any], output: Path,
           figure: bool) -> None:
    from line_slam_ros.experiment.sweep import means, sweep
    runs = sweep(experiment, methods, asked['noise_px'], asked['seeds'])
    mean = means(runs)
    write_csv(output / 'sweep.csv', [{k: v for k, v in asdict(run).items() if k != 'failed'} for run in runs])
    _write_json(output / 'sweep.json', {**asked, 'methods': {name: _plain(method) for name, method in methods.items()},
                                        'runs': [asdict(run) for run in runs], 'means': [asdict(run) for run in mean]})
    if figure:
        from line_slam_ros.cli import line_figures
        line_figures.save_sweep(output / 'sweep.png', mean)
    print('\n'.join([*sweep_table(mean), *sweep_failures(runs)]))


def line_rows(problem: LineProblem, result: Result, errors: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One row per line, whether it has an answer or not."""
    coordinates = 'x1_m', 'y1_m', 'z1_m', 'x2_m', 'y2_m', 'z2_m'
    return [{'id': i, 'reason': str(reason), 'views': int(problem.count[i]),
             'outliers': int(result.outliers[i]), 'cost': float(result.cost[i]), 'iterations': int(result.steps[i]),
             'converged': bool(result.converged[i]),
             **dict(zip(coordinates, result.ends[i].ravel().tolist(), strict=True)),
             **{name: float(values[i]) for name, values in errors.items()}} for i, reason in enumerate(result.reason)]


def line_table(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Aligned columns for the terminal."""
    header = 'line', 'views', 'outliers', 'cost', 'iterations', 'angle deg', 'perpendicular cm', 'ends cm', ''
    return _aligned([header] + [
        (row['id'], row['views'], row['outliers'], f'{row["cost"]:.6g}', row['iterations'], f'{row["angle_deg"]:.4f}',
         f'{100 * row["perpendicular_m"]:.4f}', f'{100 * row["endpoint_m"]:.4f}', row['reason']) for row in rows])


def summary_table(run: Run) -> list[str]:
    """The figures of one run as rows of name and value."""
    rows = [('method', run.method), ('lines', f'{run.lines - run.failures:g} of {run.lines}'),
            ('outliers', f'{run.outliers} views over the gate'),
            ('cost', f'{run.cost:.10g} at sigma {run.sigma_px:.4g} px'),
            ('iterations', f'{run.iterations}' + _unconverged(run)),
            ('time', f'{run.start_s:.3f} s to start, {run.solve_s:.4f} s to solve'),
            ('angle', f'{run.angle_deg_mean:.4f} deg mean, {run.angle_deg_max:.4f} max'),
            ('perpendicular', f'{100 * run.perpendicular_m_mean:.4f} cm mean, {100 * run.perpendicular_m_max:.4f} max'),
            ('end points', f'{100 * run.endpoint_m_mean:.4f} cm mean, {100 * run.endpoint_m_max:.4f} max')]
    return [f'{name:<16}{figure}' for name, figure in rows]


def failure_table(failures: Sequence[Mapping[str, Any]]) -> list[str]:
    """Every line without an answer, and why."""
    return [f'{"failed":<16}line {row["id"]} ({row["views"]} views): {row["reason"]}' for row in failures]


def sweep_table(runs: Iterable[Run]) -> list[str]:
    """One row per noise level and method."""
    header = ('noise px', 'method', 'seeds', 'lines', 'cost', 'iterations', 'solve s', 'angle deg', 'max',
              'perpendicular cm', 'max', 'ends cm', 'max')
    return _aligned([header] + [
        (f'{run.noise_px:g}', run.method, run.seed, f'{run.lines - run.failures:g}', f'{run.cost:.8g}',
         f'{run.iterations:g}', f'{run.solve_s:.4f}', f'{run.angle_deg_mean:.4f}', f'{run.angle_deg_max:.4f}',
         f'{100 * run.perpendicular_m_mean:.4f}', f'{100 * run.perpendicular_m_max:.4f}',
         f'{100 * run.endpoint_m_mean:.4f}', f'{100 * run.endpoint_m_max:.4f}') for run in runs])


def sweep_failures(runs: Iterable[Run]) -> list[str]:
    """Every line without an answer, and every method that ran out of steps."""
    lines = []
    for run in runs:
        where = f'{run.noise_px:g} px, seed {run.seed}, {run.method}'
        lines += [f'failed  {where}: line {line}: {reason}' for line, reason in run.failed.items()]
        lines += [f'note    {where}:{_unconverged(run)}'] if run.unconverged else []
    return lines


def _unconverged(run: Run) -> str:
    return f' ({run.unconverged:g} lines used all the steps they may take: --iterations)' if run.unconverged else ''


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Rows under a header; numbers that read back exactly, an empty field for one that is missing."""
    with open(path, 'w', newline='', encoding='utf-8') as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator='\n')
        writer.writeheader()
        writer.writerows(_without_nan(row, '') for row in rows)


def _write_json(path: Path, value: dict[str, Any]) -> None:
    value = {name: [_without_nan(row, None) for row in item] if name in ('runs', 'means') else item
             for name, item in _without_nan(value, None).items()}
    path.write_text(json.dumps(value, indent=2, allow_nan=False) + '\n', encoding='utf-8')


def _without_nan(row: Mapping[str, Any], instead: str | None) -> dict[str, Any]:
    return {name: instead if isinstance(value, float) and isnan(value) else value for name, value in row.items()}


def _plain(method: Method) -> dict[str, Any]:
    """Its settings, names for numbers."""
    return {**asdict(method), 'form': method.form.name.lower(), 'loss': method.loss.name.lower()}


def _aligned(rows: Sequence[Sequence[Any]]) -> list[str]:
    """Columns flush right, two blanks between them."""
    widths = [max(len(str(row[k])) for row in rows) for k in range(len(rows[0]))]
    return ['  '.join(f'{cell!s:>{width}}' for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
