"""Equations of a few unknowns within kernels: LAPACK takes longer to compile in than to run."""
import numpy as np

from line_slam_ros.kernel_cache import inner


@inner
def factor(A, size, damping):
    """Lower triangle of A (size, size), its diagonal times 1 + damping -> Cholesky factor L, A = L L', in place.

    False, and A is spoiled, when it is not positive definite.
    """
    for j in range(size):
        t = A[j, j] * (1.0 + damping)
        for k in range(j):
            t -= A[j, k] * A[j, k]
        if not t > 0.0:
            return False
        A[j, j] = np.sqrt(t)
        for i in range(j + 1, size):
            t = A[i, j]
            for k in range(j):
                t -= A[i, k] * A[j, k]
            A[i, j] = t / A[j, j]
    return True


@inner
def solve_positive(A, B, X):
    """X = A^-1 B for a positive definite A (N, N), which is overwritten by its Cholesky factor; else X is NaN."""
    size = len(A)
    if not factor(A, size, 0.0):
        X[:] = np.nan
        return
    for c in range(B.shape[1]):
        for i in range(size):
            X[i, c] = B[i, c]
            for k in range(i):
                X[i, c] -= A[i, k] * X[k, c]
            X[i, c] /= A[i, i]
        for i in range(size - 1, -1, -1):
            for k in range(i + 1, size):
                X[i, c] -= A[k, i] * X[k, c]
            X[i, c] /= A[i, i]
