"""Equations of a few unknowns, against LAPACK."""
import numpy as np
import pytest

from line_slam_ros.estimation.window import whiten
from line_slam_ros.geometry.small_systems import factor, solve_positive


def positive(size):
    M = np.random.default_rng(size).normal(size=(size, size))
    return M @ M.T + 0.1 * np.eye(size)


@pytest.mark.parametrize('size', [1, 3, 4, 9])
def test_factor_and_solution_are_those_of_lapack(size):
    A, B, X = positive(size), np.random.default_rng(0).normal(size=(size, 2)), np.empty((size, 2))
    damped, L = A + np.diag(0.3 * np.diag(A)), A.copy()
    assert factor(L, size, 0.3)
    np.testing.assert_allclose(np.tril(L), np.linalg.cholesky(damped), rtol=1e-9, atol=1e-12)
    solve_positive(A.copy(), B, X)
    np.testing.assert_allclose(X, np.linalg.solve(A, B), rtol=1e-8)


def test_what_is_not_positive_definite_has_no_solution():
    A, X, W = np.diag([1.0, -1.0, 1.0]), np.empty((3, 1)), np.empty((9, 9))
    assert not factor(A.copy(), 3, 0.0)
    solve_positive(A, np.ones((3, 1)), X)
    whiten(-np.eye(9), W)
    assert np.isnan(X).all() and np.isnan(W).all()


def test_whitening_makes_a_covariance_the_identity():
    cov, W = 1e-4 * positive(9), np.empty((9, 9))
    whiten(cov, W)
    np.testing.assert_allclose(W @ cov @ W.T, np.eye(9), atol=1e-7)
    np.testing.assert_array_equal(np.triu(W, 1), 0.0)
