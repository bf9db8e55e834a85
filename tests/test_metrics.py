"""Line-map scores on sets whose answer is known."""
import numpy as np
import pytest

from line_slam_ros.mapping.metrics import ANGLE, covered, directions, point_to_segments, repeats, sampled, score


def segments(*ends):
    return np.array(ends, float).reshape(-1, 2, 3)


TRUTH = segments([0, 0, 0, 2, 0, 0], [0, 5, 0, 0, 5, 3])


def test_a_perfect_map_scores_one():
    result = score(TRUTH[:, ::-1], TRUTH)
    assert result.precision == result.recall == (1.0, 1.0, 1.0, 1.0)
    assert result.recall_m[0] == pytest.approx(5.0) and result.length == pytest.approx(5.0)
    assert (result.count, result.mean_length, result.duplicates) == (2, 2.5, 0)


def test_each_threshold_counts_what_lies_within_it():
    mapped = segments([0, 0.015, 0, 1, 0.015, 0], [0, 5, 1, 0, 5.3, 1.01])  # 1 m at 15 mm; one across the other edge
    result = score(mapped, TRUTH)
    assert result.precision == pytest.approx((0, 1 / 1.30017, 1 / 1.30017, 1 / 1.30017), rel=1e-4)
    assert result.recall_m == pytest.approx((0, 1.01, 1.04, 1.09), abs=0.011)
    assert result.recall == pytest.approx(np.array(result.recall_m) / 5.0)


@pytest.mark.parametrize('angle_deg, counted', [(9.9, True), (10.1, False)])
def test_directions_may_differ_by_ten_degrees(angle_deg, counted):
    a = np.radians(angle_deg)
    short = 0.05 * np.array([np.cos(a), np.sin(a), 0])
    share, _ = covered(segments([1, 0, 0, *(short + [1, 0, 0])]), TRUTH, (0.05,))
    assert share[0] == counted


def test_beyond_the_end_the_distance_is_to_the_end():
    result = score(segments([2, 0, 0, 2.2, 0, 0]), TRUTH, (0.05, 0.1))
    assert result.precision == pytest.approx((0.25, 0.5))


def test_an_empty_map_finds_nothing_and_has_no_precision():
    result = score(np.empty((0, 2, 3)), TRUTH)
    assert np.all(np.isnan(result.precision)) and result.recall == (0, 0, 0, 0) and result.count == 0


def test_samples_weigh_the_whole_length():
    rng = np.random.default_rng(0)
    some = rng.normal(size=(30, 2, 3))
    _, owner, weight = sampled(some)
    np.testing.assert_allclose(np.bincount(owner, weight), np.linalg.norm(some[:, 1] - some[:, 0], axis=1))
    assert weight.max() <= 0.01 + 1e-12


def test_the_search_agrees_with_trying_every_pair():
    rng = np.random.default_rng(1)
    mapped, truth = rng.uniform(-1, 1, (40, 2, 3)), rng.uniform(-1, 1, (60, 2, 3))
    samples, owner, weight = sampled(mapped)
    distance = point_to_segments(samples, truth)
    distance[np.abs(directions(mapped) @ directions(truth).T)[owner] < np.cos(ANGLE)] = np.inf
    expected = [weight[distance.min(axis=1) <= t].sum() for t in (0.1, 0.5)]
    assert min(expected) > 0
    np.testing.assert_allclose(covered(mapped, truth, (0.1, 0.5))[1], expected)


@pytest.mark.parametrize('other, repeated', [
    ([0.5, 0.02, 0, 3, 0.02, 0], True), ([3, 0, 0, 1.5, 0.01, 0], True), ([0.5, 0.04, 0, 1.5, 0.04, 0], False),
    ([2.01, 0, 0, 3, 0, 0], False), ([0, -0.1, 0, 2, 0.1, 0], False), ([1, 0, 0, 1.5, 0.06, 0], False)])
def test_duplicates_overlap_within_three_centimetres_and_five_degrees(other, repeated):
    assert repeats(segments([0, 0, 0, 2, 0, 0], other)).tolist() == [False, repeated]
