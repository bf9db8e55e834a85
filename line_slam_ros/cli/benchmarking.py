"""The work behind ``line_slam benchmark``: processes, files, and what the human is told."""
from __future__ import annotations

import argparse
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from line_slam_ros import evaluation
from line_slam_ros.benchmark import consistency_report, line_speed
from line_slam_ros.benchmark.calibration_kernel import machine_ms
from line_slam_ros.benchmark.consistency import World, simulate_all
from line_slam_ros.benchmark.report import recordings_section
from line_slam_ros.benchmark.rows import OK, Row, merged, missing_row, read_rows, write_rows
from line_slam_ros.benchmark.sections import put_section
from line_slam_ros.benchmark.speed_reference import comparison, read_references, write_reference
from line_slam_ros.benchmark.suite import chosen, read_suite
from line_slam_ros.cli.benchmark_parts import Parts, live_module
from line_slam_ros.cli.benchmark_runs import ONE_THREAD, run_recording
from line_slam_ros.cli.benchmark_source import Recording


def recordings(args: argparse.Namespace) -> int:
    """0 if at least one run gave poses. results.json is written after every run."""
    wanted = chosen(read_suite(args.file), args.only, args.variants)
    _prepare(args)
    path = args.output / 'results.json'
    old, new, speed_ms = read_rows(path) if args.keep else [], [], machine_ms()
    for recording in wanted:
        rows = [missing_row(recording)] if recording.missing() else run_recording(recording, args.output, args.timeout)
        for row in rows:
            new.append(row)
            _tell(row)
            write_rows(path, merged(old, new), speed_ms)
    _publish(args, 'recordings', recordings_section(merged(old, new), speed_ms))
    return 0 if any(row.status == OK for row in new) else 1


def consistency(args: argparse.Namespace) -> int:
    """0 if at least one run came through."""
    _prepare(args)
    seeds = range(args.first_seed, args.first_seed + args.runs)
    kinds = [(sigma, lines) for sigma in args.pixel_sigma for lines in (True, False) if args.lines in (None, lines)]
    worlds = [World(seed, args.seconds, sigma, lines, args.place, args.points, args.points_in_view)
              for sigma, lines in kinds for seed in seeds]
    os.environ.update(ONE_THREAD)  # for the processes to come
    traces = list(tqdm(simulate_all(worlds, args.jobs), total=len(worlds), unit='run', dynamic_ncols=True))
    levels = [consistency_report.level_of(traces[k * args.runs:(k + 1) * args.runs]) for k in range(len(kinds))]
    document = {'place': args.place, 'seconds': args.seconds, 'points': args.points,
                'points_in_view': args.points_in_view, 'first_seed': args.first_seed,
                'levels': [asdict(v) for v in levels]}
    (args.output / 'consistency.json').write_text(evaluation.json_text(document), encoding='utf-8')
    consistency_report.plot(args.output / 'consistency.png', levels)
    what = (f'Runs of {args.seconds:g} s in a {args.place} of {args.points} points and lines, at most '
            f'{args.points_in_view} points used at a time')
    _publish(args, f'consistency in a {args.place}', consistency_report.consistency_section(levels, what))
    return 0 if any(len(v.failures) < v.runs for v in levels) else 1


def lines(args: argparse.Namespace) -> int:
    """Always 0: bad input is a ValueError."""
    _prepare(args)
    speed = line_speed.measure(line_speed.problem(args.directory), args.repeats)
    (args.output / 'lines.json').write_text(evaluation.json_text(asdict(speed)), encoding='utf-8')
    _publish(args, 'lines', line_speed.lines_section(speed))
    return 0


def speed(args: argparse.Namespace) -> int:
    """Always 0: what cannot be measured is a ValueError, raised after the parts before it were written."""
    _prepare(args)
    recording = Recording(args.bag, args.calibration, tuple(args.set), args.duration)
    name, figures = recording.name(), args.figures or args.output
    reference = read_references(args.reference).get(name, {})
    if args.update_reference and not args.reference.parent.is_dir():
        raise ValueError(f'{args.reference}: its directory {args.reference.parent} is missing; make it first')
    if 'live' in args.parts:
        live_module()
    figures.mkdir(parents=True, exist_ok=True)
    parts, found = Parts(recording, figures, lambda file: _link(file, args.markdown or args.output), args.minutes), {}
    for kind in args.parts:
        print(f'measuring {kind}', file=sys.stderr, flush=True)
        part = getattr(parts, kind)()
        found |= part.figures
        (args.output / f'{kind}.json').write_text(evaluation.json_text(part.document), encoding='utf-8')
        _publish(args, f'speed, {kind}', part.section)
    told = comparison(found, reference)
    (args.output / 'comparison.md').write_text(told + '\n', encoding='utf-8')
    print(told)
    if args.update_reference:
        write_reference(args.reference, name, found)
    return 0


def _link(file: Path, page: Path) -> str:
    """A file as a page (or one in that directory) calls it."""
    return os.path.relpath(file, page if page.is_dir() else page.parent)


def _prepare(args: argparse.Namespace) -> None:
    """Makes the output directory. ValueError, before anything is measured, if the Markdown file cannot be made."""
    args.output.mkdir(parents=True, exist_ok=True)
    if args.markdown and not args.markdown.parent.is_dir():
        raise ValueError(f'{args.markdown}: its directory {args.markdown.parent} is missing; make it first')


def _publish(args: argparse.Namespace, name: str, section: str) -> None:
    """Prints the tables; writes them beside the JSON, and into the user's Markdown file if one is given."""
    print(section)
    (args.output / f'{name}.md').write_text(section + '\n', encoding='utf-8')
    if args.markdown:
        put_section(args.markdown, name, section)
    print(f'\nwritten to {args.output}/' + (f' and {args.markdown}' if args.markdown else ''))


def _tell(row: Row) -> None:
    """One line per run, as it ends."""
    figures: dict[str, Any] = row.trajectory or {}
    accuracy = f', ATE {figures["ate_rmse_m"]:.4f} m' if figures else ''
    reason = f' ({row.reason})' if row.reason else ''
    print(f'{row.recording}, {row.variant or "-"}: {row.status}{accuracy}{reason}', file=sys.stderr, flush=True)
