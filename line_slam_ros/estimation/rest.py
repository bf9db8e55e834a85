"""What rest says: a state at rest has no velocity, a link between two of them no length.

links is a range [first, last) of the window's; the last state of a range is left to the range that starts with it.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.estimation.window import Window, state_row
from line_slam_ros.types import F64

SPEED = 0.01  # m/s, how still a body at rest is
SHIFT = 1e-3  # m, and how far it may move between two states at rest


def add_rest(window: Window, links: tuple[int, int], H: F64) -> None:
    """Into the Hessian H."""
    speed, shift = np.eye(3) / SPEED**2, np.eye(3) / SHIFT**2
    states, pairs = _resting(window, links)
    for k in states:
        v = _part(k, 6)
        H[v, v] += speed
    for k in pairs:
        a, b = _part(k, 3), _part(k + 1, 3)
        H[a, a] += shift
        H[b, b] += shift
        H[a, b] -= shift
        H[b, a] -= shift


def add_rest_gradient(window: Window, links: tuple[int, int], g: F64) -> None:
    """Into the gradient g."""
    states, pairs = _resting(window, links)
    for k in states:
        g[_part(k, 6)] += window.v[k] / SPEED**2
    for k in pairs:
        shift = (window.p[k + 1] - window.p[k]) / SHIFT**2
        g[_part(k, 3)] -= shift
        g[_part(k + 1, 3)] += shift


def rest_cost(window: Window) -> float:
    """Half the squares of all of it, in standard deviations."""
    states, pairs = _resting(window, (0, window.n - 1))
    return 0.5 * sum(float(np.sum((window.v[k] / SPEED) ** 2)) for k in states) \
        + 0.5 * sum(float(np.sum(((window.p[k + 1] - window.p[k]) / SHIFT) ** 2)) for k in pairs)


def _resting(window: Window, links: tuple[int, int]) -> tuple[list[int], list[int]]:
    """Slots at rest, and the first ones of links between two of them."""
    still, n, (first, last) = window.still[:window.n], window.n, links
    if not still.any():
        return [], []
    return ([k for k in range(first, n if last == n - 1 else last) if still[k]],
            [k for k in range(first, last) if still[k] and still[k + 1]])


def _part(slot: int, first: int) -> slice:
    """Three rows of a slot's state."""
    return slice(state_row(slot) + first, state_row(slot) + first + 3)
