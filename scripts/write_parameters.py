#!/usr/bin/env python3
"""Write config/line_slam.yaml and docs/parameters.md from the dataclasses that define the parameters."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import Field, fields, is_dataclass
from pathlib import Path
from typing import Any

from line_slam_ros.config import Config, leaves
from line_slam_ros.shell_config import ShellConfig

ROOT = Path(__file__).parents[1]
YAML_FILE = ROOT / 'config' / 'line_slam.yaml'
MARKDOWN_FILE = ROOT / 'docs' / 'parameters.md'
PARTS = (Config(), ShellConfig())

YAML_HEAD = """\
# Every parameter of line_slam_node and `line_slam replay` with its default; keep only the lines that you change.
# Written by scripts/write_parameters.py.
/**:
  ros__parameters:
"""
MARKDOWN_HEAD = """\
# Parameters

The node takes them as ROS parameters (`--params-file FILE`, `-p name:=value`), `line_slam replay` from the same file
(`--config FILE`, `--set name=value`). [config/line_slam.yaml](../config/line_slam.yaml) lists them all with their
defaults. Written by `scripts/write_parameters.py`.

| name | type | default | range | meaning |
|---|---|---|---|---|
"""


def literal(value: Any) -> str:
    """A value as YAML that neither PyYAML nor rcl takes for another type (1e-05 would be a string to PyYAML)."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        mantissa, exponent, power = repr(value).partition('e')
        return (mantissa if '.' in mantissa else mantissa + '.0') + exponent + power
    return f"'{value}'" if isinstance(value, str) else str(value)


def allowed(leaf: Field) -> str:
    """The range or the choices of a parameter; empty if there are none."""
    low, high, choices = (leaf.metadata[key] for key in ('low', 'high', 'choices'))
    if choices:
        return ', '.join(choices)
    return '' if low is None and high is None else f'{"" if low is None else low} to {"" if high is None else high}'


def yaml_lines(config: Any, indent: str) -> Iterator[str]:
    """Each parameter under a comment with its meaning; a list without a default is left to the reader to fill in."""
    for f in fields(config):
        value = getattr(config, f.name)
        if is_dataclass(value):
            yield f'{indent}# {type(value).__doc__}\n{indent}{f.name}:\n'
            yield from yaml_lines(value, indent + '  ')
        else:
            limits = f' ({allowed(f)})' if allowed(f) and not f.metadata['choices'] else ''
            yield f'{indent}# {f.metadata["description"]}{limits}\n'
            yield f'{indent}# {f.name}: []\n' if value == () else f'{indent}{f.name}: {literal(value)}\n'


def yaml_text() -> str:
    return YAML_HEAD + ''.join(line for part in PARTS for line in yaml_lines(part, ' ' * 4))


def markdown_text() -> str:
    def kind(value: Any) -> str:
        return 'double array' if isinstance(value, tuple) else {'str': 'string', 'float': 'double'}.get(
            type(value).__name__, type(value).__name__)

    return MARKDOWN_HEAD + ''.join(
        f'| `{name}` | {kind(value)} | `{"[]" if value == () else literal(value)}` | {allowed(f)} '
        f'| {f.metadata["description"]} |\n' for part in PARTS for name, f, value in leaves(part))


def main() -> None:
    YAML_FILE.write_text(yaml_text(), encoding='utf-8')
    MARKDOWN_FILE.write_text(markdown_text(), encoding='utf-8')


if __name__ == '__main__':
    main()
