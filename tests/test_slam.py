"""Slam as the shells see it, with a front end that hands out simulated observations instead of looking at images."""
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

from line_slam_ros.config import Config
from line_slam_ros.config import Estimator as EstimatorOptions
from line_slam_ros.config import Points as PointOptions
from line_slam_ros.simulation.features import Room, Sequence, Trajectory, calibration
from line_slam_ros.slam import Slam
from line_slam_ros.types import Frame, ImuBatch, PointObservations, Status

BLACK = np.zeros((480, 640), np.uint8)


class Told:
    """A front end that sees what it is told; forgotten ids do not come back."""

    def __init__(self):
        self.next, self.gone, self.turns = None, set(), []

    def track(self, frame, R_CnCp, skip_detection):
        self.turns.append(R_CnCp)
        points = self.next.points
        kept = ~np.isin(points.ids, list(self.gone))
        return replace(self.next, points=replace(points, ids=points.ids[kept], uv=points.uv[kept], x=points.x[kept]))

    def forget(self, point_ids, line_ids):
        self.gone.update(point_ids.tolist())

    def reset(self):
        self.gone.clear()


@pytest.fixture
def slam():
    made = Slam(Config(points=PointOptions(max_count=600)), calibration())
    made.front_end = Told()
    return made


def feed(slam, sequence, change=lambda t, observations, imu: (observations, imu)):
    """Runs a sequence through; returns (t s, estimate or None, status, waiting_for) of every frame."""
    out = []
    for observations, imu in sequence:
        observations, imu = change(observations.t_ns * 1e-9, observations, imu)
        slam.front_end.next = observations
        estimate = slam.process(Frame(observations.t_ns, BLACK), imu)
        out.append((observations.t_ns * 1e-9, estimate, slam.status, slam.waiting_for))
    return out


@pytest.fixture
def sequence():
    return Sequence(Trajectory.random(6), Room.random(6), calibration(), 8.0)


def test_nothing_is_estimated_until_initialised_and_it_says_what_it_waits_for(slam, sequence):
    out = feed(slam, sequence)
    started = next(k for k, (_, e, *_) in enumerate(out) if e is not None)
    assert out[started][0] <= 3.0
    assert all(e is None and status is Status.INITIALISING and waits for _, e, status, waits in out[:started])
    assert all(e is not None and status is Status.TRACKING and not waits for _, e, status, waits in out[started:])


def test_estimate_has_velocity_rate_biases_and_a_positive_covariance(slam, sequence):
    t, estimate, *_ = feed(slam, sequence)[-1]
    R, _, v, omega, _ = sequence.trajectory.at(np.array([t]))
    assert np.linalg.norm(estimate.v_W) == pytest.approx(np.linalg.norm(v[0]), abs=0.05)
    np.testing.assert_allclose(estimate.omega_B, omega[0], atol=0.02)
    np.testing.assert_allclose(estimate.gyro_bias, sequence.gyro_bias, atol=3e-3)
    np.testing.assert_allclose(estimate.T_WB[2, :3], R[0, 2], atol=0.01)  # roll and pitch are absolute
    assert np.linalg.eigvalsh(estimate.cov).min() > 0.0


def test_lines_reach_the_map_where_they_are(slam, sequence):
    feed(slam, sequence)
    mapped, truth = slam.line_map.segments(), sequence.room.lines
    assert len(mapped) >= 15
    n_est, n_true = mapped.ends[:, 1] - mapped.ends[:, 0], (truth[:, 1] - truth[:, 0])[mapped.ids]
    lengths = np.linalg.norm(n_est, axis=1), np.linalg.norm(n_true, axis=1)
    assert np.median(lengths[0] / lengths[1]) == pytest.approx(1.0, abs=0.05)
    vertical = np.abs(n_true[:, 2]) / lengths[1] > 0.99  # heading is free, but upright stays upright
    assert vertical.any()
    assert np.median(np.abs(n_est[vertical, 2]) / lengths[0][vertical]) > 0.999


def test_the_front_end_gets_the_rotation_that_the_gyro_measured(slam, sequence):
    feed(slam, sequence)
    R_BC = slam.calibration.T_BC[:3, :3]
    R = sequence.trajectory.at(np.array([7.90, 7.95]))[0]
    assert slam.front_end.turns[0] is None
    np.testing.assert_allclose(slam.front_end.turns[-1], (R[1] @ R_BC).T @ (R[0] @ R_BC), atol=2e-3)


def test_an_inertial_gap_is_lost_and_tracking_resumes_from_the_last_pose(slam, sequence):
    def gap(t, observations, imu):
        if 4.0 < t <= 4.5:
            kept = (imu.t_ns * 1e-9 < 4.0) | (imu.t_ns * 1e-9 > 4.45)
            imu = ImuBatch(imu.t_ns[kept], imu.gyro_B[kept], imu.accel_B[kept])
            if len(imu.t_ns) < 2:
                imu = ImuBatch(np.array([0, observations.t_ns]), np.zeros((2, 3)), np.zeros((2, 3)))
        return observations, imu

    out = feed(slam, sequence, gap)
    lost = [k for k, (*_, status, _) in enumerate(out) if status is Status.LOST]
    assert lost and 'no inertial data' in out[lost[0]][3] and slam.resets >= 1
    assert out[-1][2] is Status.TRACKING
    before = next(e for _, e, *_ in reversed(out[:lost[0]]) if e is not None)
    after = next(e for _, e, *_ in out[lost[-1] + 1:] if e is not None)
    assert np.linalg.norm(after.T_WB[:3, 3] - before.T_WB[:3, 3]) < 2.0


def test_reset_starts_anew_at_the_origin_with_an_empty_map(slam, sequence):
    feed(slam, sequence)
    slam.reset('time jumped back')
    assert (slam.status, slam.waiting_for, slam.resets) == (Status.INITIALISING, 'time jumped back', 1)
    assert len(slam.line_map.segments()) == 0
    out = feed(slam, sequence)
    first = next(e for _, e, *_ in out if e is not None)
    assert np.linalg.norm(first.T_WB[:3, 3]) < 2.0 and out[-1][2] is Status.TRACKING


def test_frames_must_be_newer_than_the_last(slam, sequence):
    feed(slam, replace(sequence, seconds=1.0))
    with pytest.raises(ValueError, match='between'):
        feed(slam, replace(sequence, seconds=0.2))


def test_an_image_that_comes_again_while_turning_is_refused_and_its_inertial_data_count(slam, sequence):
    found = {}
    for k, (observations, imu) in enumerate(sequence):
        image = BLACK.copy()
        image[0, 100 if 100 <= k < 103 else k] = 255
        slam.front_end.next = observations
        frame = Frame(observations.t_ns, image)
        if 100 < k < 103:
            with pytest.raises(ValueError, match='the last one again'):
                slam.process(frame, imu)
            continue
        with mock.patch.object(slam.estimator, 'step', wraps=slam.estimator.step) as step:
            found[k] = slam.process(frame, imu)
        if k == 103:
            t, gyro, _ = step.call_args.args[1]
            expected = sequence.trajectory.at(np.arange(100, 103.05, 0.1) / 20.0)[3] + sequence.gyro_bias
            assert len(t) == len(expected) == 31
            np.testing.assert_allclose(gyro, expected, atol=0.02)
    assert slam.resets == 0
    t = np.array([100, 103]) / 20.0
    true = np.diff(sequence.trajectory.at(t)[1], axis=0)
    moved = found[103].T_WB[:3, 3] - found[100].T_WB[:3, 3]
    assert np.linalg.norm(moved) == pytest.approx(np.linalg.norm(true), abs=0.005)


def test_a_camera_that_goes_on_showing_one_image_while_it_turns_is_lost(slam, sequence):
    for k, (observations, imu) in enumerate(sequence):
        image = BLACK.copy()
        image[0, min(k, 100)] = 255
        slam.front_end.next = observations
        if k <= 100:
            slam.process(Frame(observations.t_ns, image), imu)
        elif slam.status is Status.TRACKING and k < 120:
            with pytest.raises(ValueError, match='the last one again'):
                slam.process(Frame(observations.t_ns, image), imu)
        else:
            slam.process(Frame(observations.t_ns, image), imu)
            break
    assert k == 120 and slam.status is Status.LOST and 'the same image for 1.0 s' in slam.waiting_for


def test_same_input_gives_the_same_numbers(sequence):
    def poses():
        slam = Slam(Config(points=PointOptions(max_count=600)), calibration())
        slam.front_end = Told()
        return [e.T_WB for _, e, *_ in feed(slam, replace(sequence, seconds=4.0)) if e is not None]

    np.testing.assert_array_equal(poses(), poses())


def test_a_start_after_time_jumped_far_back_does_not_wait_for_the_old_time(slam, sequence):
    def later(t, observations, imu):
        hour = 3_600_000_000_000
        return replace(observations, t_ns=observations.t_ns + hour), replace(imu, t_ns=imu.t_ns + hour)

    feed_later = [later(o.t_ns * 1e-9, o, i) for o, i in replace(sequence, seconds=2.0)]
    for observations, imu in feed_later:
        slam.front_end.next = observations
        slam.process(Frame(observations.t_ns, BLACK), imu)
    slam.reset('time jumped back')
    out = feed(slam, sequence)
    assert next(t for t, e, *_ in out if e is not None) <= 3.0


def test_equations_without_a_solution_are_lost_and_started_again(slam, sequence, monkeypatch):
    step, calls = slam.estimator.step, []

    def once(*args):
        calls.append(args)
        if len(calls) == 20:
            raise np.linalg.LinAlgError('singular')
        return step(*args)

    monkeypatch.setattr(slam.estimator, 'step', once)
    out = feed(slam, sequence)
    lost = [waits for *_, status, waits in out if status is Status.LOST]
    assert lost and 'singular' in lost[0] and slam.resets == 1 and out[-1][2] is Status.TRACKING


X_UP = np.array([[0, 0, 1.0], [0, 1.0, 0], [-1.0, 0, 0]])


@pytest.mark.parametrize('mounting', [np.eye(3), X_UP], ids=['z up', 'x up'])
def test_after_a_loss_position_and_heading_go_on(mounting):
    T = np.eye(4)
    T[:3, :3] = mounting
    base = Sequence(Trajectory.random(7, rest=60.0), Room.random(7), calibration(), 8.0)
    options = Config(points=PointOptions(max_count=600), estimator=EstimatorOptions(max_blind_m=0.02))
    slam = Slam(options, replace(base.calibration, T_BC=T @ base.calibration.T_BC))
    slam.front_end = Told()

    def dark(t, observations, imu):
        turned = ImuBatch(imu.t_ns, imu.gyro_B @ mounting.T, imu.accel_B @ mounting.T)
        none = replace(observations.points, ids=np.empty(0, np.int64), uv=np.empty((0, 2)), x=np.empty((0, 2)))
        lines = replace(observations.lines, ids=np.empty(0, np.int64), ends=np.empty((0, 2, 2)), sigma=np.empty((0, 2)))
        return (replace(observations, points=none, lines=lines) if 2.0 < t < 5.5 else observations), turned

    out = feed(slam, base, dark)
    assert any(status is Status.LOST for *_, status, _ in out) and out[-1][2] is Status.TRACKING
    before = next(e for t, e, *_ in reversed(out) if e is not None and t < 2.0)
    after = out[-1][1]
    np.testing.assert_allclose(after.T_WB[:3, :3], before.T_WB[:3, :3], atol=0.02)


NO_POINTS = PointObservations(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2)))


def lines_alone(t, observations, imu):
    return replace(observations, points=NO_POINTS), imu


def test_lines_alone_start_at_rest_and_carry_the_estimate(slam):
    sequence = Sequence(Trajectory.random(3, rest=1.5), Room.random(3, lines=240), calibration(), 10.0)
    out = feed(slam, sequence, lines_alone)
    found = [(t, e) for t, e, *_ in out if e is not None]
    assert found[0][0] <= 1.0 and slam.resets == 0
    t = np.array([t for t, _ in found])
    p, true = np.stack([e.T_WB[:3, 3] for _, e in found]), sequence.trajectory.at(t)[1]
    far = [np.linalg.norm(q - q[0], axis=1) for q in (p, true)]
    assert far[1].max() > 0.5
    np.testing.assert_allclose(far[0], far[1], atol=0.05)
    keyframes = np.array([e.is_keyframe for _, e in found])
    assert keyframes[t > 2.0].sum() > 12  # by parallax: by time it would be one a second
    assert len(slam.line_map.segments()) >= 5


def test_lines_alone_in_motion_are_told_to_hold_still(slam, sequence):
    out = feed(slam, replace(sequence, seconds=3.0), lines_alone)
    assert all(e is None for _, e, *_ in out)
    assert 'hold still' in out[-1][3]
