import numpy as np
import pytest
from plane_scene import homography, mosaic, move, pinhole, view

from line_slam_ros.config import Points
from line_slam_ros.frontend.point_tracker import PointTracker
from line_slam_ros.geometry.lie import so3_exp


@pytest.fixture
def tracker():
    return PointTracker(pinhole(), Points(max_count=80, min_distance_px=12.0))


def start(tracker, scene):
    tracker.track(view(scene, np.eye(3)), None)
    tracker.detect()
    return tracker.observations()


@pytest.mark.parametrize('gain', [1.0, 0.7])
def test_corners_follow_the_plane_and_do_not_drift(tracker, gain):
    scene = mosaic()
    first = start(tracker, scene)
    for k in range(1, 21):
        H = homography([0.002 * k, -0.001 * k, 0.004 * k], [0.01 * k, -0.004 * k, 0.008 * k])
        tracker.track(view(scene, H, gain if k % 2 else 1.0, noise=1.5, seed=k), None)
    last = tracker.observations()
    kept = np.searchsorted(first.ids, last.ids)
    error = np.linalg.norm(last.uv - move(H, first.uv[kept]), axis=1)
    assert len(kept) > 0.5 * len(first.ids)
    assert np.median(error) < 0.15 and np.percentile(error, 90) < 0.5  # px, noise of 1.5 grey


@pytest.mark.parametrize('w', [[0.0, 0.15, 0.08], [0.05, 0.0, 0.4], [0.0, 0.05, -0.8]])
def test_the_gyro_carries_over_a_fast_turn(tracker, w):
    scene = mosaic()
    first = start(tracker, scene)
    w = np.array(w)
    H = homography(w, [0.0, 0.0, 0.0])
    tracker.track(view(scene, H), so3_exp(w).T)
    last = tracker.observations()
    error = np.linalg.norm(last.uv - move(H, first.uv[np.searchsorted(first.ids, last.ids)]), axis=1)
    assert len(error) > 0.4 * len(first.ids) and np.median(error) < 0.15


def test_nothing_is_lost_at_a_standstill(tracker):
    scene = mosaic()
    first = start(tracker, scene)
    for k in range(15):
        tracker.track(view(scene, np.eye(3), noise=1.0, seed=k), np.eye(3))
    last = tracker.observations()
    assert len(last.ids) > 0.95 * len(first.ids)
    assert np.median(np.linalg.norm(last.uv - first.uv[np.searchsorted(first.ids, last.ids)], axis=1)) < 0.1


def test_corners_are_apart_spread_and_normalised(tracker):
    seen = start(tracker, mosaic())
    distance = np.linalg.norm(seen.uv[:, None] - seen.uv, axis=-1) + 1e3 * np.eye(len(seen.ids))
    assert 40 <= len(seen.ids) <= 80
    assert distance.min() > 8.0  # 12 px before they settle on the corner
    assert len(np.unique(seen.uv // 80.0, axis=0)) == 12  # every 80 px cell of the 320x240 image has one
    np.testing.assert_allclose(seen.x, (seen.uv - [160.0, 120.0]) / 200.0, atol=1e-9)


def test_ids_end_and_never_come_again(tracker):
    scene = mosaic()
    first = start(tracker, scene)
    tracker.forget(first.ids[:20])
    tracker.detect()
    second = tracker.observations()
    assert not np.isin(first.ids[:20], second.ids).any()
    tracker.reset()
    assert not len(tracker.observations().ids)
    third = start(tracker, scene)
    assert third.ids.min() > second.ids.max()


def test_a_moving_thing_is_left_out(tracker):
    scene = mosaic()
    first = start(tracker, scene)
    H = homography([0.0, 0.0, 0.0], [0.05, 0.0, 0.0])
    image = view(scene, H)
    sunk = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 6.0], [0.0, 0.0, 1.0]])
    image[60:140, 100:200] = view(scene, sunk @ H)[60:140, 100:200]
    tracker.track(image, np.eye(3))
    last = tracker.observations()
    error = np.linalg.norm(last.uv - move(H, first.uv[np.searchsorted(first.ids, last.ids)]), axis=1)
    assert len(error) > 30 and np.mean(error > 2.0) < 0.05


@pytest.mark.parametrize('grey', [0, 128, 255])
def test_images_without_texture_give_nothing(tracker, grey):
    for _ in range(3):
        tracker.track(np.full((240, 320), grey, np.uint8), np.eye(3))
        tracker.detect()
    assert not len(tracker.observations().ids)


def test_tracks_end_when_the_picture_changes_altogether(tracker):
    start(tracker, mosaic(1))
    tracker.track(view(mosaic(2), np.eye(3)), np.eye(3))
    assert len(tracker.observations().ids) < 10


def test_none_are_wanted():
    tracker = PointTracker(pinhole(), Points(max_count=0))
    assert not len(start(tracker, mosaic()).ids)
