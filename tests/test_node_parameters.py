"""The node's parameters: every tunable declared as it is documented, from YAML and command line."""
from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip('rclpy')
from rclpy.node import Node
from rclpy.parameter import Parameter

from line_slam_ros.config import Config, leaves
from line_slam_ros.nodes.parameters import MUTABLE, declare
from line_slam_ros.shell_config import ShellConfig

TUNABLES = {name: leaf for part in (Config(), ShellConfig()) for name, leaf, _ in leaves(part)}


@pytest.fixture
def node_with(ros: None) -> Iterator[Callable[..., Node]]:
    nodes = []

    def make(*ros_args: str) -> Node:
        nodes.append(Node('line_slam', automatically_declare_parameters_from_overrides=True,
                          cli_args=['--ros-args', *ros_args]))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()


def test_defaults_are_those_of_the_configuration(node_with: Callable[..., Node]) -> None:
    assert declare(node_with()) == (Config(), ShellConfig())


@pytest.mark.parametrize('name', TUNABLES)
def test_descriptor_tells_what_the_configuration_tells(name: str, node_with: Callable[..., Node]) -> None:
    node = node_with()
    declare(node)
    told, meta = node.describe_parameter(name), TUNABLES[name].metadata
    assert told.description == meta['description'] and told.read_only == (name != MUTABLE)
    assert all(choice in told.additional_constraints for choice in meta['choices'])
    for bound, end in ((meta['low'], 'from_value'), (meta['high'], 'to_value')):
        if bound is not None:
            ranges = [*told.integer_range, *told.floating_point_range]
            assert [getattr(r, end) for r in ranges] == [bound]


def test_values_from_yaml_and_command_line(node_with: Callable[..., Node], tmp_path: Path) -> None:
    yaml = tmp_path / 'parameters.yaml'
    yaml.write_text('/**:\n  ros__parameters:\n    points: {min_distance_px: 30}\n    estimator: {window: 8}\n'
                    '    T_body_camera: [1, 2, 3]\n')
    node = node_with('--params-file', str(yaml), '-p', 'estimator.window:=9')
    config, shell = declare(node)
    assert config.points.min_distance_px == 30.0 and type(config.points.min_distance_px) is float  # an int in the YAML
    assert config.estimator.window == 9
    assert shell.T_body_camera == (1, 2, 3)
    assert node.get_parameter('points.min_distance_px').value == 30.0
    assert list(node.get_parameter('T_body_camera').value) == [1.0, 2.0, 3.0]


@pytest.mark.parametrize('argument,complaint', [
    ('points.max_count:=2.5', 'points.max_count must be int, got 2.5'),
    ('use_lines:=1', 'use_lines must be bool, got 1'),
    ('points.min_distance_px:=-1.0', r'points.min_distance_px must lie in \[3.0, 200.0\], got -1.0'),
    ('node.reliability:=maybe', 'reliability must be one of best_effort, reliable'),
])
def test_bad_values_are_named(node_with: Callable[..., Node], argument: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        declare(node_with('-p', argument))


def test_only_the_map_path_changes_while_running(node_with: Callable[..., Node]) -> None:
    node = node_with()
    declare(node)
    results = node.set_parameters([Parameter('estimator.window', value=9), Parameter(MUTABLE, value='elsewhere')])
    assert [r.successful for r in results] == [False, True]
