"""Rest told from motion by corners and segments; a segment sees only what goes across it."""
import numpy as np
import pytest
from line_scene import FOCAL, image, scene

from line_slam_ros.estimation.shift import FEW_CORNERS, segment_shifts, shared
from line_slam_ros.estimation.stillness import Stillness
from line_slam_ros.types import LineObservations, Observations, PointObservations

NOISE_PX = 0.2
REST = np.zeros(3)
SAMPLES = np.arange(11) * 0.005, np.zeros((11, 3)), np.tile([0.0, 0.0, 9.81], (11, 1))


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def along(rng, direction, count):
    """Segments (count, 2, 3) of one direction."""
    middle, half = scene(rng, count).mean(axis=1), 0.5 * np.asarray(direction, float)
    return np.stack([middle - half, middle + half], axis=1)


def still(rng, segments, velocity, corners=0, corner_velocity=None, seconds=1.0):
    """Verdicts at 20 Hz on a camera of this velocity (m/s) that sees pieces of segments (L, 2, 3), and corners."""
    judge, verdicts, points = Stillness(FOCAL, NOISE_PX), [], scene(rng, corners)[:, 0]
    for k in range(int(20 * seconds)):
        moved = 0.05 * k * velocity
        corners_moved = moved if corner_velocity is None else 0.05 * k * corner_velocity
        part = np.sort(rng.uniform(0, 1, (len(segments), 2, 1)), axis=1) * [[0.3], [0.3]] + [[0.0], [0.7]]
        ends = segments[:, :1] + part * (segments[:, 1:] - segments[:, :1])
        ends, x = image(ends - moved), image(points - corners_moved)
        ends, x = (a + rng.normal(size=a.shape) * NOISE_PX / FOCAL for a in (ends, x))
        seen = Observations(50_000_000 * k, PointObservations(np.arange(corners), FOCAL * x, x),
                            LineObservations(np.arange(len(segments)), ends,
                                             np.full((len(segments), 2), NOISE_PX / FOCAL)))
        verdicts.append(judge.add(seen, SAMPLES if k else None))
    return np.array(verdicts)


@pytest.mark.parametrize('corners', [0, FEW_CORNERS - 1])
def test_segments_whose_ends_slide_are_at_rest_when_corners_are_few(rng, corners):
    verdicts = still(rng, scene(rng, 40), REST, corners)
    assert not verdicts[:10].any() and verdicts[10:].all()


@pytest.mark.parametrize('corners', [0, FEW_CORNERS - 1])
@pytest.mark.parametrize('direction', np.eye(3))
def test_segments_see_slow_motion_in_any_direction(rng, direction, corners):
    """Ahead is the hardest: the image hardly changes near its middle."""
    speed = 0.15 if direction[2] else 0.03  # m/s
    assert not still(rng, scene(rng, 40), speed * direction, corners).any()


@pytest.mark.parametrize('direction', np.eye(3))
def test_parallel_segments_would_miss_a_motion_along_them_and_tell_no_rest(rng, direction):
    for velocity in (REST, direction):
        assert not still(rng, along(rng, direction, 40), velocity).any()


def test_the_few_segments_across_a_corridor_see_the_motion_along_it(rng):
    ahead = np.array([0.0, 0.0, 1.0])
    corridor = np.concatenate([along(rng, ahead, 28), along(rng, [0, 1, 0], 8), along(rng, [1, 0, 0], 4)])
    assert still(rng, corridor, REST)[10:].all()
    assert not still(rng, corridor, 0.15 * ahead).any()


def test_a_handful_of_segments_is_not_enough(rng):
    assert not still(rng, scene(rng, FEW_CORNERS - 1), REST).any()
    assert not still(rng, scene(rng, 0), REST).any()


@pytest.mark.parametrize('moving', [True, False])
def test_enough_corners_judge_alone(rng, moving):
    sideways = np.array([0.3, 0.0, 0.0])
    velocity, corner_velocity = (REST, sideways) if moving else (sideways, REST)
    verdicts = still(rng, scene(rng, 40), velocity, FEW_CORNERS, corner_velocity)
    assert verdicts[10:].any() != moving and verdicts[10:].all() != moving


def test_sliding_along_is_no_shift_and_across_counts_like_a_corner(rng):
    then = rng.uniform(-0.3, 0.3, (500, 2, 2))
    along_it = (then[:, 1] - then[:, 0]) * rng.uniform(-1, 1, (500, 1))
    sigma = np.full((500, 2), 1e-3)
    np.testing.assert_allclose(segment_shifts(then, then + along_it[:, None], sigma, sigma)[0], 0, atol=1e-12)
    size, _ = segment_shifts(then, then + [0.01, 0.0], sigma, sigma)
    assert np.median(size) == pytest.approx(0.01, rel=0.1)


def test_the_noise_of_a_shift_is_as_told_beyond_the_ends_too(rng):
    """Ends of unlike noise; at the second sighting only a third of the segment is seen."""
    ends = np.repeat([[[-0.2, 0.1], [0.25, -0.05]]], 20000, axis=0)
    part = ends[:, :1] + np.array([[0.5], [0.85]]) * (ends[:, 1:] - ends[:, :1])
    sigma, sigma_part = np.tile([1e-3, 2e-3], (20000, 1)), np.tile([5e-4, 1e-3], (20000, 1))
    across = np.array([0.15, 0.45]) / np.hypot(0.15, 0.45)
    noisy = [e + (rng.normal(size=s.shape) * s)[..., None] * across for e, s in ((ends, sigma), (part, sigma_part))]
    size, one = segment_shifts(*noisy, sigma, sigma_part)
    assert np.mean(size**2 / (4.0 * one**2)) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize('sizes', [(0, 0), (0, 5), (5, 0), (1, 1), (40, 30), (30, 60)])
def test_shared_ids_are_found_in_both(rng, sizes):
    a, b = (np.sort(rng.choice(70, size, replace=False)) for size in sizes)
    i, j = shared(a, b)
    np.testing.assert_array_equal(a[i], np.intersect1d(a, b))
    np.testing.assert_array_equal(b[j], np.intersect1d(a, b))
