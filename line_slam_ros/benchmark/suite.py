"""The list of recordings that a benchmark runs over: a YAML file, checked before anything runs.

    variants:                               # optional; these four are the default
      points and lines: {}
      points only: {use_lines: false}
      lines only: {use_points: false}
      2-parameter lines: {estimator.line_representation: host}
    recordings:
      office:
        bag: ../bags/office/bag             # rosbag2 directory, .mcap, .db3 or .bag file; or asl: FOLDER
        truth: ../bags/office/groundtruth.tum   # poses of the body, TUM; or truth_topic: /ground_truth/pose
        lines: [../bags/office/gt_lines.csv]    # true segments, rows x1,y1,z1,x2,y2,z2
        calibration: camchain-imucam.yaml   # default: found as in replay
        start: 0.0                          # s after the first image
        duration: 20.0                      # s; default: all
        settings: {points.max_count: 25}    # parameters for all variants of this recording
        variants: [points and lines]        # default: all
        degrade:                            # copies made worse, each run with the first variant alone
          every second frame: {every_nth: 2}

Only ``bag`` or ``asl`` is needed. Paths are relative to the file.
"""
from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import yaml

from line_slam_ros.benchmark.degrade import Degradation
from line_slam_ros.config import Config
from line_slam_ros.config_file import apply
from line_slam_ros.shell_config import ShellConfig

DEFAULT_VARIANTS = {
    'points and lines': {}, 'points only': {'use_lines': False}, 'lines only': {'use_points': False},
    '2-parameter lines': {'estimator.line_representation': 'host'}}
_KEYS = ('bag', 'asl', 'camera', 'calibration', 'truth', 'truth_topic', 'lines', 'start', 'duration', 'settings',
         'variants', 'degrade')


@dataclass(frozen=True)
class Variant:
    """A way to run: a name and the parameters that differ from the default."""

    name: str
    settings: dict[str, Any]


@dataclass(frozen=True)
class Recording:
    """One recording, or a copy of it made worse, and how to run it."""

    name: str
    bag: Path | None
    asl: Path | None
    camera: str
    calibration: Path | None
    truth: Path | None
    truth_topic: str
    lines: tuple[Path, ...]
    start_s: float
    duration_s: float | None
    settings: dict[str, Any]
    variants: tuple[Variant, ...]
    degradation: Degradation
    copy_of: str = ''  # name of the good recording

    def missing(self) -> list[Path]:
        """Files that the list names and that are not there."""
        named = (self.bag, self.asl, self.calibration, self.truth, *self.lines)
        return [path for path in named if path is not None and not path.exists()]


def read_suite(path: Path) -> list[Recording]:
    """All recordings of the file and, after each, its degraded copies; ValueError names file, key and remedy."""
    try:
        document = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f'{path}: not readable as YAML: {" ".join(str(error).split())}') from None
    document = _mapping(document, str(path))
    _known(document, ('variants', 'recordings'), str(path))
    given = _mapping(document.get('variants', DEFAULT_VARIANTS), f'{path}: variants')
    variants = {name: Variant(name, _settings(values, f'{path}: variants.{name}')) for name, values in given.items()}
    if not variants or not document.get('recordings'):
        raise ValueError(f'{path}: at least one variant and one entry under recordings are needed')
    entries = _mapping(document['recordings'], f'{path}: recordings')
    found = [r for name, values in entries.items()
             for r in _recordings(str(name), values, variants, path.parent, f'{path}: recordings.{name}')]
    return found


def chosen(recordings: Collection[Recording], only: Collection[str], variants: Collection[str]) -> list[Recording]:
    """Those whose name matches one of the patterns ``only``, with those variants; none given: all. ValueError for a
    pattern or a variant that fits nothing."""
    for pattern in only:
        if not any(fnmatch(r.name, pattern) for r in recordings):
            raise ValueError(f'no recording is called {pattern!r}; there are {", ".join(r.name for r in recordings)}')
    known = {v.name: None for r in recordings for v in r.variants}
    for name in variants:
        if name not in known:
            raise ValueError(f'no variant is called {name!r}; there are {", ".join(known)}')
    wanted = [r for r in recordings if not only or any(fnmatch(r.name, pattern) for pattern in only)]
    return [replace(r, variants=tuple(v for v in r.variants if not variants or v.name in variants)) for r in wanted]


def _recordings(name: str, values: Any, variants: Mapping[str, Variant], base: Path, where: str) -> list[Recording]:
    values = _mapping(values, where)
    _known(values, _KEYS, where)
    if ('bag' in values) == ('asl' in values):
        raise ValueError(f'{where}: give either bag or asl')
    if 'truth' in values and 'truth_topic' in values:
        raise ValueError(f'{where}: give either truth or truth_topic')
    wanted = values.get('variants', list(variants))
    if not isinstance(wanted, list) or not wanted or not set(wanted) <= set(variants):
        raise ValueError(f'{where}.variants must list some of {", ".join(variants)}, got {wanted!r}')
    recording = Recording(
        name, *(_path(values, key, base, where) for key in ('bag', 'asl')), _text(values, 'camera', where) or 'cam0',
        *(_path(values, key, base, where) for key in ('calibration', 'truth')), _text(values, 'truth_topic', where),
        _paths(values.get('lines', []), base, f'{where}.lines'), _seconds(values.get('start', 0.0), f'{where}.start'),
        None if values.get('duration') is None else _seconds(values['duration'], f'{where}.duration'),
        _settings(values.get('settings', {}), f'{where}.settings'), tuple(variants[v] for v in wanted), Degradation())
    return [recording, *_copies(recording, values.get('degrade', {}), f'{where}.degrade')]


def _copies(recording: Recording, values: Any, where: str) -> list[Recording]:
    return [replace(recording, name=f'{recording.name}, {name}', copy_of=recording.name,
                    variants=recording.variants[:1],
                    degradation=Degradation.of(_mapping(changes, f'{where}.{name}'), f'{where}.{name}'))
            for name, changes in _mapping(values, where).items()]


def _settings(values: Any, where: str) -> dict[str, Any]:
    values = _mapping(values or {}, where)
    apply(Config(), ShellConfig(), values, where)
    return dict(values)


def _mapping(value: Any, where: str) -> Mapping[str, Any]:
    if type(value) is not dict:
        raise ValueError(f'{where}: expected "name: value" lines, got {value!r}')
    return value


def _known(values: Mapping[str, Any], keys: Collection[str], where: str) -> None:
    for key in values:
        if key not in keys:
            raise ValueError(f'{where}: unknown key {key!r}; use {", ".join(keys)}')


def _text(values: Mapping[str, Any], key: str, where: str) -> str:
    value = values.get(key, '')
    if type(value) is not str:
        raise ValueError(f'{where}.{key} must be text, got {value!r}')
    return value


def _path(values: Mapping[str, Any], key: str, base: Path, where: str) -> Path | None:
    text = _text(values, key, where)
    return base / text if text else None


def _paths(value: Any, base: Path, where: str) -> tuple[Path, ...]:
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise ValueError(f'{where} must be a list of files, got {value!r}')
    return tuple(base / item for item in value)


def _seconds(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not value >= 0.0:
        raise ValueError(f'{where} must be seconds, got {value!r}')
    return float(value)
