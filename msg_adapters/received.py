"""The node's own outputs read back, for a listener that keeps what was published."""
from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from line_slam_ros.types import U8


def marker_lines(msg: Any) -> tuple[str, int]:
    """visualization_msgs/Marker LINE_LIST to (namespace, number of lines)."""
    return msg.ns, len(msg.points) // 2


def bgr_pixels(msg: Any) -> U8:
    """sensor_msgs/Image of outputs.image to (H, W, 3) BGR."""
    pixels = np.frombuffer(msg.data, np.uint8).reshape(msg.height, msg.width, -1)
    return pixels if pixels.shape[2] == 3 else cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)


def diagnosis(msg: Any, name: str) -> str:
    """The message of one status in a diagnostic_msgs/DiagnosticArray, '' if it holds no such status."""
    return next((status.message for status in msg.status if status.name == name), '')


def diagnosis_values(msg: Any, name: str) -> dict[str, str]:
    """Key to value of one status in a diagnostic_msgs/DiagnosticArray, empty if it holds no such status."""
    return next(({pair.key: pair.value for pair in status.values} for status in msg.status if status.name == name), {})
