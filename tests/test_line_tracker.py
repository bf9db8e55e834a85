import cv2
import numpy as np
import pytest
from plane_scene import FOCAL, MARGIN, homography, mosaic, move, pinhole, step_edge, view

from line_slam_ros.config import Lines
from line_slam_ros.frontend.line_tracker import LineTracker
from line_slam_ros.geometry.lie import so3_exp

NO_CORNERS = np.empty((0, 2)), np.empty((0, 2))


@pytest.fixture
def tracker():
    return LineTracker(pinhole(), Lines(max_count=60, min_length_px=30.0))


def see(tracker, image, R=None):
    tracker.take(image)
    tracker.track(R, *NO_CORNERS)
    tracker.detect()
    return tracker.observations()


def pixels(ends):
    return ends * FOCAL + [160.0, 120.0]


def distance(ends_px, a, b):
    """Of ends (..., 2) to the line through pixels a, b."""
    t = (b - a) / np.linalg.norm(b - a)
    return (ends_px - a) @ np.array([-t[1], t[0]])


def edge_points(angle, u0=160.0, v0=120.0):
    return np.array([[u0, v0], [u0 + 50.0 * np.cos(angle), v0 + 50.0 * np.sin(angle)]])


@pytest.mark.parametrize('angle', [0.0, 0.3, 1.2, 2.5, -1.9])
@pytest.mark.parametrize('gain', [1.0, 1.3])
def test_an_edge_is_measured_where_it_is(tracker, angle, gain):
    scene, on_edge = step_edge(160.0, 120.0, angle, 40.0, 140.0), edge_points(angle)
    for k in range(12):
        H = homography([0.001 * k, -0.002 * k, 0.006 * k], [0.012 * k, 0.009 * k, 0.004 * k])
        seen = see(tracker, view(scene, H, gain if k % 3 == 2 else 1.0, noise=2.0, seed=k))
    assert seen.ids.tolist() == [0]
    ends = pixels(seen.ends[0])
    assert np.abs(distance(ends, *move(H, on_edge))).max() < 0.15  # px, noise of 2 grey on a step of 100
    t = move(H, on_edge)[1] - move(H, on_edge)[0]
    assert (ends[1] - ends[0]) @ t > 0.0  # the order of the ends is that of the brighter side
    assert np.linalg.norm(ends[1] - ends[0]) > 150.0
    assert np.all(seen.sigma > 0.2 / FOCAL) and np.all(seen.sigma < 0.5 / FOCAL)


def test_all_edges_of_a_moving_scene_stay_on_the_plane(tracker):
    scene = mosaic()
    first = see(tracker, view(scene, np.eye(3)))
    for k in range(1, 11):
        H = homography([0.002 * k, -0.001 * k, 0.004 * k], [0.01 * k, -0.004 * k, 0.008 * k])
        last = see(tracker, view(scene, H, noise=1.5, seed=k))
    kept, at, now = np.intersect1d(first.ids, last.ids, return_indices=True)
    error = [np.abs(distance(pixels(last.ends[j]), *move(H, pixels(first.ends[i])))).max()
             for i, j in zip(at, now, strict=True)]
    assert len(first.ids) > 15 and len(kept) > 0.7 * len(first.ids)
    assert np.median(error) < 0.25 and np.percentile(error, 90) < 1.0  # px, ends extrapolate the first line


def test_a_fast_turn_is_predicted_by_the_gyro(tracker):
    scene, on_edge, w = step_edge(160.0, 120.0, 0.4), edge_points(0.4), np.array([0.15, -0.1, 0.2])
    see(tracker, view(scene, np.eye(3)))
    H = homography(w, [0.0, 0.0, 0.0])
    seen = see(tracker, view(scene, H), so3_exp(w).T)
    assert 0 in seen.ids
    assert np.abs(distance(pixels(seen.ends[seen.ids == 0][0]), *move(H, on_edge))).max() < 0.15


def test_corners_nearby_tell_how_a_new_segment_moves(tracker):
    scene = step_edge(160.0, 120.0, 0.0)
    see(tracker, view(scene, np.eye(3)))
    H = homography([0.0, 0.0, 0.0], [0.0, -0.25, 0.0])  # 25 px, beyond the search
    tracker.take(view(scene, H))
    tracker.track(np.eye(3), np.zeros((4, 2)), np.tile([0.0, 0.125], (4, 1)))
    assert tracker.observations().ids.tolist() == [0]
    np.testing.assert_allclose(pixels(tracker.observations().ends[0])[:, 1], 145.0, atol=0.15)


def test_parallel_neighbours_are_not_confused(tracker):
    scene = np.full(mosaic().shape, 60, np.uint8)
    for k in range(4):
        cv2.rectangle(scene, (MARGIN, MARGIN + 60 + 14 * k), (MARGIN + 320, MARGIN + 66 + 14 * k), 120 + 30 * k, -1)
    scene = cv2.GaussianBlur(scene, (0, 0), 1.0)
    first = see(tracker, view(scene, np.eye(3)))
    for k in range(1, 13):
        H = homography([0.0, 0.0, 0.0], [0.0, -0.02 * k, 0.0])  # 2 px per image
        last = see(tracker, view(scene, H, noise=1.5, seed=k))
    kept, at, now = np.intersect1d(first.ids, last.ids, return_indices=True)
    assert len(kept) >= 6
    moved = pixels(last.ends[now]).mean(axis=1)[:, 1] - pixels(first.ends[at]).mean(axis=1)[:, 1]
    np.testing.assert_allclose(moved, 24.0, atol=0.3)


def test_no_two_ids_on_one_edge(tracker):
    for k in range(13):
        seen = see(tracker, view(mosaic(), homography([0.0, 0.0, 0.003 * k], [0.01 * k, 0.0, 0.0]), noise=1.0, seed=k))
    ends = pixels(seen.ends)
    for i in range(len(ends)):
        t = ends[i, 1] - ends[i, 0]
        along = (ends - ends[i, 0]) @ t / (t @ t)
        beside = np.abs(distance(ends, *ends[i])).max(axis=1) < 1.0
        overlap = np.minimum(along[:, 1], 1.0) - np.maximum(along[:, 0], 0.0)
        assert np.flatnonzero(beside & (overlap > 0.5)).tolist() == [i]


def test_ids_end_and_never_come_again(tracker):
    image = view(mosaic(), np.eye(3))
    first = see(tracker, image)
    tracker.forget(first.ids[::2])
    assert tracker.observations().ids.tolist() == first.ids[1::2].tolist()
    tracker.reset()
    assert see(tracker, image).ids.min() > first.ids.max()


@pytest.mark.parametrize('grey', [0, 128, 255])
def test_tracks_end_on_an_empty_image(tracker, grey):
    see(tracker, view(mosaic(), np.eye(3)))
    seen = see(tracker, np.full((240, 320), grey, np.uint8))
    assert seen.ends.shape == (0, 2, 2) and seen.sigma.shape == (0, 2)


def test_none_are_wanted():
    assert not len(see(LineTracker(pinhole(), Lines(max_count=0)), view(mosaic(), np.eye(3))).ids)


@pytest.mark.parametrize('pace', [1.0, 3.0])
def test_motion_goes_on_as_long_as_the_image_takes(tracker, pace):
    scene = step_edge(160.0, 120.0, 0.0)
    for k in range(3):
        see(tracker, view(scene, homography([0.0, 0.0, 0.0], [0.0, -0.06 * k, 0.0])), np.eye(3))  # 6 px per image
    tracker.take(view(scene, homography([0.0, 0.0, 0.0], [0.0, -0.06 * (2.0 + pace), 0.0])))
    tracker.track(np.eye(3), *NO_CORNERS, pace)
    assert tracker.observations().ids.tolist() == [0]
    np.testing.assert_allclose(pixels(tracker.observations().ends[0])[:, 1], 132.0 + 6.0 * pace, atol=0.15)


@pytest.mark.parametrize('px', [2, 3, 4])
def test_the_sides_of_a_thin_stripe_are_reported_where_they_are(px):
    tracker = LineTracker(pinhole(), Lines(max_count=60, min_length_px=30.0))
    scene = cv2.GaussianBlur(bar(px), (0, 0), 1.0)
    edges = [159.5, 159.5 + px]  # between pixels
    for _ in range(2):
        seen = see(tracker, view(scene, np.eye(3)))
    assert len(seen.ids) == 2
    looks, found = (np.sort(ends[:, :, 0].mean(axis=1)) for ends in (tracker.segments.ends, pixels(seen.ends)))
    off = np.abs(found - edges).max()
    assert off < max(0.7 * np.abs(looks - edges).max(), 0.1)
    assert off < 1.5 * FOCAL * seen.sigma.min()


def test_a_wide_stripe_stays_where_it_looks_to_be_and_is_known_better():
    thin, wide = (LineTracker(pinhole(), Lines(max_count=60, min_length_px=30.0)) for _ in range(2))
    narrow, seen = (see(tracker, view(cv2.GaussianBlur(bar(px), (0, 0), 1.0), np.eye(3)))
                    for tracker, px in ((thin, 3), (wide, 12)))
    assert len(narrow.ids) == len(seen.ids) == 2
    np.testing.assert_allclose(pixels(seen.ends), wide.segments.ends, atol=1e-9)
    assert narrow.sigma.min() > 1.2 * seen.sigma.max()


def bar(width):
    """Scene of a dark upright bar, so many px wide, across the first view."""
    scene = np.full(mosaic().shape, 180, np.uint8)
    scene[:, MARGIN + 160:MARGIN + 160 + width] = 60
    return scene
