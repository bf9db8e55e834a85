"""The white noise that inertial samples themselves show, compiled.

Rotors and engines shake an IMU far above what its noise is calibrated to at rest, and faster than its samples can
follow: that integrates like noise. White noise is as strong at every frequency, so it is at most what is seen where the
least is. Seen are fourth differences, to which smooth motion is nothing, of means over 1, 2 and 4 samples: around a
half, a quarter and an eighth of the rate.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.kernel_cache import kernel
from line_slam_ros.types import F64

BANDS = 3
SQUARES = 70.0  # 1 + 16 + 36 + 16 + 1: variance of the fourth difference of white noise of variance 1


@kernel
def roughness(dt, x, power):
    """Fill power (BANDS, 2) from samples x (N, 3) every dt seconds: squared density of white noise with such
    differences, times their number, and that number. The first and the last sample, interpolated, are left out."""
    power[:] = 0.0
    for band in range(len(power)):
        n = 1 << band
        for k in range((len(x) - 2) // n - 4):
            for axis in range(3):
                d = 0.0
                for i in range(1 + k * n, 1 + (k + 1) * n):
                    d += (x[i, axis] + x[i + 4 * n, axis] - 4.0 * (x[i + n, axis] + x[i + 3 * n, axis])
                          + 6.0 * x[i + 2 * n, axis])
                power[band, 0] += d * d * dt / (SQUARES * n)
                power[band, 1] += 1.0


def white(power: F64) -> float:
    """Squared noise density by the sum of several power (BANDS, 2); 0 if that says nothing."""
    seen = power[power[:, 1] > 0.0]
    return float(np.min(seen[:, 0] / seen[:, 1])) if len(seen) else 0.0
