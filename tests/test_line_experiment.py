"""The line experiment on small simulated problems."""
from dataclasses import replace
from time import perf_counter

import numpy as np
import pytest
from line_scene import FOCAL, scene, walk

from line_slam_ros.experiment.ends import NO_ENDS, extents_of_views, find_ends
from line_slam_ros.experiment.files import Experiment, LineViews, add_noise
from line_slam_ros.experiment.methods import END_RULES, PRESETS, Method
from line_slam_ros.experiment.problem import LineProblem
from line_slam_ros.experiment.score import score
from line_slam_ros.experiment.solving import FEW_VIEWS, NOT_HELD, fit, solve_lines
from line_slam_ros.experiment.starts import BEHIND, FEW_FRAMES, NO_PARALLAX, start_lines
from line_slam_ros.experiment.sweep import disturbed, means, summarise, sweep, time_joint
from line_slam_ros.geometry.lie import rigid, rigid_inverse, so3_exp, transform_points
from line_slam_ros.geometry.lines import line_angle, line_from_points, point_distance, transform_lines, unit_direction
from line_slam_ros.types import LineForm, Loss

AUTHORS, BEST = PRESETS['authors'], PRESETS['best']
STARTED = ('two-plane', 'best-parallax', 'svd', 'consensus')
FOUR = [form for form in LineForm if form.freedom == 4]


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def experiment_of(segments, T_WC, shown=None):
    """Every segment from every pose, frame by frame; shown(frame, line) -> the part (2, 3) of it that is in view."""
    frame, line = (a.ravel() for a in np.mgrid[:len(T_WC), :len(segments)])
    parts = segments[line] if shown is None else np.array([shown(f, i) for f, i in zip(frame, line, strict=True)])
    p_C = transform_points(rigid_inverse(T_WC)[frame], parts)
    return Experiment(T_WC, np.arange(len(T_WC)) / 30, segments, LineViews(frame, line, p_C[..., :2] / p_C[..., 2:]))


def noisy(experiment, px, seed=0):
    return disturbed(experiment, px, seed, FOCAL)


def errors_of(problem, result):
    return score(problem.segments, result.pluecker, result.ends)


def residuals(problem, pluecker, i):
    """Distances (K, 2) of the observed ends from the projected line, px, written down once more."""
    own = slice(problem.first[i], problem.last[i])
    T_CW = rigid_inverse(rigid(problem.poses[own, :, :3], problem.poses[own, :, 3]))
    n = transform_lines(T_CW, np.broadcast_to(pluecker[i], (len(T_CW), 1, 6)))[:, 0, :3]
    x = np.concatenate([problem.ends[own], np.ones((len(n), 2, 1))], axis=-1)
    return FOCAL * np.einsum('kej,kj->ke', x, n) / np.linalg.norm(n[:, :2], axis=1)[:, None]


def test_views_are_sorted_by_line_and_keep_their_order(rng):
    experiment = experiment_of(scene(rng, 3), walk(4))
    views = experiment.views
    keep = np.array([8, 3, 11, 0, 6])  # line 1 is seen by nothing
    views = LineViews(views.frame[keep], np.array([2, 0, 2, 0, 0]), views.ends[keep])
    problem = LineProblem.of(replace(experiment, views=views))
    assert problem.count.tolist() == [3, 0, 2] and problem.line.tolist() == [0, 0, 0, 2, 2]
    assert problem.frame.tolist() == views.frame[[1, 3, 4, 0, 2]].tolist()
    np.testing.assert_array_equal(problem.ends, views.ends[[1, 3, 4, 0, 2]])
    np.testing.assert_array_equal(problem.origin()[0], experiment.T_WC[views.frame[1], :3, 3])  # the host comes first
    assert np.isnan(problem.origin()[1]).all()
    np.testing.assert_array_equal(problem.padded(problem.frame)[0], problem.frame[:3])
    part = problem.only(np.array([True, False, True, False, True]))
    assert part.count.tolist() == [2, 0, 1] and part.frame.tolist() == problem.frame[[0, 2, 4]].tolist()


def test_a_problem_without_views_is_refused(rng):
    experiment = experiment_of(scene(rng, 2), walk(3))
    nothing = LineViews(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2, 2)))
    with pytest.raises(ValueError, match='no line was observed'):
        LineProblem.of(replace(experiment, views=nothing))


@pytest.mark.row(29)
@pytest.mark.trap('swapped end points')
@pytest.mark.parametrize('name', STARTED)
def test_starts_are_exact_without_noise_and_blind_to_swapped_ends(rng, name):
    experiment = experiment_of(scene(rng, 20), walk(12))
    swapped = experiment.views.ends.copy()
    swapped[::3] = swapped[::3, ::-1]
    for ends in (experiment.views.ends, swapped):
        problem = LineProblem.of(replace(experiment, views=replace(experiment.views, ends=ends)))
        starts = start_lines(problem, name, 1.0)
        local = problem.segments - problem.origin()[:, None]
        assert not starts.reason.any()
        np.testing.assert_allclose(point_distance(starts.pluecker[:, None], local), 0, atol=1e-9)


@pytest.mark.row(29)
def test_best_parallax_finds_the_widest_pair_and_two_plane_keeps_the_host(rng):
    """With noise each start lies in both planes of its pair: the residuals of these two views are zero."""
    problem = noisy(experiment_of(scene(rng, 6), walk(10)), 2.0)
    for name, from_host in (('two-plane', True), ('best-parallax', False)):
        starts = start_lines(problem, name, 1.0)
        W = starts.pluecker.copy()
        W[:, :3] += np.cross(problem.origin(), W[:, 3:])
        for i in range(6):
            own = slice(problem.first[i], problem.last[i])
            x = np.concatenate([problem.ends[own], np.ones((10, 2, 1))], axis=-1)
            N = np.einsum('kij,kj->ki', problem.poses[own, :, :3], np.cross(x[:, 0], x[:, 1]))
            N /= np.linalg.norm(N, axis=1, keepdims=True)
            cosine = np.abs(N @ N.T)
            pair = {0, int(np.argmin(cosine[0]))} if from_host else set(np.unravel_index(np.argmin(cosine), (10, 10)))
            touched = np.flatnonzero(np.abs(residuals(problem, W, i)).max(axis=1) < 1e-6)
            assert set(touched.tolist()) == {int(k) for k in pair}


@pytest.mark.row(29)
@pytest.mark.trap('pure rotation', 'motion within the observation plane', 'motion along the line')
@pytest.mark.parametrize('noise_px', [0.0, 0.5])
@pytest.mark.parametrize('start', STARTED)
def test_degenerate_motion_is_reported_not_solved(start, noise_px):
    """Without noise the planes have no line in common, with it a wrong one that only the parallax gives away."""
    along_z = np.array([[[0.5, -1.0, 4.0], [0.5, 1.0, 4.0]], [[0.0, -1.0, 5.0], [0.0, 1.0, 5.0]]])
    turning = rigid(so3_exp(np.linspace([0, 0, 0], [0.1, 0.2, 0], 6)), np.zeros((6, 3)))
    upwards = rigid(np.eye(3), np.linspace([0, 0, 0], [0, 1, 0], 6))  # along both lines
    forwards = rigid(np.eye(3), np.linspace([0, 0, 0], [0, 0, 1], 6))  # in the plane of the second
    for T_WC, flat in ((turning, [True, True]), (upwards, [True, True]), (forwards, [False, True])):
        result = solve_lines(noisy(experiment_of(along_z, T_WC), noise_px), replace(BEST, start=start))
        assert [reason.startswith(NO_PARALLAX) for reason in result.reason] == flat
        assert np.isnan(result.pluecker[flat]).all() and np.isnan(result.ends[flat]).all()
        assert np.isfinite(result.pluecker[~np.array(flat)]).all()


@pytest.mark.row(29)
@pytest.mark.parametrize('name', STARTED)
def test_a_start_needs_the_parallax_asked_for(name):
    """Cameras on an arc about the line, 2 degrees to one side of the host and 1.5 to the other."""
    angle = np.radians([0.0, 2.0, -1.5])
    R_WC = so3_exp(angle[:, None] * [0.0, 1.0, 0.0])
    T_WC = rigid(R_WC, -5.0 * R_WC[:, :, 2])
    problem = LineProblem.of(experiment_of(np.array([[[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]]]), T_WC))
    widest = 2.0 if name == 'two-plane' else 3.5
    assert start_lines(problem, name, widest - 0.01).reason.tolist() == ['']
    told = f'{NO_PARALLAX}: all planes within {widest + 0.01:g} deg'
    assert start_lines(problem, name, widest + 0.01).reason.tolist() == [told]


@pytest.mark.row(29)
@pytest.mark.parametrize('name', STARTED)
def test_a_view_without_a_length_starts_nothing(rng, name):
    """No file holds one; it has no plane, and is not taken for the one at the widest angle."""
    experiment = experiment_of(scene(rng, 5), walk(12))
    ends = experiment.views.ends.copy()
    ends[experiment.views.frame == 4, 1] = ends[experiment.views.frame == 4, 0]
    problem = LineProblem.of(replace(experiment, views=replace(experiment.views, ends=ends)))
    starts = start_lines(problem, name, 1.0)
    assert not starts.reason.any()
    local = problem.segments - problem.origin()[:, None]
    np.testing.assert_allclose(point_distance(starts.pluecker[:, None], local), 0, atol=1e-9)


@pytest.mark.row(33)
@pytest.mark.trap('points behind the camera')
def test_lines_behind_the_cameras_or_hardly_seen_keep_their_place(rng):
    segments = scene(rng, 4)
    segments[1, :, 2] = -segments[1, :, 2] - 3.0  # its image is a mirror one
    experiment = experiment_of(segments, walk(8))
    views = experiment.views
    keep = (views.line != 2) & ((views.line != 3) | (views.frame == 5))
    views = LineViews(views.frame[keep], views.line[keep], views.ends[keep])
    result = solve_lines(LineProblem.of(replace(experiment, views=views)), BEST)
    assert result.reason.tolist() == ['', BEHIND, FEW_FRAMES, FEW_FRAMES]
    assert result.ok.tolist() == [True, False, False, False] and len(result.segments(np.zeros(4, np.int64))) == 1
    assert np.isnan(result.cost[1:]).all() and result.total_cost == pytest.approx(result.cost[0], abs=1e-12)


@pytest.mark.row(4)
def test_what_a_form_cannot_hold_is_reported(rng):
    """orth4 has no angles for a moment along z: a line at the height of its origin."""
    T_WC = rigid(np.eye(3), np.linspace([0, 0, 0], [0, 1, 0], 6))
    level = rigid(so3_exp([np.pi / 2, 0, 0]), np.zeros(3))  # the camera's y is the world's z
    segments = transform_points(level, np.array([[[-1, 0, 4], [1, 0, 5]], [[-1, 1, 4], [1, 1.5, 5]]], float))
    problem = LineProblem.of(experiment_of(segments, level @ T_WC))
    assert abs(problem.origin()[0, 2]) < 1e-12
    assert solve_lines(problem, replace(BEST, form=LineForm.ORTH4)).reason.tolist() == [NOT_HELD, '']
    assert solve_lines(problem, BEST).ok.all()


def test_two_views_are_too_few_for_four_numbers_without_the_host(rng):
    problem = LineProblem.of(experiment_of(scene(rng, 3), walk(5)[[0, 4]]))
    assert solve_lines(problem, AUTHORS).reason.tolist() == [FEW_VIEWS] * 3
    two = replace(AUTHORS, form=LineForm.HOST, min_parallax_deg=0.1)
    assert solve_lines(problem, two).ok.all() and solve_lines(problem, replace(AUTHORS, use_host=True)).ok.all()


@pytest.mark.row(34, 35, 41)
@pytest.mark.parametrize('joint', [True, False], ids=['joint', 'per line'])
@pytest.mark.parametrize('freedom', [2, 4])
def test_lines_are_recovered_exactly_without_noise(rng, freedom, joint):
    form = LineForm.HOST if freedom == 2 else LineForm.ORTHONORMAL
    problem = LineProblem.of(experiment_of(scene(rng, 20), walk(12)))
    for preset in (AUTHORS, BEST):
        result = solve_lines(problem, replace(preset, form=form, joint=joint, sigma_px=1.0))
        assert result.ok.all() and result.total_cost < 1e-15
        errors = errors_of(problem, result)
        assert errors.angle_deg.max() < 1e-6 and errors.perpendicular_m.max() < 1e-8 and errors.endpoint_m.max() < 1e-7


@pytest.mark.row(34, 35, 41)
@pytest.mark.parametrize('loss', list(Loss))
@pytest.mark.parametrize('freedom', [2, 4])
def test_joint_and_per_line_solutions_from_all_starts_are_one(rng, freedom, loss):
    problem = noisy(experiment_of(scene(rng, 20), walk(20)), 2.0)
    method = replace(AUTHORS, form=LineForm.HOST if freedom == 2 else LineForm.ORTHONORMAL, loss=loss)
    first = solve_lines(problem, method)
    for joint, start in ((joint, start) for joint in (True, False) for start in STARTED):
        result = solve_lines(problem, replace(method, joint=joint, start=start))
        assert result.ok.all() and 2 <= result.iterations < method.iterations
        assert (len(set(result.steps.tolist())) == 1) == joint  # one by one, each takes as many as it needs
        np.testing.assert_allclose(result.cost, first.cost, rtol=1e-7)
        assert line_angle(result.pluecker, first.pluecker).max() < 1e-4


@pytest.mark.row(30)
@pytest.mark.parametrize('use_host', [True, False])
def test_all_forms_of_four_numbers_have_the_same_optimum(rng, use_host):
    problem = noisy(experiment_of(scene(rng, 20), walk(20)), 2.0)
    results = {form: solve_lines(problem, replace(BEST, form=form, sigma_px=2.0, use_host=use_host)) for form in FOUR}
    for result in results.values():
        assert result.ok.all()
        np.testing.assert_allclose(result.cost, results[LineForm.ORTHONORMAL].cost, rtol=1e-6)
        assert line_angle(result.pluecker, results[LineForm.ORTHONORMAL].pluecker).max() < 1e-4


@pytest.mark.row(22, 34)
def test_the_host_observation_says_nothing_to_a_line_pinned_to_it(rng):
    """Two numbers: its residual is zero whatever they are. Four: it counts, and freeing the plane uses it."""
    problem = noisy(experiment_of(scene(rng, 20), walk(20)), 2.0)
    method = replace(BEST, form=LineForm.HOST, sigma_px=2.0, gate=None)
    twins = [solve_lines(problem, replace(method, use_host=use)) for use in (True, False)]
    np.testing.assert_allclose(twins[0].cost, twins[1].cost, rtol=1e-9)
    np.testing.assert_allclose(twins[0].pluecker, twins[1].pluecker, atol=1e-6)
    method = replace(method, form=LineForm.HOST_FREE)
    free = [solve_lines(problem, replace(method, use_host=use)) for use in (True, False)]
    assert (free[0].cost < twins[0].cost).all() and (free[0].cost > free[1].cost).all()
    pinned, freed = errors_of(problem, twins[0]), errors_of(problem, free[0])
    assert freed.perpendicular_m.mean() < 0.7 * pinned.perpendicular_m.mean()


@pytest.mark.row(36)
@pytest.mark.parametrize(('loss', 'scale', 'rho'), [
    (Loss.CAUCHY, 1.0, lambda s: np.log1p(s)),
    (Loss.CAUCHY, 2.5, lambda s: 6.25 * np.log1p(s / 6.25)),
    (Loss.HUBER, 1.5, lambda s: np.where(s > 2.25, 3.0 * np.sqrt(s) - 2.25, s)),
    (Loss.L2, 1.0, lambda s: s)], ids=['cauchy', 'wide cauchy', 'huber', 'l2'])
def test_cost_is_half_the_sum_of_losses_of_whitened_residuals(rng, loss, scale, rho):
    problem = noisy(experiment_of(scene(rng, 8), walk(15)), 2.0)
    for sigma_px in (2.0, 3.2):
        for use_host in (True, False):
            method = Method(loss=loss, loss_scale=scale, sigma_px=sigma_px, gate=None, use_host=use_host)
            result = solve_lines(problem, method)
            assert result.sigma_px == pytest.approx(sigma_px)
            for i in range(8):
                r = residuals(problem, result.pluecker, i)[0 if use_host else 1:] / sigma_px
                assert result.cost[i] == pytest.approx(0.5 * rho(np.sum(r * r, axis=1)).sum(), rel=1e-9)
            assert result.total_cost == pytest.approx(result.cost.sum())


@pytest.mark.row(36)
def test_sigma_is_found_from_the_residuals(rng):
    experiment = experiment_of(scene(rng, 30), walk(40))
    for px in (0.5, 4.0):
        problem = noisy(experiment, px)
        found, given = (solve_lines(problem, replace(BEST, sigma_px=sigma_px)) for sigma_px in (None, px))
        assert 0.93 * px < found.sigma_px < 1.03 * px  # four numbers per line are fitted to 80 residuals
        errors = [errors_of(problem, result).perpendicular_m.mean() for result in (found, given)]
        assert errors[0] == pytest.approx(errors[1], rel=0.02)


@pytest.mark.row(36)
def test_data_without_noise_is_not_believed_without_bound(rng):
    """Sigma found from residuals of 1e-13 px would put half of these over the gate."""
    problem = LineProblem.of(experiment_of(scene(rng, 20), walk(12)))
    result = solve_lines(problem, BEST)
    assert result.ok.all() and not result.outliers.any() and 1e-6 < result.sigma_px < 1e-2
    assert result.total_cost < 1e-12 and errors_of(problem, result).endpoint_m.max() < 1e-7


@pytest.mark.row(36)
def test_a_robust_loss_ignores_what_a_plain_one_follows(rng):
    experiment = experiment_of(scene(rng, 10), walk(30))
    ends = add_noise(experiment.views, 1.0 / FOCAL, 0).ends
    ends[::7] += rng.normal(size=(len(ends[::7]), 2, 2)) * 60 / FOCAL
    problem = LineProblem.of(replace(experiment, views=replace(experiment.views, ends=ends)))
    error = {loss: errors_of(problem, solve_lines(problem, replace(BEST, loss=loss, sigma_px=1.0, gate=None)))
             for loss in Loss}
    for loss in (Loss.HUBER, Loss.CAUCHY):
        assert error[loss].perpendicular_m.mean() < 0.3 * error[Loss.L2].perpendicular_m.mean()


def test_wrong_views_are_found_and_left_out(rng):
    """A third of all views show another line, some of them the host's; the lines come out as if these did not exist."""
    experiment = experiment_of(scene(rng, 20), walk(60))
    views = add_noise(experiment.views, 1.0 / FOCAL, 0)
    wrong = rng.random(len(views.line)) < 0.33
    ends = np.where(wrong[:, None, None], views.ends[rng.permutation(len(wrong))], views.ends)
    problem = LineProblem.of(replace(experiment, views=replace(views, ends=ends)))
    right = LineViews(views.frame[~wrong], views.line[~wrong], views.ends[~wrong])
    clean = LineProblem.of(replace(experiment, views=right))
    result, expected = solve_lines(problem, BEST), solve_lines(clean, BEST)
    assert result.ok.all() and 0.95 * wrong.sum() < result.outliers.sum() < 1.01 * wrong.sum()
    errors, expected_errors = errors_of(problem, result), errors_of(clean, expected)
    assert errors.perpendicular_m.mean() < 1.25 * expected_errors.perpendicular_m.mean()
    assert errors.endpoint_m.mean() < 1.25 * expected_errors.endpoint_m.mean()
    assert 0.9 < result.sigma_px < 2.0
    plain = errors_of(problem, solve_lines(problem, replace(BEST, start='svd', gate=None)))
    assert np.nanmean(plain.perpendicular_m) > 5 * errors.perpendicular_m.mean()


def test_views_over_the_gate_do_not_cost(rng):
    problem = noisy(experiment_of(scene(rng, 8), walk(15)), 2.0)
    for use_host in (True, False):
        result = solve_lines(problem, Method(loss=Loss.L2, sigma_px=2.0, gate=6.0, use_host=use_host))
        assert 3 < result.outliers.sum() < 20
        for i in range(8):
            s = np.sum((residuals(problem, result.pluecker, i)[0 if use_host else 1:] / 2.0) ** 2, axis=1)
            counted = np.sort(s)[:len(s) - result.outliers[i]]
            assert result.cost[i] == pytest.approx(0.5 * counted.sum(), rel=1e-2)


@pytest.mark.row(31)
@pytest.mark.parametrize('rule', END_RULES)
def test_every_rule_finds_the_ends_of_full_views_without_noise(rng, rule):
    experiment = experiment_of(scene(rng, 10), walk(9))
    swapped = experiment.views.ends.copy()
    swapped[::4] = swapped[::4, ::-1]
    problem = LineProblem.of(replace(experiment, views=replace(experiment.views, ends=swapped)))
    lines = unit_direction(line_from_points(problem.segments[:, 0], problem.segments[:, 1]))
    found = find_ends(problem, lines, rule, 0.1, 1e-6)
    np.testing.assert_allclose(found, problem.segments, atol=1e-8)


@pytest.mark.row(32)
@pytest.mark.trap('partial views', 'line longer than 8 m', 'one bad frame')
def test_partial_views_of_a_long_line_recover_it_and_one_bad_frame_stops_nothing():
    """Each end is reached by a sixth of the views; one view shows something else."""
    segments = np.array([[[-6.0, 0.5, 6.0], [6.0, -0.5, 7.0]], [[-5.0, -1.0, 8.0], [5.0, 1.5, 6.0]]])
    T_WC = walk(60)

    def shown(frame, line):
        a, b = segments[line]
        if frame == 20:
            return np.array([a, a + [0.2, 3.0, 0.0]])
        low, high = ((0.0, 0.4), (0.3, 0.7), (0.35, 0.6), (0.2, 0.7), (0.6, 1.0), (0.4, 0.8))[frame % 6]
        return np.array([a + low * (b - a), a + high * (b - a)])

    problem = noisy(experiment_of(segments, T_WC, shown), 0.5)
    error = {}
    for rule in END_RULES:
        result = solve_lines(problem, replace(BEST, ends=rule, gate=None, loss=Loss.HUBER))
        assert result.ok.all()
        error[rule] = errors_of(problem, result).endpoint_m.max()
    assert error['vote'] < 0.05 and error['vote'] < 0.5 * error['extend']
    assert min(error['shrink'], error['median']) > 1.0


@pytest.mark.row(33)
@pytest.mark.trap('near end-on views')
def test_a_view_that_shows_no_end_costs_itself_only():
    """The second camera stands between the ends, so that one of them is behind it; the third looks along the line."""
    segments = np.array([[[-2.0, 0.5, 0.0], [2.0, 0.5, 0.0]]])
    looks_right = so3_exp([0.0, np.pi / 2, 0.0])  # z is the world's x
    T_WC = rigid(np.stack([np.eye(3), looks_right, looks_right, np.eye(3)]),
                 [[0.0, 0.0, -3.0], [0.0, 0.0, 0.0], [-9.0, 0.4, 0.0], [1.0, 1.0, -3.0]])
    problem = LineProblem.of(experiment_of(segments, T_WC))
    lines = unit_direction(line_from_points(segments[:, 0], segments[:, 1]))
    usable = np.isfinite(extents_of_views(problem, lines)).all(axis=1)
    assert usable.tolist() == [True, False, False, True]
    for rule in END_RULES:
        np.testing.assert_allclose(find_ends(problem, lines, rule, 0.5, 1e-6), segments, atol=1e-8)


@pytest.mark.row(32)
@pytest.mark.parametrize('rule', END_RULES)
@pytest.mark.parametrize('away, reason', [(99.0, ''), (101.0, NO_ENDS)])
def test_feet_further_than_a_hundred_metres_from_the_camera_are_not_used(rule, away, reason):
    segments = np.array([[[-1.0, -2.0, away], [1.0, 2.0, away]]])
    T_WC = rigid(np.eye(3), np.linspace([-4.0, 0.0, 0.0], [4.0, 0.0, 0.0], 5))
    problem = LineProblem.of(experiment_of(segments, T_WC))
    lines = unit_direction(line_from_points(segments[:, 0], segments[:, 1]))
    found = find_ends(problem, lines, rule, 0.1, 1e-6)
    np.testing.assert_allclose(found, segments if not reason else np.full((1, 2, 3), np.nan), atol=1e-8)
    assert solve_lines(problem, replace(BEST, ends=rule)).reason.tolist() == [reason]


def test_a_rule_that_is_none_is_refused(rng):
    problem = LineProblem.of(experiment_of(scene(rng, 2), walk(3)))
    with pytest.raises(ValueError, match='rule for end points must be one of'):
        find_ends(problem, np.ones((2, 6)), 'guess', 0.1, 1e-3)
    with pytest.raises(ValueError, match='start must be one of two-plane'):
        start_lines(problem, 'guess', 1.0)


@pytest.mark.row(40)
def test_errors_of_a_line_turned_and_shifted_by_known_amounts():
    segments = np.array([[[0, 0, 2], [0, 0, 6]], [[1, 0, 2], [1, 0, 6]], [[0, 3, 2], [0, 3, 6]]], float)
    ends = segments.copy()
    ends[0, :, 0] += 0.03  # 3 cm to the side
    ends[1] = ends[1, ::-1] + [0.0, 0.0, 0.1]  # 10 cm along, ends swapped
    turned = so3_exp([np.radians(2.0), 0, 0])
    ends[2] = (segments[2] - [0, 3, 4]) @ turned.T + [0, 3, 4]
    errors = score(segments, line_from_points(ends[:, 0], ends[:, 1]), ends)
    np.testing.assert_allclose(errors.angle_deg, [0, 0, 2], atol=1e-12)
    np.testing.assert_allclose(errors.perpendicular_m, [0.03, 0, 2 * np.sin(np.radians(2))], atol=1e-12)
    np.testing.assert_allclose(errors.endpoint_m, [0.03, 0.1, 4 * np.sin(np.radians(1))], atol=1e-12)
    figures = errors.summary()
    assert figures['angle_deg_mean'] == pytest.approx(2 / 3) and figures['angle_deg_max'] == pytest.approx(2)
    assert figures['endpoint_m_max'] == pytest.approx(0.1)


@pytest.mark.row(40)
def test_lines_without_an_estimate_do_not_enter_the_means():
    segments = np.array([[[0, 0, 2], [0, 0, 6]], [[1, 0, 2], [1, 0, 6]]], float)
    lines, ends = line_from_points(segments[:, 0], segments[:, 1]), segments.copy()
    lines[1], ends[1] = np.nan, np.nan
    errors = score(segments, lines, ends)
    assert np.isnan(errors.angle_deg[1]) and errors.summary()['perpendicular_m_max'] == pytest.approx(0.0, abs=1e-12)
    nothing = score(segments, np.full((2, 6), np.nan), np.full((2, 2, 3), np.nan)).summary()
    assert np.isnan(list(nothing.values())).all()


@pytest.mark.row(41)
def test_a_sweep_runs_every_method_at_every_noise_and_seed(rng):
    experiment = experiment_of(scene(rng, 8), walk(10))
    methods = {'two': replace(BEST, form=LineForm.HOST, sigma_px=2.0), 'four': replace(BEST, joint=True, sigma_px=2.0)}
    runs = sweep(experiment, methods, [0.0, 1.0, 3.0], [4, 5])
    assert [(r.noise_px, r.seed, r.method) for r in runs] == [(0.0, 4, 'two'), (0.0, 4, 'four')] + [
        (px, seed, name) for px in (1.0, 3.0) for seed in (4, 5) for name in methods]
    again = sweep(experiment, methods, [3.0], [5])
    assert [r.cost for r in again] == [r.cost for r in runs[-2:]]
    assert all(r.lines == 8 and r.failures == 0 and r.solve_s > 0 and r.iterations > 0 for r in runs)
    mean = means(runs)
    assert [(m.noise_px, m.method, m.seed) for m in mean[2:4]] == [(1.0, 'two', 2), (1.0, 'four', 2)]
    assert mean[3].angle_deg_mean == pytest.approx((runs[3].angle_deg_mean + runs[5].angle_deg_mean) / 2)
    assert mean[3].angle_deg_max == max(runs[3].angle_deg_max, runs[5].angle_deg_max)
    assert mean[1].endpoint_m_mean < mean[3].endpoint_m_mean < mean[5].endpoint_m_mean


@pytest.mark.row(41)
def test_a_run_tells_the_figures_of_its_result(rng):
    problem = noisy(experiment_of(scene(rng, 8), walk(15)), 2.0)
    started = perf_counter()
    result = solve_lines(problem, Method(sigma_px=2.0, gate=6.0))
    elapsed = perf_counter() - started
    assert result.start_s > 0.0 and result.solve_s > 0.0 and result.start_s + result.solve_s < elapsed
    run = summarise(problem, result, 'name', 2.0, 3)
    assert (run.noise_px, run.seed, run.method, run.lines, run.failures) == (2.0, 3, 'name', 8, 0)
    assert run.outliers == result.outliers.sum() > 3
    assert (run.cost, run.sigma_px, run.iterations) == (result.total_cost, result.sigma_px, result.iterations)
    assert (run.start_s, run.solve_s) == (result.start_s, result.solve_s)


@pytest.mark.row(41)
@pytest.mark.parametrize('method', [AUTHORS, BEST])
def test_timing_takes_the_best_of_equal_fits_of_so_many_joint_steps(rng, monkeypatch, method):
    problem, fits, given = noisy(experiment_of(scene(rng, 8), walk(10)), 1.0), [], []

    def recorded(problem, method, rows, values):
        given.append(values.copy())
        fits.append(fit(problem, method, rows, values))
        return fits[-1]

    monkeypatch.setattr('line_slam_ros.experiment.sweep.fit', recorded)
    assert time_joint(problem, method, iterations=4, repeats=3) == min(f.seconds for f in fits)
    assert len(fits) == 3 and all(np.array_equal(values, given[0]) for values in given)
    assert all((f.steps == 4).all() and f.counted.all() for f in fits)


@pytest.mark.parametrize(('wrong', 'message'), [
    ({'start': 'guess'}, 'start must be one of two-plane, best-parallax, svd, consensus, truth, got'),
    ({'ends': 'guess'}, 'ends must be one of'), ({'loss_scale': 0.0}, 'loss_scale must be positive'),
    ({'sigma_px': -1.0}, 'sigma_px must be positive'), ({'focal': np.nan}, 'focal must be positive'),
    ({'iterations': 0}, 'at least one iteration'), ({'tolerance': -1.0}, 'tolerance must not be negative'),
    ({'end_share': 0.7}, 'end_share must lie in')])
def test_settings_that_mean_nothing_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        Method(**wrong)
