"""First estimates of lines in the window: what noise alone must not start."""
import numpy as np
import pytest

from line_slam_ros.estimation.line_start import start_from_planes
from line_slam_ros.estimation.triangulation import lines_in_cameras, start_lines
from line_slam_ros.geometry.lie import rigid, so3_exp
from line_slam_ros.geometry.line_forms import VALUES, store_lines, unit_world_lines
from line_slam_ros.geometry.lines import point_distance
from line_slam_ros.types import LineForm

VIEWS, SIGMA, MIN_SINE = 6, 1.0 / 450.0, np.sin(np.radians(2.0))
FORM = int(LineForm.ORTHONORMAL)


def seen(segments, positions, seed=0):
    """Rotations (VIEWS, 3, 3) of cameras at positions (VIEWS, 3), and segments (L, 2, 3) in them (L, VIEWS, 2, 2)."""
    rng, lines = np.random.default_rng(seed), len(segments)
    R = so3_exp(0.05 * rng.normal(size=(VIEWS, 3)))
    p_C = np.einsum('fji,lefj->lefi', R, segments[:, :, None] - positions)
    z = (p_C[..., :2] / p_C[..., 2:] + SIGMA * rng.normal(size=(lines, 2, VIEWS, 2))).transpose(0, 2, 1, 3)
    return R, np.ascontiguousarray(z)


def started(segments, positions):
    """Which segments (L, 2, 3) seen with noise SIGMA from positions (VIEWS, 3) get an estimate, and those (L, 6)."""
    (R, z), lines = seen(segments, positions), len(segments)
    values, origin, solved = np.zeros((lines, VALUES)), np.zeros((lines, 3)), np.zeros(lines, bool)
    start_lines(VIEWS, R, positions, np.eye(3), np.zeros(3), np.ones(lines, bool), np.ones((lines, VIEWS), bool),
                z, np.full((lines, VIEWS, 2), SIGMA), MIN_SINE, FORM, values, origin, solved)
    return solved, unit_world_lines(FORM, values[solved], origin[solved])[0]


def started_by_given_poses(segments, positions):
    """The same, of the start for given poses."""
    (R, z), lines = seen(segments, positions), len(segments)
    poses = np.repeat(rigid(R, positions)[None, :, :3], lines, axis=0)
    sigma, count = np.full((lines, VIEWS, 2), SIGMA), np.full(lines, VIEWS)
    found, origin, holds = start_from_planes(poses, z, sigma, count, MIN_SINE)
    found[:, :3] += np.cross(origin, found[:, 3:])
    return holds, found[holds]


STARTS = pytest.mark.parametrize('start', [started, started_by_given_poses])


def segments_of(rng, length, count=200):
    """As long as asked (m), across the view, ten metres ahead."""
    middle = rng.uniform([-3, -2, 9], [3, 2, 11], (count, 3))
    half = rng.normal(size=(count, 3)) * [1, 1, 0.1]
    half *= 0.5 * length / np.linalg.norm(half, axis=1, keepdims=True)
    return np.stack([middle - half, middle + half], axis=1)


@STARTS
@pytest.mark.parametrize('length', [0.3, 1.0, 4.0])
def test_noise_alone_starts_no_line(start, length):
    """The cameras only turn. Planes of segments of 13 pixels differ by some five degrees."""
    solved, _ = start(segments_of(np.random.default_rng(1), length), np.zeros((VIEWS, 3)))
    assert solved.mean() < 0.01


@STARTS
def test_parallax_beyond_the_noise_starts_lines_near_the_true_ones(start):
    segments = segments_of(np.random.default_rng(2), 4.0)
    positions = np.stack([np.linspace(0, 2, VIEWS), np.linspace(0, 1.5, VIEWS) ** 2, np.zeros(VIEWS)], axis=1)
    solved, lines = start(segments, positions)
    assert solved.mean() > 0.7
    error = point_distance(lines, segments[solved].mean(axis=1))
    assert np.median(error) < 0.1


def test_a_line_within_a_camera_that_sees_it_is_found():
    """Line 0 ends a millimetre from camera 1, line 1 three centimetres from one that does not see it, 2 is far off."""
    positions = np.arange(VIEWS)[:, None] * [0.5, 0.0, 0.0]
    feet = positions[1] + np.array([[0.0, 1e-3, 0.0], [0.0, 0.03, 0.0], [0.0, 0.2, 0.0]])
    pluecker = np.concatenate([np.cross(feet, [0.0, 0.0, 1.0]), np.tile([0.0, 0.0, 1.0], (3, 1))], axis=1)
    values, views = np.zeros((3, VALUES)), np.ones((3, VIEWS), bool)
    solved, inside = np.zeros(3, bool), np.zeros(3, bool)
    store_lines(FORM, pluecker, np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 2, 2)), values, solved)
    views[1, 1] = False
    lines_in_cameras(VIEWS, np.tile(np.eye(3), (VIEWS, 1, 1)), positions, np.eye(3), np.zeros(3), solved, views, FORM,
                     values, np.zeros((3, 3)), inside)
    assert inside.tolist() == [True, False, False]
