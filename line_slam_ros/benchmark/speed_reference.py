"""Figures against those of another day, both in units of the calibration kernel of their own run."""
from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from line_slam_ros.benchmark.sections import table
from line_slam_ros.evaluation import json_text

SLOWER = 1.3  # times the reference; below, it is the machine's mood

# By name 'part: what': times in units of the kernel, memory in MiB; the more the worse.
Figures = Mapping[str, float]


def read_references(path: Path) -> dict[str, dict[str, float]]:
    """Figures by recording; none if there is no such file. ValueError if it is none of ours."""
    if not path.is_file():
        return {}
    try:
        return {recording: dict(figures) for recording, figures in
                json.loads(path.read_text(encoding='utf-8')).items()}
    except (TypeError, ValueError, AttributeError) as error:
        raise ValueError(f'{path} is not a reference of benchmark speed: {error}') from None


def write_reference(path: Path, recording: str, now: Figures) -> None:
    """Other recordings stay, and of this one the figures of parts that were not measured now."""
    references, parts = read_references(path), {_part(name) for name in now}
    kept = {name: value for name, value in references.get(recording, {}).items() if _part(name) not in parts}
    references[recording] = {name: round(value, 4) for name, value in sorted((kept | dict(now)).items())}
    path.write_text(json_text(references), encoding='utf-8')


def ratios(now: Figures, old: Figures) -> dict[str, float]:
    """Now over then, of the figures that both have."""
    return {name: value / old[name] for name, value in now.items() if old.get(name)}


def comparison(now: Figures, old: Figures) -> str:
    """Table of the ratios, slow ones marked, or a sentence that says why there is none."""
    rows = [[name, f'{ratio:.2f}', 'slower than the reference' if ratio > SLOWER else '']
            for name, ratio in ratios(now, old).items()]
    return table(['figure', 'times the reference', ''], rows) if rows else (
        'The reference has no such figures of this recording; --update-reference puts them there.')


def in_kernels(part: str, seconds: Figures, kernel_s: float) -> dict[str, float]:
    """Times, s, of a part as figures of a reference."""
    return {f'{part}: {name}': value / kernel_s for name, value in seconds.items()}


def _part(name: str) -> str:
    return name.partition(':')[0]
