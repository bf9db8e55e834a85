"""How fast is this machine right now? A fixed piece of work, so that times can be compared between machines and hours.

The work is of the solvers' kind: small dense systems in double precision, built up from a stream of rows that does not
fit the inner caches, with square roots and divisions in between. A time divided by the kernel's is a figure that a slow
or busy machine changes little, above all when both are taken in turns (``in_turns``).
"""
from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from numba import njit

from line_slam_ros.types import F64

ROWS, WIDTH, SWEEPS = 40_000, 10, 40  # 3.2 MB


def rows() -> F64:
    """The same (ROWS, WIDTH) numbers every time, between 0.5 and 1.5."""
    index = np.arange(ROWS * WIDTH, dtype=np.uint64) * np.uint64(2654435761) % np.uint64(1 << 32)
    return (index / float(1 << 32) + 0.5).reshape(ROWS, WIDTH)


@njit(cache=True, nogil=True, error_model='numpy')
def calibration_kernel(data):
    """Sum of the solutions of one 4x4 normal equation per eight rows of data (N, 10), SWEEPS times over."""
    H, g, total = np.empty((4, 4)), np.empty(4), 0.0
    for _ in range(SWEEPS):
        for start in range(0, len(data) - 7, 8):
            H[:], g[:] = 0.0, 0.0
            for k in range(start, start + 8):
                weight = 1.0 / np.sqrt(1.0 + data[k, 8] * data[k, 9])
                for i in range(4):
                    g[i] += weight * data[k, i] * data[k, 4 + i]
                    for j in range(i + 1):
                        H[i, j] += weight * data[k, i] * data[k, j]
            total += _solved(H, g)
    return total


@njit(cache=True, nogil=True, error_model='numpy')
def _solved(H, g):
    """Sum of (H + 1)^-1 g by Cholesky; the lower triangle of H (4, 4) and g (4,) are used up."""
    for j in range(4):
        s = H[j, j] + 1.0
        for k in range(j):
            s -= H[j, k] * H[j, k]
        H[j, j] = np.sqrt(s)
        for i in range(j + 1, 4):
            s = H[i, j]
            for k in range(j):
                s -= H[i, k] * H[j, k]
            H[i, j] = s / H[j, j]
    total = 0.0
    for i in range(4):
        for k in range(i):
            g[i] -= H[i, k] * g[k]
        g[i] /= H[i, i]
    for i in range(3, -1, -1):
        for k in range(i + 1, 4):
            g[i] -= H[k, i] * g[k]
        g[i] /= H[i, i]
        total += g[i]
    return total


def kernel_seconds() -> float:
    """Wall seconds of the kernel, once it is compiled."""
    data = rows()
    began = time.perf_counter()
    calibration_kernel(data)
    return time.perf_counter() - began


def in_turns(works: Sequence[Callable[[], float]], repeats: int) -> F64:
    """(repeats, works) seconds that the works say they took, taken in turns after one turn that does not count."""
    turns = [[work() for work in works] for _ in range(repeats + 1)]
    return np.array(turns[1:])


def machine_ms(repeats: int = 5) -> float:
    """Median milliseconds of the kernel."""
    return 1e3 * float(np.median(in_turns([kernel_seconds], repeats)))
