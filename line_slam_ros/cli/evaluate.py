"""line_slam evaluate: a replay's trajectory and line map against the truth."""
from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    parser = subparsers.add_parser('evaluate', help='errors of a trajectory and a line map against the truth',
                                   description='Compare the results of a replay with the truth; writes '
                                               'evaluation.json next to them.')
    parser.add_argument('result_dir', type=Path, metavar='RESULT_DIR', help='holds trajectory.tum and lines.csv')
    parser.add_argument('--truth', type=Path, required=True, metavar='TUM', help='true poses of the body, TUM format')
    parser.add_argument('--lines', type=Path, action='extend', nargs='+', default=[], metavar='CSV',
                        help='true segments: x1,y1,z1,x2,y2,z2 in the frame of the true poses')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """0, or 1 after a message on stderr."""
    try:
        from line_slam_ros import evaluation  # evo takes seconds to load, and only this command needs it
    except ModuleNotFoundError as error:
        print(f'line_slam evaluate needs the package {error.name}: pip install evo', file=sys.stderr)
        return 1
    try:
        trajectory, T_TE = evaluation.score_trajectory(
            evaluation.read_trajectory(args.result_dir / 'trajectory.tum'), evaluation.read_trajectory(args.truth))
        result = {'trajectory': asdict(trajectory)}
        if args.lines:
            true_lines = evaluation.read_true_lines(args.lines)
            result['lines'] = asdict(evaluation.score_lines(args.result_dir / 'lines.csv', true_lines, T_TE))
    except ValueError as error:
        print(f'line_slam evaluate: {error}', file=sys.stderr)
        return 1
    path = args.result_dir / 'evaluation.json'
    path.write_text(evaluation.json_text(result), encoding='utf-8')
    print('\n'.join(table(result)))
    return 0


def table(result: dict[str, Any]) -> list[str]:
    """The result as aligned rows of name and figure."""
    t = result['trajectory']
    rows = [('poses matched', f'{t["matched"]} of {t["poses"]}, {t["duration_s"]:.1f} s, {t["length_m"]:.2f} m'),
            ('ATE', f'{t["ate_rmse_m"]:.4f} m rmse, {t["ate_mean_m"]:.4f} mean, {t["ate_max_m"]:.4f} max'),
            ('rotation', f'{t["rotation_rmse_deg"]:.3f} deg rmse, {t["rotation_max_deg"]:.3f} max'),
            ('RPE over 1 s', _relative(t, 'rpe_1s')), ('RPE over 10 %', f'{_relative(t, "rpe_10pct")} (of the path)'),
            ('scale', f'{t["scale"]:.5f} (factor that fits the truth)')]
    if t['still'] is not None:
        rows.append(('drift at rest', f'{t["still"]["drift_m"]:.4f} m over {t["still"]["duration_s"]:.1f} s'))
    return [f'{name:<16}{figure}' for name, figure in rows + _line_rows(result.get('lines'))]


def _relative(t: dict[str, Any], name: str) -> str:
    return f'{t[f"{name}_translation_rmse_m"]:.4f} m, {t[f"{name}_rotation_rmse_deg"]:.3f} deg rmse'


def _line_rows(lines: dict[str, Any] | None) -> list[tuple[str, str]]:
    if lines is None:
        return []
    rows = [('lines', f'{lines["count"]}, mean length {lines["mean_length"]:.2f} m, {lines["duplicates"]} duplicates')]
    for t, precision, recall, metres in zip(lines['thresholds'], lines['precision'], lines['recall'],
                                            lines['recall_m'], strict=True):
        figures = f'precision {100 * precision:.1f} %, recall {100 * recall:.1f} % ({metres:.1f} m)'
        rows.append((f'within {100 * t:g} cm', figures))
    return rows
