"""Mapping with known poses: simulated segments in, 3D lines out."""
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from line_scene import FOCAL, scene, walk

from line_slam_ros.config import Config
from line_slam_ros.estimation.line_mapper import LineEstimator, LineMapper
from line_slam_ros.estimation.line_start import start_from_planes
from line_slam_ros.geometry.lie import matrix_from_quaternion, rigid, so3_exp, transform_points
from line_slam_ros.mapping.line_map import LineMap
from line_slam_ros.types import (
    LINE_FORMS,
    Calibration,
    Frame,
    LineObservations,
    Observations,
    PointObservations,
    Status,
)

SIGMA = 1.0 / FOCAL
T_BC = rigid(so3_exp([0.2, -0.4, 1.5]), [0.05, -0.02, 0.03])
EVERY = dict.fromkeys(LINE_FORMS, (0.02, 0.08)) | {'host': (0.06, 0.3)}  # form -> largest mean, max error across, m


@pytest.fixture
def rng():
    return np.random.default_rng(21)


def config_of(form='orthonormal', **mapping):
    config = Config()
    return replace(config, estimator=replace(config.estimator, line_representation=form),
                   mapping=replace(config.mapping, **mapping))


def observed(lines, T_WC, rng, px=0.0, ids=None):
    p_C = (lines - T_WC[:3, 3]) @ T_WC[:3, :3]
    ends = p_C[..., :2] / p_C[..., 2:] + rng.normal(size=(len(lines), 2, 2)) * px / FOCAL
    ids = np.arange(len(lines)) if ids is None else ids
    return LineObservations(ids, ends, np.full((len(lines), 2), max(px, 0.1) * SIGMA))


def across(pluecker, points):
    return np.linalg.norm(np.cross(points, pluecker[..., 3:]) - pluecker[..., :3], axis=-1)


def mapped(config, frames, T_WC):
    estimator, line_map = LineEstimator(config), LineMap(config.mapping)
    for seen, pose in zip(frames, T_WC, strict=True):
        estimator.add(seen, pose)
        estimator.hand_over(line_map)
    return estimator, line_map


@pytest.mark.parametrize('form', EVERY)
def test_lines_are_found_from_noisy_segments(rng, form):
    lines, poses = scene(rng, 40), walk(40)
    _, line_map = mapped(config_of(form, max_sigma_m=1.0, merge_distance_m=0.0),
                         [observed(lines, T, rng, 1.0) for T in poses], poses)
    found = line_map.segments()
    assert len(found) >= 38
    error = across(found.pluecker[:, None], lines[found.ids])
    assert error.mean() < EVERY[form][0] and error.max() < EVERY[form][1]
    ends = np.linalg.norm(found.ends - lines[found.ids], axis=-1)
    swapped = np.linalg.norm(found.ends[:, ::-1] - lines[found.ids], axis=-1)
    assert np.minimum(ends.mean(axis=1), swapped.mean(axis=1)).mean() < 2 * EVERY[form][0]


def test_without_noise_the_lines_are_exact(rng):
    lines, poses = scene(rng, 10), walk(12)
    for form in EVERY:
        _, line_map = mapped(config_of(form), [observed(lines, T, rng) for T in poses], poses)
        found = line_map.segments()
        assert len(found) == 10
        np.testing.assert_allclose(across(found.pluecker[:, None], lines[found.ids]), 0, atol=1e-6)


def test_covariance_tells_the_error(rng):
    lines, poses = scene(rng, 60), walk(30)
    errors = []
    for _ in range(4):
        _, line_map = mapped(config_of(max_sigma_m=10.0, merge_distance_m=0.0),
                             [observed(lines, T, rng, 1.0) for T in poses], poses)
        found = line_map.segments()
        errors.append(across(found.pluecker[:, None], lines[found.ids]).max(axis=1) / found.sigma)
    ratio = np.sqrt(np.mean(np.concatenate(errors) ** 2))
    assert 0.6 < ratio < 1.4  # sigma is that of the worst direction, the error that of the worse end


@pytest.mark.row(32)
@pytest.mark.trap('one bad frame')
@pytest.mark.source_error('D2 updatelineplk break')
def test_one_bad_frame_moves_nothing(rng):
    lines, poses = scene(rng, 10), walk(20)
    frames = [observed(lines, T, rng) for T in poses]
    frames[7] = observed(lines[::-1], poses[7], rng)
    _, line_map = mapped(config_of(), frames, poses)
    found = line_map.segments()
    assert len(found) == 10 and across(found.pluecker[:, None], lines[found.ids]).max() < 1e-3


@pytest.mark.row(29)
@pytest.mark.trap('swapped end points')
@pytest.mark.source_error('D2 triangulate_line')
def test_swapped_ends_change_nothing(rng):
    lines, poses = scene(rng, 10), walk(12)
    frames = [observed(lines, T, rng) for T in poses]
    turned = [replace(f, ends=f.ends[:, ::-1].copy()) if k % 2 else f for k, f in enumerate(frames)]
    first, second = (mapped(config_of(), f, poses)[1].segments() for f in (frames, turned))
    assert len(first) == len(second) == 10
    for i in range(10):
        apart = np.linalg.norm(first.ends[i] - second.ends[i], axis=1).max()
        turned_apart = np.linalg.norm(first.ends[i] - second.ends[i, ::-1], axis=1).max()
        assert min(apart, turned_apart) < 1e-6


@pytest.mark.row(29)
@pytest.mark.trap('motion along the line')
@pytest.mark.trap('motion within the observation plane')
@pytest.mark.trap('pure rotation')
@pytest.mark.parametrize('name, direction, motion', [
    ('motion along the line', [1, 0, 0], [1, 0, 0]), ('motion towards the line', [1, 0, 0], [0, 0.0, 1]),
    ('pure rotation', [0, 1, 0], [0, 0, 0])])
def test_degenerate_motion_waits(rng, name, direction, motion):
    line = np.array([0.0, 0.0, 5.0]) + np.outer([-1, 1], direction)
    poses = rigid(so3_exp(0.01 * rng.normal(size=(12, 3))), np.linspace(0, 1, 12)[:, None] * motion)
    frames = [observed(line[None], T, rng, 0.3) for T in poses]
    estimator, line_map = mapped(config_of(), frames, poses)
    assert not estimator._table['started'].any() and len(line_map.segments()) == 0, name
    away = rigid(np.eye(3), np.array([[0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, 0.5, 0.0]]))
    for T in away:  # it is mapped as soon as the camera moves aside
        estimator.add(observed(line[None], T, rng, 0.3), T)
        estimator.hand_over(line_map)
    assert estimator._table['started'].all()
    assert across(line_map.segments().pluecker, line).max() < 0.03


@pytest.mark.row(33)
@pytest.mark.trap('points behind the camera')
def test_a_start_needs_most_feet_in_front(rng):
    lines, poses = scene(rng, 5), walk(10)
    ends = np.stack([observed(lines, T, rng).ends for T in poses], axis=1)
    all_poses = np.broadcast_to(poses[None, :, :3], (5, 10, 3, 4))
    sigma, count = np.full((5, 10, 2), 1e-3), np.full(5, 10)
    found, origin, holds = start_from_planes(all_poses, ends, sigma, count, 0.03)
    assert holds.all()
    np.testing.assert_allclose(across(found[:, None], lines - origin[:, None]), 0, atol=1e-9)
    mirrored = all_poses.copy()
    mirrored[..., :3] *= [-1, 1, -1]  # the cameras turn their backs: (x, y, z) -> (-x, y, -z) mirrors v
    assert not start_from_planes(mirrored, ends * [1, -1], sigma, count, 0.03)[2].any()


def test_lines_contradicted_by_most_views_are_forgotten(rng):
    lines, poses = scene(rng, 6), walk(24)
    config = config_of()
    estimator, line_map = LineEstimator(config), LineMap(config.mapping)
    wrong = []
    for T in poses:
        seen = observed(lines, T, rng, 0.3)
        seen.ends[2] += rng.normal(size=(2, 2)) * 0.1  # not a line of this world
        wrong.extend(estimator.add(seen, T))
        estimator.hand_over(line_map)
    assert set(wrong) == {2} and set(line_map.segments().ids) == {0, 1, 3, 4, 5}


def test_memory_is_bounded_and_lines_that_left_are_kept(rng):
    config = config_of(max_sigma_m=0.1)
    estimator, line_map = LineEstimator(config), LineMap(config.mapping)
    for k in range(30):
        lines = scene(rng, 8) + [8.0 * k, 0, 0]
        for T in walk(8):
            T = T.copy()
            T[0, 3] += 8.0 * k
            estimator.add(observed(lines, T, rng, 0.5, ids=np.arange(8) + 8 * k), T)
            estimator.hand_over(line_map)
    assert len(estimator._table) <= 8 * (1 + config.estimator.window // 8 + 1)
    assert len(line_map.segments()) > 150


@pytest.mark.parametrize('form, angle_deg, perpendicular_m', [('orthonormal', 0.98, 0.0477), ('host', 3.2, 0.15)])
def test_house_experiment_is_at_least_as_good_as_the_reference(form, angle_deg, perpendicular_m):
    """Views inside the image only, 4.5 px noise, seed 0; limits are the reference program's own errors (its host form,
    3.09 deg and 14.4 cm, with a little room: robust weights differ)."""
    folder = Path(__file__).parents[1].parent / 'shared' / 'data' / 'house_sim'
    if not folder.is_dir():
        pytest.skip(f'{folder} is missing: the house experiment of the shared data')
    poses = np.loadtxt(folder / 'cam_pose_tum.txt')
    T_WC = rigid(matrix_from_quaternion(poses[:, 4:]), poses[:, 1:4])
    lines = np.loadtxt(folder / 'house.txt').reshape(-1, 2, 3)
    rows = np.loadtxt(folder / 'fov' / 'obs_noise4.5_seed0.txt')
    estimator = LineEstimator(config_of(form))
    for frame in np.unique(rows[:, 0].astype(int)):
        seen = rows[rows[:, 0] == frame]
        estimator.add(LineObservations(seen[:, 1].astype(np.int64), seen[:, 2:].reshape(-1, 2, 2),
                                       np.full((len(seen), 2), 4.5 * SIGMA)), T_WC[frame])
    table = estimator._table
    assert len(table) == 80 and table['started'].all()
    pluecker, true = table['pluecker'], lines[table.ids]
    direction = (true[:, 1] - true[:, 0]) / np.linalg.norm(true[:, 1] - true[:, 0], axis=1, keepdims=True)
    sine = np.linalg.norm(np.cross(pluecker[:, 3:], direction), axis=1)
    assert np.degrees(np.arcsin(sine)).mean() < angle_deg
    assert across(pluecker[:, None], true).mean() < perpendicular_m


class SimulatedFrontEnd:
    """Sees the lines of a world from poses that it is told; the image's first pixel is the frame's number."""

    def __init__(self, lines, T_WC):
        self.lines, self.T_WC, self.forgotten, self.turns = lines, T_WC, [], []

    def track(self, frame, R_CnCp, skip_detection):
        self.turns.append(R_CnCp)
        seen = observed(self.lines, self.T_WC[frame.image[0, 0]], np.random.default_rng(frame.t_ns))
        return Observations(frame.t_ns, PointObservations(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2))),
                            seen)

    def forget(self, point_ids, line_ids):
        self.forgotten.extend(line_ids)

    def reset(self):
        self.turns.clear()


@pytest.fixture
def mapper(rng):
    calibration = Calibration('radtan', 752, 480, (FOCAL, FOCAL, 376.0, 240.0), (0.0, 0.0, 0.0, 0.0), T_BC)
    mapper = LineMapper(config_of(), calibration)
    mapper.front_end = SimulatedFrontEnd(scene(rng, 12), walk(60))
    return mapper


def feed(mapper, count=60, first=0):
    poses = mapper.front_end.T_WC @ np.linalg.inv(T_BC)
    return [mapper.process_with_pose(Frame(1000 + k, np.full((2, 2), k, np.uint8)), poses[k])
            for k in range(first, first + count)]


def test_the_mapper_maps_and_repeats_the_pose(mapper):
    assert mapper.status is Status.INITIALISING and mapper.waiting_for
    estimates = feed(mapper)
    lines, poses, turns = mapper.front_end.lines, mapper.front_end.T_WC, mapper.front_end.turns
    assert mapper.status is Status.TRACKING and not mapper.waiting_for
    np.testing.assert_allclose(estimates[9].T_WB @ T_BC, poses[9], atol=1e-12)
    assert 5 < sum(e.is_keyframe for e in estimates) < 60 and estimates[0].is_keyframe
    assert turns[0] is None
    ray_p, ray_n = (T[:3, :3].T @ [0.1, 0.2, 5.0] for T in (poses[4], poses[5]))
    np.testing.assert_allclose(turns[5] @ ray_p, ray_n, atol=1e-12)
    found = mapper.line_map.segments()
    assert sorted(found.ids) == list(range(12)) and len(mapper.active_lines()) == 12
    np.testing.assert_allclose(across(found.pluecker[:, None], lines[found.ids]), 0, atol=1e-5)
    assert mapper.points().shape == (0, 3) and 'track' in mapper.timings and 'total' in mapper.timings


def test_reset_starts_anew_and_takes_earlier_frames(mapper):
    feed(mapper)
    mapper.reset('time jumped back')
    assert mapper.resets == 1 and mapper.status is Status.INITIALISING and mapper.waiting_for == 'time jumped back'
    assert len(mapper.line_map.segments()) == len(mapper.active_lines()) == 0
    feed(mapper)
    assert len(mapper.line_map.segments()) == 12


def test_bad_frames_and_poses_are_refused(mapper):
    feed(mapper, 5)
    with pytest.raises(ValueError, match='not after'):
        feed(mapper, 1, 4)
    with pytest.raises(ValueError, match='not finite'):
        mapper.process_with_pose(Frame(5000, np.zeros((2, 2), np.uint8)), np.full((4, 4), np.nan))


def test_a_standing_camera_makes_no_keyframes(mapper):
    mapper.front_end.T_WC = np.repeat(mapper.front_end.T_WC[:1], 60, axis=0)
    assert sum(e.is_keyframe for e in feed(mapper)) == 1


def test_points_in_the_world_frame_are_those_of_the_simulation(rng):
    """The simulation's own observation model, against transform_points."""
    lines, T_WC = scene(rng, 3), walk(5)[3]
    seen = observed(lines, T_WC, rng)
    rays = np.concatenate([seen.ends, np.ones((3, 2, 1))], axis=-1)
    depth = ((lines - T_WC[:3, 3]) @ T_WC[:3, :3])[..., 2:]
    np.testing.assert_allclose(transform_points(T_WC, rays * depth), lines, atol=1e-12)
