"""Dense symmetric equations, by LAPACK."""
from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs

from line_slam_ros.types import F64

TRACE = 1e-9  # information that holds what nothing says anything about


def hold(H: F64, rows: np.ndarray) -> None:
    """Make the unknowns of those rows constants, in place."""
    H[rows], H[:, rows], H[rows, rows] = 0.0, 0.0, 1.0


def cholesky(H: F64, damping: float = 0.0) -> F64:
    """Upper U (D, D) with U' U = H, its diagonal times 1 + damping; (0, 0) when H is not positive definite."""
    factor = H.copy()
    np.fill_diagonal(factor, (1.0 + damping) * np.diag(H) + TRACE)
    lower, info = dpotrf(factor.T, lower=1, clean=1, overwrite_a=1)
    return lower.T if info == 0 else np.zeros((0, 0))


def regular(factor: F64) -> F64:
    """The factor, if there is one; LinAlgError if not."""
    if not len(factor):
        raise np.linalg.LinAlgError('not positive definite')
    return factor


def solve(factor: F64, b: F64) -> F64:
    """x (D, ...) with U' U x = b."""
    return dpotrs(factor.T, b, lower=1)[0]
