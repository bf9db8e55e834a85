"""The parameter file and its documentation are views of the configuration and say the same as it does."""
from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from line_slam_ros.config import Config, leaves
from line_slam_ros.config_file import load
from line_slam_ros.shell_config import ShellConfig

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope='module')
def writer() -> ModuleType:
    spec = importlib.util.spec_from_file_location('write_parameters', ROOT / 'scripts' / 'write_parameters.py')
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_files_are_up_to_date(writer: ModuleType) -> None:
    outdated = [file.name for file, text in ((writer.YAML_FILE, writer.yaml_text()),
                                             (writer.MARKDOWN_FILE, writer.markdown_text()))
                if not file.exists() or file.read_text(encoding='utf-8') != text]
    assert not outdated, f'run scripts/write_parameters.py: {outdated}'


def test_parameter_file_holds_the_defaults(writer: ModuleType) -> None:
    assert load([writer.YAML_FILE]) == (Config(), ShellConfig())


@pytest.mark.parametrize('value', [1e-05, 1.0, 1e30, -2.5e-10, 3, True, 'text', ''])
def test_literals_keep_their_type(writer: ModuleType, value: object) -> None:
    yaml = pytest.importorskip('yaml')
    read = yaml.safe_load(f'key: {writer.literal(value)}')['key']
    assert (type(read), read) == (type(value), value)


def test_ros_reads_the_same_types_and_values(writer: ModuleType, ros: None) -> None:
    from rclpy.node import Node
    node = Node('line_slam', automatically_declare_parameters_from_overrides=True, start_parameter_services=False,
                cli_args=['--ros-args', '--params-file', str(writer.YAML_FILE)])
    expected = {name: value for part in (Config(), ShellConfig()) for name, _, value in leaves(part) if value != ()}
    read = {name: node.get_parameter(name).value for name in expected}
    node.destroy_node()
    assert {n: (type(v), v) for n, v in read.items()} == {n: (type(v), v) for n, v in expected.items()}


@pytest.mark.parametrize('part', [Config(), ShellConfig()], ids=lambda part: type(part).__name__)
def test_every_parameter_has_a_meaning(part: Config | ShellConfig) -> None:
    assert not [name for name, leaf, _ in leaves(part) if not leaf.metadata['description']]
