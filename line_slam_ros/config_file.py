"""Parameter files: one YAML for node and replay, in the ROS form or plainly nested.

    /**: {ros__parameters: {estimator: {window: 11}}}        and        estimator: {window: 11}

say the same. A file may hold sections of other nodes; of the ROS form only ``/**`` and this node's are read.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import Field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml

from line_slam_ros.config import Config, leaves, override
from line_slam_ros.shell_config import ShellConfig

NODE_NAME = 'line_slam'
_ROS_OWN = ('use_sim_time', 'qos_overrides', 'start_type_description_service')  # parameters every ROS node has
_SECTIONS = ('/**', f'/**/{NODE_NAME}', NODE_NAME, f'/{NODE_NAME}')  # later ones win


def load(paths: Iterable[Path | str] = (), given: Iterable[str] = ()) -> tuple[Config, ShellConfig]:
    """Defaults, then the files in order, then ``name=value`` texts; ValueError names file, key and remedy."""
    config, shell = Config(), ShellConfig()
    for path in paths:
        config, shell = apply(config, shell, read(path), str(path))
    return apply(config, shell, settings(given, '--set'), '--set')


def apply(config: Config, shell: ShellConfig, values: Mapping[str, Any], origin: str) -> tuple[Config, ShellConfig]:
    """Both configurations with the flat dotted ``values`` put in; ValueError for unknown names and bad values."""
    known = {name: f for part in (config, shell) for name, f, _ in leaves(part)}
    for name in values:
        if name not in known:
            raise ValueError(f'{origin}: unknown parameter {name!r}{_hint(name, known)}')
    typed = {name: _typed(known[name], value) for name, value in values.items()}
    try:
        return override(config, typed.get), override(shell, typed.get)
    except ValueError as error:
        raise ValueError(f'{origin}: {error}') from None


def read(path: Path | str) -> dict[str, Any]:
    """Flat ``dotted.name -> value`` of a parameter file; OSError or ValueError if it cannot be read."""
    try:
        document = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f'{path}: not readable as YAML: {" ".join(str(error).split())}') from None
    if type(document) is not dict:
        raise ValueError(f'{path}: holds no parameters; expected "name: value" lines, see config/line_slam.yaml')
    values: dict[str, Any] = {}
    for section in _parameter_sections(document, path):
        values.update(_flat(section))
    return {name: value for name, value in values.items() if name.split('.')[0] not in _ROS_OWN}


def _parameter_sections(document: Mapping[str, Any], path: Path | str) -> list[Mapping[str, Any]]:
    if not any(isinstance(value, dict) and 'ros__parameters' in value for value in document.values()):
        return [document]
    found = [document[key]['ros__parameters'] or {} for key in _SECTIONS if key in document]
    if not found:
        raise ValueError(f'{path}: has parameters of {", ".join(map(str, document))}, none of {NODE_NAME!r} or "/**"')
    return found


def _flat(tree: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat.update(_flat(value, f'{prefix}{key}.') if isinstance(value, dict) else {f'{prefix}{key}': value})
    return flat


def settings(texts: Iterable[str], option: str) -> dict[str, Any]:
    """Name -> value of ``name=value`` texts, values in YAML; ValueError names the option they were given with."""
    return dict(_setting(text, option) for text in texts)


def _setting(text: str, option: str) -> tuple[str, Any]:
    name, equals, value = text.partition('=')
    if not equals:
        raise ValueError(f'{option} {text}: expected name=value')
    try:
        return name.strip(), yaml.safe_load(value)
    except yaml.YAMLError:
        raise ValueError(f'{option} {text}: the value is not readable as YAML') from None


def _typed(leaf: Field, value: Any) -> Any:
    """YAML 1.1 reads 1 for 1.0, text for 1e-4, lists for tuples; the configuration itself checks what comes out."""
    if type(leaf.default) is float and type(value) in (int, str):
        try:
            return float(value)
        except ValueError:
            return value
    if type(leaf.default) is tuple and isinstance(value, list):
        return tuple(value)
    return '' if leaf.default == '' and value is None else value


def _hint(name: str, known: Iterable[str]) -> str:
    by_leaf = {full.rsplit('.', 1)[-1]: full for full in known}
    leaf = name.rsplit('.', 1)[-1]
    near = get_close_matches(name, known, 1) or [by_leaf[n] for n in get_close_matches(leaf, by_leaf, 1)]
    return f'; did you mean {near[0]!r}?' if near else '; see config/line_slam.yaml for the names'
