"""What the residuals of tracks tell of their noise."""
import numpy as np
import pytest

from line_slam_ros.config import Estimator as Options
from line_slam_ros.estimation import neighbours
from line_slam_ros.estimation.bootstrap import drive
from line_slam_ros.estimation.estimator import Estimator
from line_slam_ros.estimation.noise import LEVELS, MOST_CORRELATED, VIEWS, Noise
from line_slam_ros.simulation.features import Room, Sequence, Trajectory, calibration

UNKNOWNS = 3


def residuals(rng, tracks, views, correlation=0.0):
    """(tracks, views, 2) of white or autoregressive noise of variance one, less what a landmark takes: a mean of both
    coordinates and one slope."""
    e = rng.normal(size=(tracks, views, 2))
    for k in range(1, views):
        e[:, k] = correlation * e[:, k - 1] + np.sqrt(1.0 - correlation**2) * e[:, k]
    basis = np.zeros((views, 2, UNKNOWNS))
    basis[:, 0, 0] = basis[:, 1, 1] = 1.0
    basis[:, 0, 2] = np.linspace(-1.0, 1.0, views)
    basis = np.linalg.qr(basis.reshape(2 * views, UNKNOWNS))[0]
    flat = e.reshape(tracks, -1)
    return (flat - flat @ basis @ basis.T).reshape(e.shape)


def learnt(r, rounds=40):
    noise, told = Noise(), np.ones(r.shape[:2], np.bool_)
    for _ in range(rounds):
        scales = noise.learn(r, told, UNKNOWNS)
    return noise, scales


@pytest.mark.parametrize('size', [0.3, 1.0, 2.5])
def test_white_noise_of_any_size_is_found_and_called_white(size):
    noise, scales = learnt(size * residuals(np.random.default_rng(0), 400, 10))
    assert noise.level == pytest.approx(size, rel=0.06)
    assert noise.correlation == pytest.approx(0.0, abs=0.05)
    assert np.median(scales) == pytest.approx(size, rel=0.1)
    assert noise.typical == pytest.approx(size, rel=0.1)


@pytest.mark.parametrize('correlation', [0.2, 0.4])
def test_correlated_errors_count_for_less(correlation):
    noise, scales = learnt(residuals(np.random.default_rng(1), 400, 14, correlation))
    assert noise.correlation == pytest.approx(correlation, abs=0.12)  # the fit hides a little
    expected = noise.level * np.sqrt((1.0 + noise.correlation) / (1.0 - noise.correlation))
    assert noise.typical == pytest.approx(expected)
    assert np.median(scales) > 1.0 + 0.4 * correlation


def test_each_track_gets_its_own_scale():
    r = residuals(np.random.default_rng(2), 200, 12)
    r[::2] *= 0.3
    r[1::2] *= 1.5
    _, scales = learnt(r)
    assert np.median(scales[::2]) < 0.45 and np.median(scales[1::2]) > 1.1
    assert np.quantile(scales[::2], 0.95) < np.quantile(scales[1::2], 0.05)


def test_few_views_and_few_tracks_hardly_tell():
    short = 3.0 * residuals(np.random.default_rng(3), 50, VIEWS - 1)
    noise = Noise()
    scales = noise.learn(short, np.ones(short.shape[:2], np.bool_), UNKNOWNS)
    np.testing.assert_array_equal(scales, 1.0)
    assert noise.level == 1.0
    noise.learn(3.0 * residuals(np.random.default_rng(3), 5, 8), np.ones((5, 8), np.bool_), UNKNOWNS)
    assert noise.level < 1.1


def test_neither_perfect_nor_wild_residuals_are_believed_without_bound():
    perfect, _ = learnt(np.zeros((100, 10, 2)), 200)
    wild, _ = learnt(100.0 * residuals(np.random.default_rng(4), 100, 10, 0.95), 200)
    assert perfect.level == LEVELS[0] and wild.level == LEVELS[1] and wild.correlation == MOST_CORRELATED


@pytest.fixture(autouse=True)
def single_images(monkeypatch):
    """Observations as they were simulated: no means over the frames around a keyframe."""
    monkeypatch.setattr(neighbours, 'REACH_S', 0.0)


def run(pixel_sigma, seconds=6.0, rest=0.0, told=0.3):
    """An estimator that was told another noise than there is, after so many seconds."""
    sequence = Sequence(Trajectory.random(2, rest), Room.random(2), calibration(), seconds, pixel_sigma=pixel_sigma)
    estimator = Estimator(Options(point_sigma_px=told), sequence.calibration, 450.0, 700, 150)
    for _ in drive(estimator, sequence.calibration, sequence.steps()):
        pass
    return estimator


@pytest.mark.parametrize('pixel_sigma', [0.1, 0.3, 0.6])
def test_the_estimator_learns_the_noise_of_points_it_was_told_wrong(pixel_sigma):
    window = run(pixel_sigma).window
    assert window.points.noise.level == pytest.approx(pixel_sigma / 0.3, rel=0.15)
    assert window.lines.noise.level == pytest.approx(1.0, rel=0.2)  # of these the simulation tells the truth


def test_new_observations_carry_the_scale_of_their_track():
    table = run(0.6).window.points
    rows = np.flatnonzero(table.seen[:table.count].any(axis=1))
    given = table.sigma[rows, :, 0] / table.scale[rows, None]
    np.testing.assert_allclose(given[table.seen[rows]], 0.3 / 450.0, rtol=1e-9)
    assert len(np.unique(table.scale[rows])) > 50


def test_learning_leaves_residuals_in_pixels_as_they_are():
    estimator = run(0.6)
    table, kind, n = estimator.window.points, estimator.solver.points, estimator.window.n
    estimator.solver.cost()
    told = kind.weight[:table.count, :n] * table.solved[:table.count, None] > 0.0
    before, scale = kind.chi2[:table.count, :n] * table.scale[:table.count, None]**2, table.scale.copy()
    table.learn_noise(n, kind.pull, kind.weight, kind.size)
    assert np.any(table.scale != scale)
    estimator.solver.cost()
    after = kind.chi2[:table.count, :n] * table.scale[:table.count, None]**2
    np.testing.assert_allclose(after[told], before[told], rtol=1e-9)


def test_a_gross_error_is_an_outlier_and_teaches_nothing():
    """Also in a keyframe, where the window is optimised: the track must not explain it by noise of its own."""
    estimator, sequence = Estimator(Options(keyframe_parallax_px=0.5), calibration(), 450.0, 700, 150), Sequence(
        Trajectory.random(2), Room.random(2), calibration(), 5.0)
    table, at_ns, wrong = estimator.window.points, 4_050_000_000, []

    def steps():
        for seen, samples in sequence.steps():
            if seen.t_ns == at_ns:
                old = table.solved[:table.count] & (table.seen[:table.count].sum(axis=1) >= 8)
                wrong.append(np.intersect1d(table.ids[:table.count][old], seen.points.ids)[0])
                seen.points.x[seen.points.ids == wrong[0]] += 50.0 / 450.0
            yield seen, samples

    for seen, (outliers, _) in drive(estimator, sequence.calibration, steps()):
        if seen.t_ns == at_ns:
            assert estimator.newest_is_keyframe
            assert wrong[0] in outliers
    assert wrong and table.noise.level < 1.2


def test_a_new_start_knows_nothing_of_the_noise():
    estimator = run(0.6)
    assert estimator.window.points.noise.level > 1.5
    estimator.window.clear()
    assert estimator.window.points.noise.typical == 1.0 == estimator.window.lines.noise.typical


def test_nothing_is_learnt_at_rest():
    estimator = run(0.02, seconds=3.0, rest=10.0)
    assert estimator.window.n > 2 and estimator.window.still[:estimator.window.n].any()
    assert estimator.window.points.noise.level == 1.0 == estimator.window.lines.noise.level


def test_what_is_more_exact_than_it_was_said_to_be_may_still_err():
    """An error within the gate of the given noise ends no track, however exact the others are."""
    estimator = run(0.05)
    table, n = estimator.window.points, estimator.window.n
    estimator.solver.cost()
    row = int(np.flatnonzero(table.solved[:table.count] & table.seen[:table.count, n - 1])[0])
    given = table.sigma[row, n - 1, 0] / table.scale[row]
    assert table.scale[row] < 0.5
    for error, stays in ((3.0, True), (6.0, False)):  # standard deviations as given; the gate is at 4.5
        table.seen[row, n - 1] = True
        estimator.solver.points.chi2[row, n - 1] = (error * given / table.sigma[row, n - 1, 0])**2
        outlier = table.ids[row]
        wrong = estimator._reject(table, estimator.solver.points.chi2)
        gone, _ = estimator._cull(wrong, np.zeros((estimator.window.lines.count, n), np.bool_))
        assert (outlier not in gone) == stays
