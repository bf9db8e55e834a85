"""The residual of a line of a building being upright, and its Jacobian, compiled and allocation free.

Elsewhere known as a vertical direction prior, as in an Atlanta world, whose z axis is that of gravity here.
"""
import numpy as np

from line_slam_ros.kernel_cache import inner


@inner
def upright(d_W, C, lean, spread, r, J):
    """Residual r (2,) of a line of direction d_W, any length and either way, against the lean (2,) rad of the building,
    over the spread, rad. J (2, 4): its Jacobian by the step of the line, of which C (6, 4) is the tangent. False for
    what has no direction."""
    length = np.sqrt(d_W[0] * d_W[0] + d_W[1] * d_W[1] + d_W[2] * d_W[2])
    if not length > 0.0:
        return False
    up = 1.0 if d_W[2] >= 0.0 else -1.0
    for k in range(2):
        r[k] = (up * d_W[k] / length - lean[k]) / spread
    for j in range(4):
        along = (d_W[0] * C[3, j] + d_W[1] * C[4, j] + d_W[2] * C[5, j]) / (length * length)
        for k in range(2):
            J[k, j] = up * (C[3 + k, j] - d_W[k] * along) / (length * spread)
    return True
