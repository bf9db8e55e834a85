"""The simulated corridor: the walk obeys the laws of motion, images show edges where they are, a replay follows it."""
from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from bag_samples import line_slam

from line_slam_ros.cli.simulating import record_corridor
from line_slam_ros.evaluation import read_trajectory, score_trajectory
from line_slam_ros.geometry.camera import Camera
from line_slam_ros.geometry.lie import rigid, rigid_inverse, so3_log, transform_points
from line_slam_ros.simulation.corridor import HEIGHT, Corridor
from line_slam_ros.simulation.features import GRAVITY_W
from line_slam_ros.simulation.rendering import CAMERA, EXPOSURE, TARGET, Renderer
from line_slam_ros.simulation.walk import Walk
from line_slam_ros.types import Calibration

SMALL = replace(CAMERA, width=376, height=240, intrinsics=(229.0, 228.0, 183.0, 124.0))


@pytest.fixture(scope='module')
def corridor():
    return Corridor.random(1)


def renderer(corridor: Corridor, light: float = 1.0, calibration: Calibration = SMALL) -> Renderer:
    return Renderer(corridor, calibration, Walk.along(corridor.route, 1, 1.0), light, seed=1)


@pytest.mark.parametrize('seed', range(6))
def test_the_walk_stays_between_the_walls_and_ends_at_rest(seed):
    corridor = Corridor.random(seed)
    walk = Walk.along(corridor.route, seed, 2.0)
    _, p, v, *_ = walk.at(np.linspace(0.0, walk.seconds, 500))
    outline = corridor.outline.astype(np.float32)
    inside = [cv2.pointPolygonTest(outline, (float(x), float(y)), True) for x, y in p[:, :2]]
    assert min(inside) > 0.3 and 0.0 < p[:, 2].min() and p[:, 2].max() < HEIGHT
    assert 30.0 <= corridor.length <= 60.0
    assert np.abs(v[[0, -1]]).max() < 1e-12 and np.linalg.norm(p[-1, :2] - corridor.route[-1]) < 0.2
    assert 1.7 < np.linalg.norm(v, axis=1).max() < 2.6


def test_inertial_data_is_the_derivative_of_the_walk(corridor):
    walk, h = Walk.along(corridor.route, 3, 1.5), 1e-4
    t = np.linspace(0.5, walk.seconds - 0.5, 200)
    R, _, v, omega, force = walk.at(t)
    (R1, p1, v1, *_), (R0, p0, v0, *_) = walk.at(t + h), walk.at(t - h)
    np.testing.assert_allclose((p1 - p0) / (2 * h), v, atol=1e-6)
    np.testing.assert_allclose(np.einsum('nji,nj->ni', R, (v1 - v0) / (2 * h) - GRAVITY_W), force, atol=1e-5)
    turned = np.array([so3_log(a.T @ b) for a, b in zip(R0, R1, strict=True)]) / (2 * h)
    np.testing.assert_allclose(turned, omega, atol=1e-6)
    assert np.abs(omega[:, 2]).max() > 0.5  # it does turn


def test_it_rests_for_a_second_and_then_looks_where_it_goes(corridor):
    walk = Walk.along(corridor.route, 2, 1.0)
    _, p, v, omega, _ = walk.at(np.linspace(0.0, 1.0, 50))
    assert np.ptp(p, axis=0).max() < 1e-12 and np.abs(omega).max() < 1e-12
    R, _, v, *_ = walk.at(np.linspace(4.0, walk.seconds - 3.0, 200))
    ahead = (R[:, :, 0] * v).sum(axis=1) / np.linalg.norm(v, axis=1)
    assert np.median(ahead) > 0.98 and ahead.min() > 0.7


def test_walls_close_up_and_stand_half_a_width_from_the_route(corridor):
    steps = np.diff(np.concatenate([corridor.outline, corridor.outline[:1]]), axis=0)
    assert all(abs(a @ b) < 1e-9 for a, b in pairwise(steps))  # right angles
    x, y = corridor.outline.T
    assert x @ np.roll(y, -1) > y @ np.roll(x, -1)  # counter-clockwise
    assert cv2.pointPolygonTest(corridor.outline.astype(np.float32), (5.0, 0.0), True) == pytest.approx(1.1, abs=1e-5)


def test_true_edges_lie_on_the_edges_of_the_image(corridor):
    """Half way across the step of brightness beside every edge near the camera that is not beside another."""
    camera, walk = Camera(CAMERA), Walk.along(corridor.route, 1, 1.0)
    eye = renderer(corridor, calibration=CAMERA)
    image = np.mean([eye.image(0.5).astype(np.float32) for _ in range(12)][4:], axis=0)
    R, p, *_ = walk.at(0.5)
    T_CW = rigid_inverse(rigid(R[0], p[0]) @ CAMERA.T_BC)
    offsets = []
    for begin, end in corridor.edges():
        points = transform_points(T_CW, begin + np.linspace(0.05, 0.95, 12)[:, None] * (end - begin))
        points = points[(points[:, 2] > 0.5) & (points[:, 2] < 7.0)]
        uv = camera.project(points[:, :2] / points[:, 2:])
        for a, b in pairwise(uv):
            offsets += _step(image, a, b)
    assert len(offsets) > 50
    assert abs(np.median(offsets)) < 0.05 and np.percentile(np.abs(offsets), 75) < 0.15


def _step(image: np.ndarray, a: np.ndarray, b: np.ndarray) -> list[float]:
    """Offset, px, of a lone step of brightness across ab at its middle; empty without one."""
    middle, across = 0.5 * (a + b), np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
    if not (np.isfinite(middle).all() and (middle > 8).all() and (middle < np.array(image.shape[::-1]) - 8).all()):
        return []
    at = np.linspace(-3.0, 3.0, 25)
    places = (middle + at[:, None] * across).astype(np.float32)
    profile = cv2.remap(image, places[None], None, cv2.INTER_LINEAR)[0]
    low, high = profile[:6].mean(), profile[-6:].mean()
    flat = max(np.ptp(profile[:6]), np.ptp(profile[-6:])) < 0.2 * abs(high - low)
    if abs(high - low) < 8.0 or not flat or profile.max() > 240.0:
        return []
    share = (profile - low) / (high - low)
    return [float(np.interp(0.5, np.maximum.accumulate(share), at))] if (np.diff(share) > -0.1).all() else []


def test_exposure_finds_the_light_and_darkness_costs_noise_and_time(corridor):
    spread = {}
    for light in (1.0, 0.05):
        eye = renderer(corridor, light)
        images = [eye.image(0.5).astype(float) for _ in range(40)]
        assert images[-1].mean() / 255 == pytest.approx(TARGET, abs=0.03)
        spread[light] = np.std(images[-1] - images[-2])
        assert (eye._sensor.seconds == EXPOSURE[1]) == (light < 0.1)
    assert spread[0.05] > 1.7 * spread[1.0] > 1.7


def test_a_long_exposure_in_a_turn_blurs(corridor):
    walk = Walk.along(corridor.route, 1, 1.0)
    t = np.linspace(0.0, walk.seconds, 500)
    fastest = t[np.argmax(np.linalg.norm(walk.at(t)[3], axis=1))]

    def sharpness(light: float) -> float:
        eye = renderer(corridor, light)
        mean = np.mean([eye.image(fastest).astype(np.float32) for _ in range(30)][20:], axis=0)
        return float(np.percentile(np.abs(np.diff(mean, axis=1)), 99.5))

    assert sharpness(0.05) < 0.75 * sharpness(5.0)


def test_the_same_settings_give_the_same_bytes(tmp_path):
    for name, seed in (('a', 3), ('b', 3), ('c', 4)):
        record_corridor(tmp_path / name, seed, seconds=0.3, calibration=SMALL)
    a, b, c = ({path.name: path.read_bytes() for path in (tmp_path / name).rglob('*.*')} for name in 'abc')
    assert a == b and sorted(a) == ['bag.mcap', 'calibration.yaml', 'groundtruth.tum', 'gt_lines.csv', 'metadata.yaml']
    assert {name for name in a if a[name] != c[name]} == {'bag.mcap', 'gt_lines.csv'}  # both still rest


def test_a_replay_starts_and_follows_the_walk(tmp_path):
    record_corridor(tmp_path / 'made', 1, 1.0, seconds=7.0, calibration=SMALL)
    code, _, err = line_slam('replay', tmp_path / 'made' / 'bag', '--calibration', tmp_path / 'made/calibration.yaml',
                             '--output', tmp_path / 'out', '--no-figure')
    assert code == 0, err
    score, _ = score_trajectory(read_trajectory(tmp_path / 'out' / 'trajectory.tum'),
                                read_trajectory(tmp_path / 'made' / 'groundtruth.tum'))
    assert score.matched > 100 and score.length_m > 2.0 and score.ate_rmse_m < 0.05 * score.length_m


@pytest.mark.parametrize('options, complaint', [
    (['--seed', '-1'], 'seed must be 0 or more, got -1'),
    (['--speed', '0'], 'speed must lie from 0.05 to 20 m/s, got 0'),
    (['--sway', '6'], 'sway must lie from 0 to 5, got 6'),
    (['--seconds', '0'], 'seconds must be at least 0.1, got 0'),
    (['--light', '0'], 'light must lie from 0.0001 to 10000, got 0'),
    (['--texture', '-1'], 'texture must lie from 0 to 100, got -1')])
def test_nonsense_is_one_line_and_writes_nothing(tmp_path: Path, options, complaint):
    code, out, err = line_slam('simulate', 'corridor', tmp_path / 'made', *options)
    assert (code, out) == (2, '') and err == f'line_slam simulate: {complaint}\n'
    assert not (tmp_path / 'made').exists()


def test_a_bag_in_the_way_is_left_alone(tmp_path):
    (tmp_path / 'bag').mkdir()
    code, _, err = line_slam('simulate', 'corridor', tmp_path, '--seconds', 1)
    assert code == 2 and f'{tmp_path / "bag"} exists already' in err
