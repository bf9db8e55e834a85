import numpy as np
import pytest

from line_slam_ros.frontend.two_view import static_matches
from line_slam_ros.geometry.lie import so3_exp, so3_log

THRESHOLD = 1.0 / 460.0


def scene(rng, w, t, n=120, noise=0.2 / 460.0):
    """Rays x1, x2 (n, 2) of points in view of two cameras: X2 = Exp(w) X1 + t."""
    X1 = np.column_stack([rng.uniform(-1.5, 1.5, n), rng.uniform(-1.0, 1.0, n), rng.uniform(2.0, 6.0, n)])
    X2 = X1 @ so3_exp(np.array(w)).T + t
    return tuple(X[:, :2] / X[:, 2:] + rng.normal(0.0, noise, (n, 2)) for X in (X1, X2))


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.mark.parametrize('known', [True, False])
@pytest.mark.parametrize(('w', 't'), [((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.02, -0.03, 0.04), (0.0, 0.0, 0.0)),
                                      ((0.01, 0.02, -0.02), (0.05, 0.01, 0.02)), ((0.0, 0.01, 0.0), (0.0, 0.0, 0.1))])
def test_static_points_stay_whatever_the_motion(rng, w, t, known):
    x1, x2 = scene(rng, w, t)
    keep, _ = static_matches(x1, x2, so3_exp(np.array(w)) if known else None, 4e-3, THRESHOLD)
    assert keep.mean() > 0.97


@pytest.mark.parametrize(('known', 'kept'), [(True, 0.95), (False, 0.85)])
def test_wrong_matches_go(rng, known, kept):
    w, t = np.array([0.01, 0.02, -0.02]), (0.08, 0.01, 0.02)
    x1, x2 = scene(rng, w, t)
    x2[:30] += rng.choice([-1.0, 1.0], (30, 2)) * rng.uniform(8.0, 20.0, (30, 2)) / 460.0
    keep, _ = static_matches(x1, x2, so3_exp(w) if known else None, 4e-3, THRESHOLD)
    assert keep[30:].mean() > kept
    assert keep[:30].mean() < 0.25  # those moved along their epipolar line cannot be told


def test_error_of_the_rotation_is_estimated(rng):
    w, t, error = np.array([0.01, 0.02, -0.02]), (0.1, 0.02, 0.0), np.array([2e-3, -3e-3, 4e-3])
    x1, x2 = scene(rng, w, t, n=200)
    keep, R = static_matches(x1, x2, so3_exp(w) @ so3_exp(error), 4e-3, THRESHOLD)
    assert keep.mean() > 0.97
    assert np.linalg.norm(so3_log(R.T @ so3_exp(w))) < 0.5 * np.linalg.norm(error)


def test_few_matches_are_not_judged():
    keep, R = static_matches(np.zeros((3, 2)), np.ones((3, 2)), None, 4e-3, THRESHOLD)
    assert keep.all() and np.array_equal(R, np.eye(3))


def test_same_input_same_answer(rng):
    x1, x2 = scene(rng, (0.01, 0.0, 0.0), (0.05, 0.0, 0.0))
    first, second = (static_matches(x1, x2, None, 4e-3, THRESHOLD) for _ in range(2))
    assert np.array_equal(first[0], second[0]) and np.array_equal(first[1], second[1])
