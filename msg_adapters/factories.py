"""One way to build messages, live or for a bag: ``new('geometry_msgs/msg/Point', x=1.0, y=2.0, z=3.0)``.

All fields are given, as Python floats, ints and strings, lists of messages, NumPy arrays of the field's own type, and
for bytes what ``new.octets(array)`` makes of them.
"""
from __future__ import annotations

import array
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

from line_slam_ros.types import U8


class MessageFactory:
    """Creates messages by ROS type name ('package/msg/Name')."""

    def __init__(self, message_class: Callable[[str], type], octets: Callable[[U8], Any]) -> None:
        """``octets`` makes of a flat uint8 array what a field of bytes takes."""
        self._class = cache(message_class)
        self.octets = octets

    def __call__(self, type_name: str, **fields: Any) -> Any:
        return self._class(type_name)(**fields)

    def type(self, type_name: str) -> type:
        """The message class itself, for hot loops."""
        return self._class(type_name)


def ros_messages() -> MessageFactory:
    """Messages of the installed ROS interface packages; ImportError names a package that is not there."""
    return MessageFactory(_ros_class, _as_array)


def bag_messages(typestore: Any) -> MessageFactory:
    """Messages of a rosbags typestore."""
    return MessageFactory(typestore.types.__getitem__, lambda octets: octets)


def _ros_class(type_name: str) -> type:
    package, _, name = type_name.split('/')
    return getattr(import_module(f'{package}.msg'), name)


def _as_array(octets: U8) -> array.array:
    """rclpy copies a uint8 ndarray element by element (30 ms per image), an array.array at once (20 us)."""
    return array.array('B', octets.tobytes())
