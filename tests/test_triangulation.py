"""First estimates of lines in the window: what noise alone must not start."""
import numpy as np
import pytest

from line_slam_ros.estimation.triangulation import start_lines
from line_slam_ros.geometry.lie import so3_exp
from line_slam_ros.geometry.line_forms import VALUES, unit_world_lines
from line_slam_ros.geometry.lines import point_distance
from line_slam_ros.types import LineForm

VIEWS, SIGMA, MIN_SINE = 6, 1.0 / 450.0, np.sin(np.radians(2.0))
FORM = int(LineForm.ORTHONORMAL)


def started(segments, positions, seed=0):
    """Which segments (L, 2, 3) seen with noise SIGMA from positions (VIEWS, 3) get an estimate, and those (L, 6)."""
    rng, lines = np.random.default_rng(seed), len(segments)
    R = so3_exp(0.05 * rng.normal(size=(VIEWS, 3)))
    p_C = np.einsum('fji,lefj->lefi', R, segments[:, :, None] - positions)
    z = (p_C[..., :2] / p_C[..., 2:] + SIGMA * rng.normal(size=(lines, 2, VIEWS, 2))).transpose(0, 2, 1, 3)
    values, origin, solved = np.zeros((lines, VALUES)), np.zeros((lines, 3)), np.zeros(lines, bool)
    start_lines(VIEWS, R, positions, np.eye(3), np.zeros(3), np.ones(lines, bool), np.ones((lines, VIEWS), bool),
                np.ascontiguousarray(z), np.full((lines, VIEWS, 2), SIGMA), MIN_SINE, FORM, values, origin, solved)
    return solved, unit_world_lines(FORM, values[solved], origin[solved])[0]


def segments_of(rng, length, count=200):
    """As long as asked (m), across the view, ten metres ahead."""
    middle = rng.uniform([-3, -2, 9], [3, 2, 11], (count, 3))
    half = rng.normal(size=(count, 3)) * [1, 1, 0.1]
    half *= 0.5 * length / np.linalg.norm(half, axis=1, keepdims=True)
    return np.stack([middle - half, middle + half], axis=1)


@pytest.mark.parametrize('length', [0.3, 1.0, 4.0])
def test_noise_alone_starts_no_line(length):
    """The cameras only turn. Planes of segments of 13 pixels differ by some five degrees."""
    solved, _ = started(segments_of(np.random.default_rng(1), length), np.zeros((VIEWS, 3)))
    assert solved.mean() < 0.01


def test_parallax_beyond_the_noise_starts_lines_near_the_true_ones():
    segments = segments_of(np.random.default_rng(2), 4.0)
    positions = np.stack([np.linspace(0, 2, VIEWS), np.linspace(0, 1.5, VIEWS) ** 2, np.zeros(VIEWS)], axis=1)
    solved, lines = started(segments, positions)
    assert solved.mean() > 0.7
    error = point_distance(lines, segments[solved].mean(axis=1))
    assert np.median(error) < 0.1
