from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from plane_scene import homography, mosaic, pinhole, view

from line_slam_ros.config import Config, Lines, Points
from line_slam_ros.frontend.front_end import FrontEnd
from line_slam_ros.geometry.camera import Camera
from line_slam_ros.geometry.lie import matrix_from_quaternion
from line_slam_ros.types import Calibration, Frame

SHARED = Path(__file__).parents[1].parent / 'shared' / 'data'
CONFIG = Config(points=Points(max_count=80, min_distance_px=12.0))


def run(front_end, count=6, step=1):
    scene = mosaic()
    images = [view(scene, homography([0.0, 0.001 * k, 0.003 * k], [0.01 * k, 0.0, 0.0]), noise=1.0, seed=k)
              for k in range(0, count * step, step)]
    return [front_end.track(Frame(50_000_000 * k, image), None) for k, image in enumerate(images)]


def test_points_and_lines_live_on():
    seen = run(FrontEnd(pinhole(), CONFIG))
    assert [o.t_ns for o in seen] == [50_000_000 * k for k in range(6)]
    assert np.isin(seen[0].points.ids, seen[-1].points.ids).mean() > 0.5
    assert np.isin(seen[0].lines.ids, seen[-1].lines.ids).mean() > 0.5


def test_lost_frames_do_not_lose_the_tracks():
    seen = run(FrontEnd(pinhole(), CONFIG), count=3, step=3)
    assert np.isin(seen[0].points.ids, seen[-1].points.ids).mean() > 0.4
    assert np.isin(seen[0].lines.ids, seen[-1].lines.ids).mean() > 0.4


def test_same_images_same_bytes():
    for a, b in zip(*(run(FrontEnd(pinhole(), CONFIG)) for _ in range(2)), strict=True):
        for x, y in ((a.points.ids, b.points.ids), (a.points.uv, b.points.uv), (a.points.x, b.points.x),
                     (a.lines.ids, b.lines.ids), (a.lines.ends, b.lines.ends), (a.lines.sigma, b.lines.sigma)):
            assert x.tobytes() == y.tobytes()


@pytest.mark.parametrize(('points', 'lines'), [(True, False), (False, True), (False, False)])
def test_switches(points, lines):
    seen = run(FrontEnd(pinhole(), replace(CONFIG, use_points=points, use_lines=lines)), count=2)[-1]
    assert (len(seen.points.ids) > 0) is points
    assert (len(seen.lines.ids) > 0) is lines


def test_another_image_size_is_refused_with_both_sizes():
    front_end = FrontEnd(pinhole(), CONFIG)
    with pytest.raises(ValueError, match='640x480.*320x240'):
        front_end.track(Frame(0, np.zeros((480, 640), np.uint8)), None)


def test_empty_images_between_good_ones():
    front_end, good = FrontEnd(pinhole(), CONFIG), view(mosaic(), np.eye(3))
    before = front_end.track(Frame(0, good), None)
    for grey in (0, 255):
        empty = front_end.track(Frame(1, np.full_like(good, grey)), np.eye(3))
        assert not len(empty.points.ids) and not len(empty.lines.ids)
    for k in range(6):
        after = front_end.track(Frame(2 + k, good), np.eye(3))
    assert len(after.points.ids) == len(before.points.ids) and len(after.lines.ids) > 0.8 * len(before.lines.ids)
    assert after.points.ids.min() > before.points.ids.max() and after.lines.ids.min() > before.lines.ids.max()


def test_read_only_images_that_are_reused():
    buffer = np.empty((240, 320), np.uint8)
    image = buffer.view()
    image.flags.writeable = False
    reused, own = FrontEnd(pinhole(), CONFIG), FrontEnd(pinhole(), CONFIG)
    for k in range(3):
        buffer[:] = view(mosaic(), homography([0.0, 0.001 * k, 0.003 * k], [0.01 * k, 0.0, 0.0]))
        seen, expected = reused.track(Frame(k, image), None), own.track(Frame(k, buffer.copy()), None)
        assert seen.points.uv.tobytes() == expected.points.uv.tobytes()
        assert seen.lines.ends.tobytes() == expected.lines.ends.tobytes()


def test_forget_and_reset():
    front_end = FrontEnd(pinhole(), CONFIG)
    seen = run(front_end, count=2)[-1]
    front_end.forget(seen.points.ids[:5], seen.lines.ids[:5])
    after = run(front_end, count=1)[0]
    assert not np.isin(seen.points.ids[:5], after.points.ids).any()
    assert not np.isin(seen.lines.ids[:5], after.lines.ids).any()
    front_end.reset()
    fresh = run(front_end, count=1)[0]
    assert fresh.points.ids.min() > after.points.ids.max() and fresh.lines.ids.min() > after.lines.ids.max()


def test_observations_do_not_change_afterwards():
    front_end = FrontEnd(pinhole(), CONFIG)
    seen = run(front_end, count=1)[0]
    kept = seen.points.uv.copy(), seen.lines.ends.copy()
    run(front_end, count=3)
    assert np.array_equal(kept[0], seen.points.uv) and np.array_equal(kept[1], seen.lines.ends)


def test_drawing_and_timings():
    front_end = FrontEnd(pinhole(), CONFIG)
    run(front_end, count=2)
    canvas = front_end.draw()
    assert canvas.shape == (240, 320, 3) and canvas.dtype == np.uint8
    assert np.any(canvas[..., 0] != canvas[..., 1])
    assert set(front_end.timings) == {'detect', 'track'}


def test_detection_can_be_skipped_while_enough_is_tracked():
    scene = mosaic()
    images = [view(scene, homography([0.0, 0.001 * k, 0.003 * k], [0.01 * k, 0.0, 0.0])) for k in range(4)]
    front_end = FrontEnd(pinhole(), replace(CONFIG, lines=Lines(max_count=20)))
    first = front_end.track(Frame(0, images[0]), None, skip_detection=True)
    assert len(first.points.ids) and len(first.lines.ids)  # there were none: that cannot wait
    front_end.forget(first.points.ids[::4], first.lines.ids[::4])
    skipped = front_end.track(Frame(1, images[1]), None, skip_detection=True)
    assert len(skipped.points.ids) and np.isin(skipped.points.ids, first.points.ids).all()
    assert len(skipped.lines.ids) and np.isin(skipped.lines.ids, first.lines.ids).all()
    for k in (2, 3):
        later = front_end.track(Frame(k, images[k]), None)
    assert later.points.ids.max() > first.points.ids.max()


def test_new_points_and_lines_come_with_different_images():
    scene, front_end = mosaic(), FrontEnd(pinhole(), CONFIG)
    seen = [front_end.track(Frame(0, view(scene, np.eye(3))), None)]
    for k in range(1, 12):
        front_end.forget(seen[-1].points.ids[:10], seen[-1].lines.ids[:1])
        seen.append(front_end.track(Frame(k, view(scene, np.eye(3))), np.eye(3)))
    points, lines = ([getattr(b, what).ids.max() > getattr(a, what).ids.max() for a, b in pairwise(seen)]
                     for what in ('points', 'lines'))
    assert sum(points) > 1 and sum(lines) > 1 and not np.any(np.logical_and(points, lines))


def excerpt(folder, first, count):
    """Camera, images and true T_WC of a shared recording."""
    from rosbags.highlevel import AnyReader
    values = yaml.safe_load((folder / 'calibration.yaml').read_text())['cam0']
    T_BC = np.linalg.inv(np.array(values['T_cam_imu']))
    camera = Camera(Calibration('radtan', *values['resolution'], tuple(values['intrinsics']),
                                tuple(values['distortion_coeffs']), T_BC))
    truth, images, poses = np.loadtxt(folder / 'groundtruth.tum'), [], []
    with AnyReader([folder / 'bag']) as reader:
        wanted = [c for c in reader.connections if c.topic == '/cam0/image_raw/compressed']
        for k, (connection, _, raw) in enumerate(reader.messages(wanted)):
            if first <= k < first + count:
                message = reader.deserialize(raw, connection.msgtype)
                stamp = message.header.stamp
                row = truth[np.argmin(np.abs(truth[:, 0] - stamp.sec - 1e-9 * stamp.nanosec))]
                T_WB = np.eye(4)
                T_WB[:3, :3], T_WB[:3, 3] = matrix_from_quaternion(row[4:8]), row[1:4]
                images.append(cv2.imdecode(message.data, cv2.IMREAD_GRAYSCALE))
                poses.append(T_WB @ T_BC)
            elif k >= first + count:
                break
    return camera, images, poses


def test_real_tracks_obey_the_true_epipolar_geometry():
    folder = SHARED / 'office_gentle'
    if not folder.exists():
        pytest.skip(f'needs the recording {folder}')
    camera, images, poses = excerpt(folder, 200, 11)
    front_end, seen = FrontEnd(camera, Config()), []
    for k, image in enumerate(images):
        R = poses[k][:3, :3].T @ poses[k - 1][:3, :3] if k else None
        seen.append(front_end.track(Frame(k, image), R))
    _, then, now = np.intersect1d(seen[0].points.ids, seen[-1].points.ids, return_indices=True)
    T = np.linalg.inv(poses[-1]) @ poses[0]
    rays = np.column_stack([seen[0].points.x[then], np.ones(len(then))]) @ T[:3, :3].T
    n = np.cross(T[:3, 3], rays)
    x = seen[-1].points.x[now]
    error = np.abs(n[:, 0] * x[:, 0] + n[:, 1] * x[:, 1] + n[:, 2]) / np.hypot(n[:, 0], n[:, 1]) * camera.focal
    assert len(now) > 100 and np.median(error) < 0.25 and np.percentile(error, 90) < 1.0  # px over 0.5 s
    assert np.isin(seen[0].lines.ids, seen[-1].lines.ids).mean() > 0.6 and len(seen[-1].lines.ids) > 60
