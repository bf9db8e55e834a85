"""One way to build messages, live or for a bag: ``new('geometry_msgs/msg/Point', x=1.0, y=2.0, z=3.0)``.

All fields are given, as Python floats, ints and strings, lists of messages, or NumPy arrays of the field's own type.
"""
from __future__ import annotations

import array
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np


class MessageFactory:
    """Creates messages by ROS type name ('package/msg/Name')."""

    def __init__(self, message_class: Callable[[str], type], wrap: Callable[[Any], Any]) -> None:
        self._class = cache(message_class)
        self._wrap = wrap

    def __call__(self, type_name: str, **fields: Any) -> Any:
        return self._class(type_name)(**{name: self._wrap(value) for name, value in fields.items()})

    def type(self, type_name: str) -> type:
        """The message class itself, for hot loops."""
        return self._class(type_name)


def ros_messages() -> MessageFactory:
    """Messages of the installed ROS interface packages; ImportError names a package that is not there."""
    return MessageFactory(_ros_class, _bytes_as_array)


def bag_messages(typestore: Any) -> MessageFactory:
    """Messages of a rosbags typestore."""
    return MessageFactory(typestore.types.__getitem__, lambda value: value)


def _ros_class(type_name: str) -> type:
    package, _, name = type_name.split('/')
    return getattr(import_module(f'{package}.msg'), name)


def _bytes_as_array(value: Any) -> Any:
    """rclpy copies a uint8 ndarray element by element (30 ms per image), an array.array at once (20 us)."""
    if isinstance(value, np.ndarray) and value.dtype == np.uint8:
        return array.array('B', value.tobytes())
    return value
