"""ROS parameters as a view of the configuration: declared with description, range and choices."""
from __future__ import annotations

from array import array
from dataclasses import Field
from difflib import get_close_matches
from math import inf
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from line_slam_ros.config import Config, leaves
from line_slam_ros.config_file import apply
from line_slam_ros.shell_config import ShellConfig

MUTABLE = 'node.map_path'  # the only parameter that may change while the node runs
ROS_OWN = ('use_sim_time', 'start_type_description_service')


def declare(node: Node) -> tuple[Config, ShellConfig]:
    """Both configurations from the overrides (command line, YAML) of a node, every leaf declared as a parameter.

    The node must have been created with ``automatically_declare_parameters_from_overrides``: only so are misspelt
    names seen; they are warned of, since a ``/**`` section may be meant for other nodes. Integers are accepted for
    doubles. ValueError names the parameter, the value and what is allowed.
    """
    known = {name: f for part in (Config(), ShellConfig()) for name, f, _ in leaves(part)}
    given = {name: _plain(parameter.value) for name, parameter in node.get_parameters_by_prefix('').items()}
    for name in sorted(given.keys() - known.keys()):
        if name not in ROS_OWN and not name.startswith('qos_overrides.'):
            near = get_close_matches(name, known, 1)
            hint = f'; did you mean {near[0]!r}?' if near else ''
            node.get_logger().warning(f'unknown parameter {name!r} is ignored{hint}')
    config, shell = apply(Config(), ShellConfig(), {n: v for n, v in given.items() if n in known}, 'parameters')
    for part in (config, shell):
        for name, f, value in leaves(part):
            if name in given:
                node.undeclare_parameter(name)  # as the override's type, without description
            _declare(node, name, f, value)
    return config, shell


def _declare(node: Node, name: str, leaf: Field, value: Any) -> None:
    described = descriptor(name, leaf)
    if isinstance(value, tuple):  # an empty list has no type that rclpy could infer
        value = list(map(float, value)) or Parameter.Type.DOUBLE_ARRAY
    node.declare_parameter(name, value, described, ignore_override=True)


def descriptor(name: str, leaf: Field) -> ParameterDescriptor:
    """What ``ros2 param describe`` shows of one tunable."""
    low, high, choices = (leaf.metadata[key] for key in ('low', 'high', 'choices'))
    described = ParameterDescriptor(description=leaf.metadata['description'], read_only=name != MUTABLE)
    if choices:
        described.additional_constraints = f'one of: {", ".join(choices)}'
    if type(leaf.default) is int:
        described.integer_range = [IntegerRange(from_value=_or(low, -2**63), to_value=_or(high, 2**63 - 1))]
    elif type(leaf.default) is float:
        described.floating_point_range = [
            FloatingPointRange(from_value=float(_or(low, -inf)), to_value=float(_or(high, inf)))]
    return described


def _or(bound: float | None, unbounded: float) -> float:
    return unbounded if bound is None else bound


def _plain(value: Any) -> Any:
    """rclpy hands numeric lists out as ``array.array``."""
    return list(value) if isinstance(value, (array, tuple)) else value
