"""Equations of a few unknowns within kernels: LAPACK takes longer to compile in than to run."""
import numpy as np

from line_slam_ros.kernel_cache import inner


@inner
def solve_positive(A, B, X):
    """X = A^-1 B for a positive definite A (N, N), which is overwritten by its Cholesky factor."""
    size = len(A)
    for i in range(size):
        for j in range(i + 1):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] = np.sqrt(A[i, i]) if i == j else A[i, j] / A[j, j]
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
