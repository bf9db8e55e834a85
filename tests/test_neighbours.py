"""Frames around a keyframe: what they add to its observations."""
import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from line_slam_ros.config import Estimator as Options
from line_slam_ros.estimation.bootstrap import drive
from line_slam_ros.estimation.estimator import Estimator
from line_slam_ros.estimation.neighbours import REACH_S, Neighbours
from line_slam_ros.simulation.features import Room, Sequence, Trajectory, calibration

SIGMA_PX, FOCAL_PX = 0.3, 450.0


class Run:
    """An estimator after some seconds, and which frames its keyframes were averaged with."""

    def __init__(self, seconds=6.0):
        self.sequence = Sequence(Trajectory.random(2), Room.random(2, lines=500), calibration(), seconds)
        self.estimator = Estimator(Options(), self.sequence.calibration, FOCAL_PX, 700, 500)
        self.served, self.keyframes_ns = [], []  # served: stamps of keyframe, frame before, newest frame
        neighbours, w = self.estimator._neighbours, self.estimator.window
        average = neighbours._average

        def recorded(slot, before):
            self.served.append((int(w.t_ns[slot]), before.t_ns, int(w.t_ns[w.n - 1])))
            average(slot, before)

        neighbours._average = recorded
        for seen, _ in drive(self.estimator, self.sequence.calibration, self.sequence.steps()):
            if self.estimator.newest_is_keyframe:
                self.keyframes_ns.append(seen.t_ns)
        neighbours._average = average

    def exact(self, slot):
        """What a slot's image shows without noise."""
        t_ns = int(self.estimator.window.t_ns[slot])
        return replace(self.sequence, pixel_sigma=0.0).observe(t_ns, np.random.default_rng(0))


@pytest.fixture(scope='module')
def run():
    return Run()


def errors_px(run, table, exact):
    """Errors (N, 2) px of all observations but the newest, and over how many images each is a mean. exact: of a slot,
    ids and how far observations of these ids are off."""
    found, images = [], []
    for slot in range(run.estimator.window.n - 1):
        ids, error = exact(slot)
        rows = table.find(ids)
        there = (rows >= 0) & table.seen[rows, slot]
        found.append(FOCAL_PX * error(table.z[rows[there], slot], there))
        images.append(table.images[rows[there], slot])
    return np.concatenate(found), np.concatenate(images)


def exact_points(run):
    def of(slot):
        seen = run.exact(slot).points
        return seen.ids, lambda z, there: z - seen.x[there]
    return of


def exact_lines(run):
    def of(slot):
        seen = run.exact(slot).lines
        along = seen.ends[:, 1] - seen.ends[:, 0]
        across = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
        return seen.ids, lambda z, there: ((z - seen.ends[there]) * across[there, None]).sum(axis=2)
    return of


@pytest.mark.parametrize(('kind', 'exact'), [('points', exact_points), ('lines', exact_lines)])
def test_means_over_images_err_as_much_less_as_white_noise_does(run, kind, exact):
    error, images = errors_px(run, getattr(run.estimator.window, kind), exact(run))
    assert set(images) >= {1, 3, 5}
    for count in (1, 3, 5):
        assert np.sqrt(np.mean(error[images == count]**2)) == pytest.approx(SIGMA_PX / np.sqrt(count), rel=0.15)


def test_a_corner_in_more_images_counts_for_more(run):
    table, n = run.estimator.window.points, run.estimator.window.n
    given = FOCAL_PX * table.sigma[:table.count, :n, 0] / table.scale[:table.count, None]
    seen, images = table.seen[:table.count, :n], table.images[:table.count, :n]
    once, often = np.unique(given[seen & (images == 1)]), np.unique(given[seen & (images == 5)].round(9))
    np.testing.assert_allclose(once, SIGMA_PX)
    assert len(often) == 1 and SIGMA_PX / np.sqrt(5) < often[0] < 0.8 * SIGMA_PX


def test_frames_serve_once_in_pairs_around_a_keyframe_within_reach(run):
    assert len(run.served) > 10
    keyframes, before, after = (np.array(stamps) for stamps in zip(*run.served, strict=True))
    assert np.isin(keyframes, run.keyframes_ns).all()
    others = np.concatenate([before, after])
    assert len(np.unique(others)) == len(others) and not np.isin(others, run.keyframes_ns).any()
    assert (before < keyframes).all() and (keyframes < after).all()
    assert (keyframes - before <= REACH_S * 1e9).all() and (after - keyframes <= REACH_S * 1e9).all()
    np.testing.assert_array_equal(keyframes - before, after - keyframes)


@pytest.mark.parametrize('delay_s', [0.0, 0.01])
def test_poses_around_a_keyframe_are_those_that_the_body_had_when_the_images_were_taken(run, delay_s):
    estimator = copy.deepcopy(run.estimator)
    w, slot = estimator.window, estimator.window.n - 2
    w.delay[0] += delay_s
    before_ns = int(w.t_ns[slot]) - 100_000_000
    assert before_ns > w.t_ns[slot - 1]
    R, p = estimator._neighbours._poses(slot, before_ns)
    t = np.array([before_ns, w.t_ns[slot], w.t_ns[slot + 1]]) * 1e-9 + delay_s
    true_R, true_p, *_ = run.sequence.trajectory.at(t)
    for k in (0, 2):
        np.testing.assert_allclose(R[1].T @ R[k], true_R[1].T @ true_R[k], atol=5e-4)
        np.testing.assert_allclose(R[1].T @ (p[k] - p[1]), true_R[1].T @ (true_p[k] - true_p[1]), atol=3e-3)


def test_what_a_frame_shows_elsewhere_is_left_out(run):
    estimator = copy.deepcopy(run.estimator)
    w, slot = estimator.window, estimator.window.n - 2
    before = run.sequence.observe(int(w.t_ns[slot]) - 50_000_000, np.random.default_rng(0))
    before.points.x[::2] += 5.0 / FOCAL_PX
    images, z = w.points.images[:, slot].copy(), w.points.z[:, slot].copy()
    estimator._neighbours._average(slot, before)
    for shifted in (True, False):
        rows = w.points.find(before.points.ids[0 if shifted else 1::2])
        rows = rows[rows >= 0]
        rows = rows[w.points.solved[rows] & w.points.seen[rows, slot] & w.points.seen[rows, slot + 1]]
        assert len(rows) > 20
        more = w.points.images[rows, slot] - images[rows]
        assert np.mean(more == (0 if shifted else 2)) > 0.95
        np.testing.assert_array_equal((w.points.z[rows, slot] != z[rows]).any(axis=1), more > 0)


def test_at_rest_there_is_no_keyframe_to_serve(run):
    estimator = copy.deepcopy(run.estimator)
    neighbours, w = estimator._neighbours, estimator.window
    seen = run.sequence.observe(int(w.t_ns[w.n - 1]), np.random.default_rng(0))
    assert neighbours._keyframe_ns >= 0
    w.still[w.n - 1] = True
    neighbours.add(seen, False)
    assert neighbours._keyframe_ns < 0 and not neighbours._before and not neighbours._after


@pytest.mark.parametrize(('before_s', 'after_s', 'serves'), [
    ([0.05], 0.05, 0.05), ([0.1, 0.05], 0.05, 0.05), ([0.1], 0.05, None), ([0.15, 0.1, 0.05], 0.15, 0.15),
    ([0.05], 0.15, None), ([0.3], 0.3, None), ([0.11], 0.09, 0.11), ([], 0.05, None)])
def test_frames_of_a_pair_are_about_as_far_from_the_keyframe(run, before_s, after_s, serves):
    neighbours = Neighbours(run.estimator.solver, 20.0)
    neighbours._keyframe_ns = 10**9
    neighbours._before = [SimpleNamespace(t_ns=10**9 - round(s * 1e9)) for s in before_s]
    partner = neighbours._partner(after_s)
    assert (partner and 1.0 - partner.t_ns * 1e-9) == (serves and pytest.approx(serves))
