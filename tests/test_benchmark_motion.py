"""Recordings shown faster, and forwards and backwards: the inertial data are those of a body that moves that way."""
from itertools import islice

import numpy as np
import pytest

from line_slam_ros.benchmark.speed_motion import (
    Faster,
    Motion,
    ToAndFro,
    frames_within,
    sample_rate,
    showing,
    shown_imu,
)
from line_slam_ros.geometry.lie import rigid, so3_exp, so3_log
from line_slam_ros.simulation.features import GRAVITY_W, Trajectory
from line_slam_ros.types import ImuBatch

GYRO_BIAS, ACCEL_BIAS = np.array([0.02, -0.01, 0.03]), np.array([0.1, -0.2, 0.05])
RATE_HZ, SECONDS, START_NS = 200.0, 6.0, 1_700_000_000_000_000_000
TRAJECTORY = Trajectory.random(4)


def recorded():
    """IMU with constant biases from half a second before the first pose, and the motion without an error."""
    t = np.arange(-0.5, SECONDS + 0.01, 1.0 / RATE_HZ)
    _, _, _, omega, force = TRAJECTORY.at(t + 1.0)
    imu = ImuBatch(START_NS + np.round(t * 1e9).astype(np.int64), omega + GYRO_BIAS, force + ACCEL_BIAS)
    s = np.arange(0.0, SECONDS + 1e-6, 0.05)
    R, p, v, *_ = TRAJECTORY.at(s + 1.0)
    return imu, Motion(START_NS + np.round(s * 1e9).astype(np.int64), np.array(list(map(rigid, R, p))), v, GYRO_BIAS,
                       ACCEL_BIAS)


def samples(pace, seconds):
    """t (N,), gyro and accelerometer (N, 3) without their biases."""
    t, gyro, accel = zip(*islice(shown_imu(*recorded(), pace, RATE_HZ), round(seconds * RATE_HZ) + 1), strict=True)
    return np.array(t) * 1e-9, np.array(gyro) - GYRO_BIAS, np.array(accel) - ACCEL_BIAS


def passed(pace, t):
    """Pose and velocity of the body at times t of the showing, by the chain rule alone."""
    s, ds, _ = pace.at(t)
    R, p, v, *_ = TRAJECTORY.at(s + 1.0)
    return R, p, ds[:, None] * v


@pytest.mark.parametrize('pace, seconds', [(Faster(1.0), 5.5), (Faster(3.0), 1.9), (ToAndFro(SECONDS), 20.0)])
def test_the_samples_are_the_derivatives_of_the_motion_shown(pace, seconds):
    t, gyro, accel = samples(pace, seconds)
    h = 1e-4
    (R0, p0, _), (R1, p1, _), (R2, p2, _) = (passed(pace, t + d) for d in (-h, 0.0, h))
    inner = slice(1, -1)
    omega = so3_log(R0.transpose(0, 2, 1) @ R2) / (2.0 * h)
    force = np.einsum('nji,nj->ni', R1, (p0 - 2.0 * p1 + p2) / h**2 - GRAVITY_W)
    np.testing.assert_allclose(gyro[inner], omega[inner], atol=6e-3)
    np.testing.assert_allclose(accel[inner], force[inner], atol=0.15 if isinstance(pace, ToAndFro) else 0.08)


def test_thrice_as_fast_is_not_thrice_the_acceleration_of_gravity():
    _, gyro, accel = samples(Faster(3.0), 1.9)
    _, slow_gyro, slow_accel = samples(Faster(1.0), 5.7)
    np.testing.assert_allclose(gyro, 3.0 * slow_gyro[::3], atol=1e-9)
    R = TRAJECTORY.at(np.arange(len(accel)) * 3.0 / RATE_HZ + 1.0)[0]
    gravity_B = np.einsum('nji,j->ni', R, GRAVITY_W)
    np.testing.assert_allclose(accel, 9.0 * (slow_accel[::3] + gravity_B) - gravity_B, atol=0.02)


def test_forwards_and_backwards_the_integrated_motion_returns():
    pace = ToAndFro(SECONDS)
    period = 2.0 * (SECONDS + 1.0 - 2.0 / np.pi)
    t, gyro, accel = samples(pace, period)
    (R, *_), (p, *_), (v, *_) = passed(pace, np.zeros(1))
    p0, R0, furthest = p, R, 0.0
    for k in range(len(t) - 1):
        dt = t[k + 1] - t[k]
        middle = R @ so3_exp(0.25 * dt * (gyro[k] + gyro[k + 1]))
        a_W = middle @ (0.5 * (accel[k] + accel[k + 1])) + GRAVITY_W
        p, v = p + v * dt + 0.5 * a_W * dt**2, v + a_W * dt
        R = R @ so3_exp(0.5 * dt * (gyro[k] + gyro[k + 1]))
        furthest = max(furthest, np.linalg.norm(p - p0))
    assert furthest > 0.5
    assert np.linalg.norm(p - p0) < 0.02 and np.linalg.norm(v) < 0.01
    assert np.linalg.norm(so3_log(R0.T @ R)) < 1e-3


def test_paces_are_consistent_with_their_derivatives():
    pace, h = ToAndFro(SECONDS, 0.8), 1e-5
    t = np.linspace(0.01, 40.0, 3001)
    s, ds, dds = pace.at(t)
    np.testing.assert_allclose((pace.at(t + h)[0] - pace.at(t - h)[0]) / (2 * h), ds, atol=1e-4)
    np.testing.assert_allclose((pace.at(t + h)[1] - pace.at(t - h)[1]) / (2 * h), dds, atol=1e-3)
    assert s.min() >= 0.0 and s.max() <= SECONDS and np.abs(ds).max() <= 1.0 + 1e-12
    assert s.min() < 1e-3 and s.max() > SECONDS - 1e-3


def test_frames_are_shown_when_the_recording_is_there():
    s = np.arange(0.0, SECONDS + 1e-9, 0.05)
    pace = ToAndFro(s[-1])
    t, k = (np.array(column) for column in zip(*islice(pace.shown(s), 3 * len(s)), strict=True))
    np.testing.assert_allclose(pace.at(t)[0], s[k], atol=1e-9)
    assert (np.diff(t) > 0.0).all() and np.diff(t).max() < 0.25
    last = len(s) - 1
    np.testing.assert_array_equal(k, [*range(last + 1), *range(last - 1, -1, -1), *range(1, last + 1), last - 1,
                                      last - 2])
    assert list(Faster(2.0).shown(np.array([0.0, 1.0]))) == [(0.0, 0), (0.5, 1)]


def test_too_short_a_recording_is_told():
    with pytest.raises(ValueError, match='0.50 s with poses are too short'):
        ToAndFro(0.5)


@pytest.mark.parametrize('rate', [1.0, 3.0])
def test_frames_and_samples_come_in_order_and_end(rate):
    imu, motion = recorded()
    shown = list(showing(imu, motion.t_ns, motion, Faster(rate), RATE_HZ))
    stamps = [item.t_ns for item in shown]
    assert stamps == sorted(stamps) and stamps[0] == 0
    frames = [item for item in shown if item.frame >= 0]
    assert [item.frame for item in frames] == list(range(len(motion.t_ns)))
    assert frames[-1].t_ns == pytest.approx(SECONDS / rate * 1e9, abs=1e3)
    assert len(shown) - len(frames) == pytest.approx(SECONDS / rate * RATE_HZ, abs=2)


def test_frames_with_poses_and_rates():
    imu, motion = recorded()
    frames_ns = motion.t_ns[0] + np.arange(-3, len(motion.t_ns) + 2) * 50_000_000
    assert frames_within(frames_ns, motion) == slice(3, 3 + len(motion.t_ns))
    assert sample_rate(imu.t_ns) == pytest.approx(RATE_HZ)
