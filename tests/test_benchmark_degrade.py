"""Recordings made worse: exactly as much as asked, the same every time, and nothing else."""
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from bag_samples import line_slam

from line_slam_ros.benchmark.degrade import Degradation, DegradedStream, degraded_calibration, degraded_image, gain
from line_slam_ros.cli import benchmark
from line_slam_ros.geometry.camera import Camera
from line_slam_ros.geometry.lie import so3_log
from line_slam_ros.simulation.features import calibration
from line_slam_ros.types import Frame, ImuNoise

CALIBRATION = replace(calibration(), distortion=(-0.28, 0.07, 2e-4, -1e-4))
STEP_NS = 5_000_000


def picture(seed=0):
    noise = np.random.default_rng(seed).integers(0, 256, (480, 640), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 3)


def samples(stream, count=8000):
    """Rates and forces (N, 6) that the stream makes of a body at rest."""
    return np.array([np.concatenate(stream.imu(k * STEP_NS, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))[1:])
                     for k in range(count)])


def test_by_default_nothing_changes():
    wanted, frame = Degradation(), Frame(7, picture())
    stream = DegradedStream(wanted, ImuNoise())
    assert wanted.changes() == {}
    assert all(stream.frame(frame) is frame for _ in range(3))
    assert stream.imu(5, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)) == (5, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
    assert degraded_calibration(CALIBRATION, wanted) is CALIBRATION


def test_every_nth_image_stays_starting_with_the_first():
    stream = DegradedStream(Degradation(every_nth=3), ImuNoise())
    kept = [stream.frame(Frame(k, picture())) for k in range(7)]
    assert [k for k, frame in enumerate(kept) if frame is not None] == [0, 3, 6]


def test_imu_noise_multiplies_what_the_calibration_says():
    noise = ImuNoise()
    own = np.random.default_rng(1).normal(size=(8000, 6)) * np.sqrt(200.0)
    own *= np.repeat([noise.gyro_density, noise.accel_density], 3)
    added = samples(DegradedStream(Degradation(imu_noise=3.0), noise))[1:]
    total = (added - added.mean(axis=0) + own[1:]).std(axis=0) / own.std(axis=0)
    np.testing.assert_allclose(total, 3.0, rtol=0.05)  # 8000 samples: 1 % each
    np.testing.assert_allclose(added.mean(axis=0), [0, 0, 0, 0, 0, 9.81], atol=0.005)


def test_imu_noise_follows_its_seed_and_spares_the_first_sample():
    first, again, other = (samples(DegradedStream(Degradation(imu_noise=2.0, seed=s), ImuNoise()), 50)
                           for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.all(first[1:] != other[1:])
    np.testing.assert_array_equal(first[0], [0, 0, 0, 0, 0, 9.81])


def test_imu_noise_lets_samples_out_of_order_pass():
    stream = DegradedStream(Degradation(imu_noise=3.0), ImuNoise())
    stream.imu(10, (0.0,) * 3, (0.0,) * 3)
    assert stream.imu(10, (1.0, 0.0, 0.0), (0.0,) * 3) == (10, (1.0, 0.0, 0.0), (0.0,) * 3)


def test_stamps_of_the_imu_run_late_those_of_images_do_not():
    stream = DegradedStream(Degradation(time_offset_ms=5.0), ImuNoise())
    assert stream.imu(1_000, (0.0,) * 3, (0.0,) * 3)[0] == 5_001_000
    assert stream.frame(Frame(1_000, picture())).t_ns == 1_000


def test_brightness_is_a_factor_that_saturates():
    image = np.array([[0, 100, 201, 255]], np.uint8)
    np.testing.assert_array_equal(degraded_image(image, 0, Degradation(brightness=0.5)), [[0, 50, 100, 128]])
    np.testing.assert_array_equal(degraded_image(image, 0, Degradation(brightness=1.3)), [[0, 130, 255, 255]])


def test_a_ramp_goes_linearly_up_and_down_by_its_share():
    wanted = Degradation(ramp=0.4, ramp_period_s=8.0)
    gains = [gain(round(t * 1e9), wanted) for t in (0, 1, 2, 4, 6, 8, 1_000_000_002)]
    np.testing.assert_allclose(gains, [1.4, 1.2, 1.0, 0.6, 1.0, 1.4, 1.0], rtol=1e-12)


def test_exposure_jumps_between_two_values():
    wanted = Degradation(jump=0.3, jump_period_s=1.5)
    gains = [gain(round(t * 1e9), wanted) for t in (0.0, 0.7, 0.8, 1.4, 1.6)]
    np.testing.assert_allclose(gains, [1.3, 1.3, 0.7, 0.7, 1.3], rtol=1e-12)
    both = gain(0, replace(wanted, brightness=0.5, ramp=0.2))
    assert both == pytest.approx(0.5 * 1.3 * 1.2)


def test_blur_has_the_standard_deviation_asked_for():
    dot = np.zeros((61, 61), np.uint8)
    dot[26:35, 26:35] = 255
    offset = np.arange(61) - 30.0

    def variance(image):
        weight = image.sum(axis=0, dtype=float)
        return (weight * offset**2).sum() / weight.sum()

    blurred = degraded_image(dot, 0, Degradation(blur_px=3.0))
    assert variance(blurred) - variance(dot) == pytest.approx(9.0, rel=0.05)  # grey values are rounded


def test_calibration_and_images_shrink_together():
    """A blob stays where the scaled calibration projects its bearing to."""
    wanted = Degradation(resize=0.75)
    small = degraded_calibration(CALIBRATION, wanted)
    assert (small.width, small.height) == (480, 360)
    x = np.array([[0.31, -0.22]])
    uv = Camera(CALIBRATION).project(x)[0]
    v, u = np.mgrid[:480, :640]
    blob = (255.0 * np.exp(-0.5 * ((u - uv[0]) ** 2 + (v - uv[1]) ** 2) / 36.0)).astype(np.uint8)
    image = degraded_image(blob, 0, wanted).astype(float)
    v, u = np.mgrid[:360, :480]
    centre = np.array([(image * u).sum(), (image * v).sum()]) / image.sum()
    np.testing.assert_allclose(Camera(small).project(x)[0], centre, atol=0.03)  # rounding of grey values


def test_the_extrinsic_rotation_is_off_by_the_angle():
    turned = [degraded_calibration(CALIBRATION, Degradation(extrinsic_rotation_deg=1.0, seed=s)) for s in (0, 0, 1)]
    for c in turned:
        off = so3_log(CALIBRATION.T_BC[:3, :3].T @ c.T_BC[:3, :3])
        assert np.degrees(np.linalg.norm(off)) == pytest.approx(1.0, abs=1e-9)
        np.testing.assert_array_equal(c.T_BC[:3, 3], CALIBRATION.T_BC[:3, 3])
    np.testing.assert_array_equal(turned[0].T_BC, turned[1].T_BC)
    assert np.abs(turned[0].T_BC - turned[2].T_BC).max() > 1e-3
    np.testing.assert_array_equal(CALIBRATION.T_BC, calibration().T_BC)  # untouched


@pytest.mark.parametrize('change', [{'brightness': 0.5}, {'blur_px': 2.0}, {'resize': 0.5}, {'jump': 0.3}])
def test_images_are_degraded_the_same_way_twice_and_never_in_place(change):
    image, untouched = picture(), picture()
    image.flags.writeable = False
    first, again = (degraded_image(image, 5, Degradation(**change)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(image, untouched)
    assert first.dtype == np.uint8 and first is not image


@pytest.mark.parametrize('values, complaint', [
    ({'blurr': 2}, "here: unknown degradation 'blurr'; use .*blur_px"),
    ({'every_nth': 0}, 'here: degradation.every_nth must lie in'),
    ({'imu_noise': 'much'}, "here: degradation.imu_noise must be float, got 'much'"),
    ({'resize': 1.5}, 'here: degradation.resize must lie in')])
def test_wishes_that_cannot_be_fulfilled_are_named(values, complaint):
    with pytest.raises(ValueError, match=complaint):
        Degradation.of(values, 'here')


@pytest.mark.parametrize('given, complaint', [
    ('blurr=2', "--degrade: unknown degradation 'blurr'"), ('blur_px', '--degrade blur_px: expected name=value')])
def test_replay_says_what_it_does_not_know(given, complaint, tmp_path):
    code, _, err = line_slam('replay', tmp_path / 'bag', '--degrade', given)
    assert code == 2 and complaint in err


def test_the_help_names_every_degradation():
    assert not [f.name for f in fields(Degradation) if f'{f.name}: ' not in benchmark._RECORDINGS]
