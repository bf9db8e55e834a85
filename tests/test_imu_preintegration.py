"""Preintegration against GTSAM as an independent oracle; the inertial factor's blocks against central differences.

GTSAM turns the specific force at the start of each interval, ours at its middle: GTSAM's result is of first order in
the interval, so the oracle here is two runs on finer samples, extrapolated.
"""
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from line_slam_ros.factors.imu_factor import imu_jacobians, imu_residual
from line_slam_ros.geometry.imu import between, chained, joined, preintegrate, turned
from line_slam_ros.geometry.lie import so3_exp, so3_log
from line_slam_ros.types import ImuBatch

DURATION = 0.5  # s
BIAS = np.array([0.02, -0.03, 0.01, 0.1, 0.2, -0.15])  # gyro rad/s, accelerometer m/s^2
VARIANCES = (1.7e-4**2, 2e-3**2)  # squared noise densities
GRAVITY = np.array([0.0, 0.0, -9.81])
MOTIONS = {
    'vigorous': lambda t: ([np.sin(3 * t) + 0.5, 0.8 * np.cos(2 * t), 1.2 * np.sin(5 * t + 1)],
                           [2 * np.sin(4 * t), 1 + np.cos(3 * t), 9.81 + 3 * np.sin(6 * t)]),
    'fast spin': lambda t: ([0.3 + 0 * t, -0.2 + 0 * t, 6 + 0 * t], [1 + 0 * t, 0 * t, 9.81 + 0 * t]),
    'rest': lambda t: ([BIAS[0] + 0 * t, BIAS[1] + 0 * t, BIAS[2] + 0 * t], [0 * t, 0 * t, 9.81 + 0 * t]),
}


def samples(motion, rate):
    t = np.linspace(0.0, DURATION, round(DURATION * rate) + 1)
    gyro, accel = (np.stack(np.broadcast_arrays(*axes), axis=-1) for axes in MOTIONS[motion](t))
    return t, np.ascontiguousarray(gyro, float), np.ascontiguousarray(accel, float)


def ours(motion, rate, bias=BIAS):
    t, gyro, accel = samples(motion, rate)
    out = SimpleNamespace(dR=np.empty((3, 3)), dp=np.empty(3), dv=np.empty(3), J=np.empty((9, 6)), cov=np.empty((9, 9)))
    out.dt = preintegrate(t, gyro, accel, bias[:3].copy(), bias[3:].copy(), *VARIANCES, out.dR, out.dp, out.dv, out.J,
                          out.cov)
    return out


def gtsam_measurements(motion, rate, bias=BIAS):
    gtsam = pytest.importorskip('gtsam', reason='GTSAM is the independent oracle of this test: pip install gtsam')
    params = gtsam.PreintegrationParams.MakeSharedU(-GRAVITY[2])
    params.setGyroscopeCovariance(VARIANCES[0] * np.eye(3))
    params.setAccelerometerCovariance(VARIANCES[1] * np.eye(3))
    params.setIntegrationCovariance(1e-30 * np.eye(3))
    measured = gtsam.PreintegratedImuMeasurementsManifold(params, gtsam.imuBias.ConstantBias(bias[3:], bias[:3]))
    t, gyro, accel = samples(motion, rate)
    for k in range(len(t) - 1):
        measured.integrateMeasurement((accel[k] + accel[k + 1]) / 2, (gyro[k] + gyro[k + 1]) / 2, t[k + 1] - t[k])
    return measured


def oracle(motion, bias=BIAS):
    """Rotation, position, velocity of GTSAM, the error of first order removed."""
    coarse, fine = (gtsam_measurements(motion, rate, bias) for rate in (1000, 2000))
    return (fine.deltaRij().matrix(), 2 * fine.deltaPij() - coarse.deltaPij(), 2 * fine.deltaVij() - coarse.deltaVij())


def difference(a, b):
    """[rotation, position, velocity] from b to a, rotation on the right."""
    return np.concatenate([so3_log(b[0].T @ a[0]), a[1] - b[1], a[2] - b[2]])


@pytest.mark.parametrize('motion', MOTIONS)
def test_the_turn_alone_is_that_of_the_preintegration(motion):
    t, gyro, _ = samples(motion, 200)
    np.testing.assert_allclose(turned(t, gyro, BIAS[:3]), ours(motion, 200).dR, atol=1e-13)


def mean(preintegrated):
    return preintegrated.dR, preintegrated.dp, preintegrated.dv


@pytest.mark.parametrize('motion', MOTIONS)
@pytest.mark.parametrize('rate, tolerance', [(200, 2e-4), (1000, 1e-5)])  # rad, m, m/s after half a second
def test_mean_agrees_with_gtsam(motion, rate, tolerance):
    found = ours(motion, rate)
    assert found.dt == pytest.approx(DURATION)
    np.testing.assert_allclose(difference(mean(found), oracle(motion)), 0, atol=tolerance)


@pytest.mark.parametrize('motion', MOTIONS)
def test_covariance_agrees_with_gtsam(motion):
    """GTSAM states errors of position and velocity in the end frame; ours are in the start frame."""
    measured = gtsam_measurements(motion, 2000)
    to_start = np.kron(np.diag([0, 1, 1]), measured.deltaRij().matrix()) + np.diag([1.0] * 3 + [0.0] * 6)
    expected = to_start @ measured.preintMeasCov() @ to_start.T
    found = ours(motion, 2000).cov
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=2e-3)
    coarse = ours(motion, 200).cov
    np.testing.assert_allclose(coarse / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=2e-2)


def test_covariance_is_that_of_simulated_noise():
    """2000 runs with drawn noise: standard deviations within 5 % (three standard errors)."""
    t, gyro, accel = samples('vigorous', 100)
    found, runs = ours('vigorous', 100), 2000
    drawn = np.random.default_rng(0).normal(size=(2, len(t) - 1, runs, 3))
    noise = _as_samples(drawn * np.sqrt(np.array(VARIANCES)[:, None, None, None] / np.diff(t)[:, None, None]))
    dR, dp, dv, J, cov = np.empty((runs, 3, 3)), np.empty((runs, 3)), np.empty((runs, 3)), np.empty((9, 6)), np.eye(9)
    for k in range(runs):
        preintegrate(t, gyro + noise[0, :, k], accel + noise[1, :, k], BIAS[:3].copy(), BIAS[3:].copy(), *VARIANCES,
                     dR[k], dp[k], dv[k], J, cov)
    deltas = np.concatenate([so3_log(found.dR.T @ dR), dp - found.dp, dv - found.dv], axis=-1)
    measured, sigma = np.cov(deltas.T), np.sqrt(np.diag(found.cov))
    np.testing.assert_allclose(measured / np.outer(sigma, sigma), found.cov / np.outer(sigma, sigma), atol=0.1)
    np.testing.assert_allclose(np.sqrt(np.diag(measured)), sigma, rtol=0.05)


def _as_samples(interval_noise):
    """Samples (2, N + 1, ...) whose neighbours' means are interval_noise (2, N, ...)."""
    noise = np.zeros((2, interval_noise.shape[1] + 1, *interval_noise.shape[2:]))
    for k in range(interval_noise.shape[1]):
        noise[:, k + 1] = 2 * interval_noise[:, k] - noise[:, k]
    return noise


def bias_derivative(run, h=1e-4):
    """Central differences (9, 6) of a function of the bias that returns rotation, position, velocity."""
    centre = run(BIAS)
    return np.stack([(difference(run(BIAS + h * e), centre) - difference(run(BIAS - h * e), centre)) / (2 * h)
                     for e in np.eye(6)], axis=-1)


def blockwise(found, expected, tolerance):
    """Each 3x3 block to tolerance of its own largest entry (of 1e-6 for blocks of zeros)."""
    for rows in range(0, 9, 3):
        for columns in range(0, 6, 3):
            block = np.s_[rows:rows + 3, columns:columns + 3]
            np.testing.assert_allclose(found[block], expected[block], rtol=0,
                                       atol=tolerance * max(np.abs(expected[block]).max(), 1e-6))


@pytest.mark.parametrize('motion', MOTIONS)
@pytest.mark.parametrize('rate, tolerance', [(200, 5e-4), (4000, 2e-6)])  # the half step's Jr is taken as I
def test_bias_jacobian_is_the_derivative_of_the_mean(motion, rate, tolerance):
    blockwise(ours(motion, rate).J, bias_derivative(lambda bias: mean(ours(motion, rate, bias))), tolerance)


@pytest.mark.parametrize('motion', MOTIONS)
def test_bias_jacobian_agrees_with_gtsam(motion):
    blockwise(ours(motion, 1000).J, bias_derivative(lambda bias: oracle(motion, bias)), 1e-3)


def test_bias_correction_of_first_order_is_close_to_integrating_again():
    step = np.array([0.01, -0.02, 0.01, 0.05, 0.05, -0.1])
    found, again = ours('vigorous', 200), ours('vigorous', 200, BIAS + step)
    corrected = (found.dR @ so3_exp(found.J[:3] @ step), found.dp + found.J[3:6] @ step, found.dv + found.J[6:] @ step)
    np.testing.assert_allclose(difference(corrected, mean(again)), 0, atol=3e-4)
    assert np.abs(difference(mean(found), mean(again))).max() > 1e-2


def state(rng):
    return SimpleNamespace(R=so3_exp(rng.normal(size=3)), p=rng.normal(size=3), v=rng.normal(size=3),
                           b=BIAS + 0.1 * rng.normal(size=6))


def plus(s, delta):
    return SimpleNamespace(R=s.R @ so3_exp(delta[:3]), p=s.p + delta[3:6], v=s.v + delta[6:9], b=s.b + delta[9:])


def arguments(s_i, s_j, preintegrated, W, w_b):
    return (s_i.R, s_i.p, s_i.v, s_i.b, s_j.R, s_j.p, s_j.v, s_j.b, preintegrated.dt, preintegrated.dR,
            preintegrated.dp, preintegrated.dv, preintegrated.J, BIAS, W, w_b, GRAVITY)


def residual(*factor):
    r = np.empty(15)
    imu_residual(*arguments(*factor), r)
    return r


def test_prediction_of_gtsam_leaves_no_residual():
    gtsam = pytest.importorskip('gtsam', reason='GTSAM is the independent oracle of this test: pip install gtsam')
    s_i = state(np.random.default_rng(0))
    s_i.b = BIAS.copy()
    start = gtsam.NavState(gtsam.Rot3(s_i.R), s_i.p, s_i.v)
    coarse, fine = (gtsam_measurements('vigorous', rate).predict(start, gtsam.imuBias.ConstantBias(BIAS[3:], BIAS[:3]))
                    for rate in (1000, 2000))
    s_j = SimpleNamespace(R=fine.attitude().matrix(), p=2 * fine.position() - coarse.position(),
                          v=2 * fine.velocity() - coarse.velocity(), b=BIAS)
    np.testing.assert_allclose(residual(s_i, s_j, ours('vigorous', 2000), np.eye(9), np.ones(6)), 0, atol=1e-5)


def test_residual_counts_each_difference_once_and_in_its_own_place():
    rng, found = np.random.default_rng(1), ours('vigorous', 200)
    s_i = state(rng)
    s_i.b = BIAS.copy()
    s_j = SimpleNamespace(R=s_i.R @ found.dR, p=s_i.p + s_i.v * found.dt + GRAVITY * found.dt**2 / 2 + s_i.R @ found.dp,
                          v=s_i.v + GRAVITY * found.dt + s_i.R @ found.dv, b=BIAS.copy())
    np.testing.assert_allclose(residual(s_i, s_j, found, np.eye(9), np.ones(6)), 0, atol=1e-13)
    delta = 0.1 * rng.normal(size=15)
    expected = np.concatenate([delta[:3], s_i.R.T @ delta[3:6], s_i.R.T @ delta[6:9], delta[9:]])
    np.testing.assert_allclose(residual(s_i, plus(s_j, delta), found, np.eye(9), np.ones(6)), expected, atol=1e-13)


def test_whitening_makes_the_squared_residual_a_mahalanobis_distance():
    rng, found = np.random.default_rng(2), ours('vigorous', 200)
    s_i, s_j = state(rng), state(rng)
    raw = residual(s_i, s_j, found, np.eye(9), np.ones(6))
    W = np.linalg.cholesky(np.linalg.inv(found.cov)).T
    r = residual(s_i, s_j, found, np.ascontiguousarray(W), np.full(6, 3.0))
    assert r[:9] @ r[:9] == pytest.approx(raw[:9] @ np.linalg.solve(found.cov, raw[:9]))
    np.testing.assert_allclose(r[9:], 3.0 * raw[9:])


@pytest.mark.parametrize('angle', [0.0, 1e-9, 1e-4, 1.0, 3.1])  # of the rotation residual
@pytest.mark.parametrize('bias_error', [0.0, 1e-6, 0.3])
@pytest.mark.parametrize('whitened', [False, True])
def test_inertial_factor_jacobians_by_both_states(angle, bias_error, whitened):
    rng, found = np.random.default_rng(3), ours('vigorous', 200)
    s_i, s_j = state(rng), state(rng)
    s_i.b = BIAS + bias_error * rng.normal(size=6)
    axis = rng.normal(size=3)
    corrected = found.dR @ so3_exp(found.J[:3] @ (s_i.b - BIAS))
    s_j.R = s_i.R @ corrected @ so3_exp(angle * axis / np.linalg.norm(axis))
    W = np.ascontiguousarray(np.linalg.cholesky(np.linalg.inv(found.cov)).T) if whitened else np.eye(9)
    w_b = np.arange(1.0, 7.0)
    J_i, J_j = np.full((15, 15), np.nan), np.full((15, 15), np.nan)
    imu_jacobians(*arguments(s_i, s_j, found, W, w_b), J_i, J_j)

    def numeric(function, h=1e-5):
        return np.stack([(function(h * e) - function(-h * e)) / (2 * h) for e in np.eye(15)], axis=-1)

    for J, expected in ((J_i, numeric(lambda d: residual(plus(s_i, d), s_j, found, W, w_b))),
                        (J_j, numeric(lambda d: residual(s_i, plus(s_j, d), found, W, w_b)))):
        np.testing.assert_allclose(J, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def batch(t_ns=(0, 10, 20, 30)):
    t_ns = np.array(t_ns, np.int64) * 1_000_000
    return ImuBatch(t_ns, np.outer(t_ns, [1e-9, 2e-9, 3e-9]), np.outer(t_ns, [4e-9, 5e-9, 6e-9]))


def test_batches_that_overlap_join_to_the_whole():
    whole = batch()
    columns = whole.t_ns, whole.gyro_B, whole.accel_B
    parts = [ImuBatch(*(c[part] for c in columns)) for part in (slice(2), slice(1, None))]
    for made, given in ((joined(parts), whole), (joined([whole]), whole)):
        np.testing.assert_array_equal(made.t_ns, given.t_ns)
        np.testing.assert_array_equal(made.gyro_B, given.gyro_B)
        np.testing.assert_array_equal(made.accel_B, given.accel_B)


@pytest.mark.parametrize('period_ns', [33_333_333, 50_000_000, 66_700_000])
def test_spans_chained_are_as_one_span(period_ns):
    """Whether images come when samples do (50 ms) or between them."""
    rng, t_ns = np.random.default_rng(0), 5_000_000 * np.arange(101)
    whole = ImuBatch(t_ns, rng.normal(size=(101, 3)), rng.normal(size=(101, 3)))
    ends = np.arange(2_000_000 if period_ns % 5_000_000 else 0, 400_000_000, period_ns)
    one = between(whole, int(ends[0]), int(ends[-1]))
    for made, given in zip(chained([between(whole, int(a), int(b)) for a, b in pairwise(ends)]),
                           one, strict=True):
        np.testing.assert_allclose(made, given, atol=1e-12)


def test_samples_between_two_stamps_start_and_end_exactly_there_interpolated():
    t, gyro, accel = between(batch(), 5_000_000, 28_000_000)
    np.testing.assert_allclose(t, [0.0, 0.005, 0.015, 0.023])
    np.testing.assert_allclose(gyro[:, 1], 2 * (t + 0.005))
    np.testing.assert_allclose(accel[:, 2], 6 * (t + 0.005))
    assert gyro.flags.c_contiguous and accel.flags.c_contiguous


def test_stamps_on_samples_give_these_samples_once():
    t, gyro, _ = between(batch(), 10_000_000, 30_000_000)
    np.testing.assert_allclose(t, [0.0, 0.01, 0.02])
    np.testing.assert_allclose(gyro[:, 0], [0.01, 0.02, 0.03])


def test_a_batch_that_does_not_reach_an_end_holds_its_nearest_sample():
    t, gyro, _ = between(batch(), -5_000_000, 35_000_000)
    assert t[0] == 0.0 and t[-1] == pytest.approx(0.04)
    np.testing.assert_allclose(gyro[[0, -1], 0], [0.0, 0.03])


@pytest.mark.parametrize('imu, start, end', [(batch((0,)), 0, 10), (batch(()), 0, 10), (batch(), 10, 10),
                                             (batch(), 20, 10)])
def test_nothing_to_integrate_is_an_error_that_says_so(imu, start, end):
    with pytest.raises(ValueError, match='no inertial samples between'):
        between(imu, start, end)
