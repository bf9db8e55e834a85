"""Inertial samples that show more noise than was calibrated make links that say less."""
from itertools import pairwise

import numpy as np
import pytest

from line_slam_ros.estimation.imu_noise import BANDS, roughness, white
from line_slam_ros.estimation.window import POOLED_S, Window
from line_slam_ros.geometry.imu import between, chained
from line_slam_ros.types import ImuBatch, ImuNoise

RATE = 200.0  # Hz
DENSITY = 0.002  # m/s^2 per root Hz
TOLD = ImuNoise(0.0002, 2e-5, DENSITY, 0.003)


def noise(rng, seconds, rate=RATE, density=DENSITY):
    return density * np.sqrt(rate) * rng.normal(size=(int(seconds * rate) + 1, 3))


def seen(x, rate=RATE):
    power = np.empty((BANDS, 2))
    roughness(1.0 / rate, x, power)
    return np.sqrt(white(power))


@pytest.mark.parametrize('rate', [100.0, 200.0, 1000.0])
def test_white_noise_has_its_density(rate):
    assert seen(noise(np.random.default_rng(0), 20.0, rate), rate) == pytest.approx(DENSITY, rel=0.05)


def test_means_over_samples_have_the_same_density():
    x = noise(np.random.default_rng(1), 40.0)[:8000].reshape(-1, 5, 3).mean(axis=1)
    assert seen(x, RATE / 5.0) == pytest.approx(DENSITY, rel=0.1)


@pytest.mark.parametrize('rate', [50.0, 100.0, 200.0])
def test_motion_is_not_noise(rate):
    """A walk with steps of 3 m/s^2 at 2 Hz and a hand that trembles with 0.1 m/s^2 at 6 Hz."""
    t = np.arange(0.0, 20.0, 1.0 / rate)[:, None]
    moves = 3.0 * np.sin(2.0 * np.pi * 2.0 * t + [0.0, 1.0, 2.0]) + 0.1 * np.sin(2.0 * np.pi * 6.0 * t)
    assert seen(moves, rate) < 0.5 * DENSITY
    assert seen(moves + noise(np.random.default_rng(2), 20.0, rate)[:len(t)], rate) == pytest.approx(DENSITY, rel=0.1)


def test_images_between_samples_are_not_noise():
    t_ns = 5_000_000 * np.arange(401)
    moves = 3.0 * np.sin(4.0 * np.pi * 1e-9 * t_ns[:, None] + [0.0, 1.0, 2.0])
    batch, ends = ImuBatch(t_ns, moves, moves), np.arange(2_000_000, 2_000_000_000, 33_333_333)
    parts = [between(batch, int(a), int(b)) for a, b in pairwise(ends)]
    for samples in (*parts, chained(parts)):
        assert seen(samples[2]) < 0.1 * DENSITY


def test_what_shakes_faster_than_motion_counts():
    """Tones of 0.2 m/s^2 from 20 Hz up, as rotors and the frame between them make."""
    t, tones = np.arange(0.0, 20.0, 1.0 / RATE), np.arange(20.0, 98.0, 3.0)
    phases = np.random.default_rng(5).uniform(0.0, 2.0 * np.pi, (3, len(tones), 1))
    assert seen(0.2 * np.sin(2.0 * np.pi * tones[:, None] * t + phases).sum(axis=1).T) > 10.0 * DENSITY


def test_few_samples_say_nothing():
    power = np.ones((BANDS, 2))
    for count in range(2, 7):
        roughness(0.005, np.ones((count, 3)), power)
        assert white(power) == 0.0
    roughness(0.005, np.arange(21.0).reshape(7, 3)**4, power)  # one difference of single samples, no other
    assert power[0, 1] == 3.0 and not power[1:].any() and white(power) > 0.0


def link_covariances(gyro, accel, links):
    """(links, 9, 9) of a window whose links share the samples evenly."""
    window, size = Window(links + 1, TOLD, 1, 1), (len(gyro) - 1) // links
    for k in range(links + 1):
        rows = slice((k - 1) * size, k * size + 1)
        samples = None if k == 0 else (np.arange(size + 1) / RATE, gyro[rows], accel[rows])
        window.append(int(k * size / RATE * 1e9), np.eye(3), np.zeros(3), np.zeros(3), np.zeros(6), samples)
    return window.cov[:links].copy()


@pytest.mark.parametrize('times', [1.0, 3.0, 30.0])
def test_links_believe_the_larger_of_what_is_told_and_what_is_seen(times):
    rng = np.random.default_rng(3)
    gyro, accel = noise(rng, 2.0, density=times * 0.0002), noise(rng, 2.0, density=times * DENSITY)
    quiet = link_covariances(np.zeros_like(gyro), np.zeros_like(accel), 5)
    ratio = [np.sqrt(np.diag(c) / np.diag(q)) for c, q in zip(link_covariances(gyro, accel, 5), quiet, strict=True)]
    np.testing.assert_allclose(np.mean(ratio, axis=0), times, rtol=0.12)
    assert np.min(ratio) >= 1.0 - 1e-9


def test_short_links_are_judged_with_those_before_them():
    """Of eight intervals each, by which links alone would scatter."""
    rng = np.random.default_rng(4)
    gyro, accel = noise(rng, 4.0, density=0.002), noise(rng, 4.0, density=10.0 * DENSITY)
    cov = link_covariances(gyro, accel, 100)[int(POOLED_S * RATE) // 8 + 1:, 8, 8]
    assert np.std(np.sqrt(cov)) < 0.15 * np.mean(np.sqrt(cov))
    alone = [seen(accel[k:k + 9]) for k in range(100, 780, 8)]
    assert np.std(alone) > 0.15 * np.mean(alone)
