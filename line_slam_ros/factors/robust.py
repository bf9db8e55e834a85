"""Robust losses of a squared whitened residual, compiled."""
import numpy as np

from line_slam_ros.kernel_cache import kernel
from line_slam_ros.types import Loss

L2, HUBER, CAUCHY = int(Loss.L2), int(Loss.HUBER), int(Loss.CAUCHY)


@kernel
def robust(loss, s, c2):
    """rho and its derivative (the weight) at s = |r|^2, scale c2 = c^2; the cost of a residual is rho / 2.

    L2: s;  Huber: s up to c2, then 2 c |r| - c2;  Cauchy: c2 log(1 + s / c2)
    """
    if loss == CAUCHY:
        return c2 * np.log(1.0 + s / c2), 1.0 / (1.0 + s / c2)
    if loss == HUBER and s > c2:
        return 2.0 * np.sqrt(c2 * s) - c2, np.sqrt(c2 / s)
    return s, 1.0
