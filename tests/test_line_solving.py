"""What solving lines owes to who asks: no answer without agreement, no silence about a fit that did not end."""
from dataclasses import replace

import numpy as np
import pytest
from bag_samples import line_slam

from line_slam_ros.benchmark import line_speed
from line_slam_ros.experiment.files import Experiment, LineViews
from line_slam_ros.experiment.methods import PRESETS, Method
from line_slam_ros.experiment.problem import LineProblem
from line_slam_ros.experiment.score import score
from line_slam_ros.experiment.solving import CONTRADICTED, solve_lines
from line_slam_ros.experiment.sweep import means, summarise, time_joint
from line_slam_ros.simulation.house import Effects, Pinhole, closed_loop, observe, random_house
from line_slam_ros.types import LineForm


def house(seed=2, lines=40, frames=40, **effects):
    segments, (stamps, T_WC) = random_house(seed, lines), closed_loop(seed, frames)
    views = observe(segments, T_WC, Pinhole.centred(), Effects(**effects), seed)
    return Experiment(T_WC, stamps, segments, LineViews(*views))


@pytest.fixture(scope='module')
def doubtful():
    """Few views of each line, and a third of them of another one."""
    return LineProblem.of(house(noise_px=1.0, outliers=0.35))


def test_a_line_that_most_of_its_views_contradict_has_no_answer(doubtful):
    result = solve_lines(doubtful, PRESETS['best'])
    contradicted = result.reason == CONTRADICTED
    assert contradicted.sum() >= 5
    for a in (result.pluecker, result.ends, result.cost):
        assert np.isnan(a[contradicted]).all()
    left = doubtful.count - result.outliers
    assert (2 * left[result.ok] > 4).all() and (left[result.ok] > 0.5 * doubtful.count[result.ok]).all()
    assert score(doubtful.segments, result.pluecker, result.ends).perpendicular_m[result.ok].max() < 0.5


@pytest.mark.parametrize('wrong', [{'gate': 1e-9}, {'sigma_px': 1e-300}])
def test_a_gate_that_no_view_passes_leaves_no_line_and_says_why(doubtful, wrong):
    result = solve_lines(doubtful, replace(PRESETS['best'], **wrong))
    assert not result.ok.any() and (result.reason == CONTRADICTED).sum() > 30


def test_the_scatter_is_the_same_whatever_form_found_it():
    problem = LineProblem.of(house(noise_px=2.0, frames=100))
    found = [solve_lines(problem, Method(form=form)).sigma_px for form in LineForm if form.freedom == 4]
    np.testing.assert_allclose(found, found[0], rtol=1e-6)
    assert found[0] == pytest.approx(2.0, rel=0.1)  # few views: part of the noise is fitted


def test_a_fit_cut_short_is_told():
    problem = LineProblem.of(house(noise_px=1.0, frames=100))
    whole, cut = (solve_lines(problem, Method(iterations=n, sigma_px=1.0)) for n in (200, 1))
    assert whole.converged[whole.ok].all()
    assert not cut.converged.any()
    assert summarise(problem, cut, 'cut', 1.0, 0).unconverged == cut.ok.sum()


def test_means_do_not_depend_on_the_order_of_seeds_nor_on_one_without_an_answer(doubtful):
    good = summarise(doubtful, solve_lines(doubtful, PRESETS['best']), 'best', 1.0, 0)
    bad = summarise(doubtful, solve_lines(doubtful, replace(PRESETS['best'], gate=1e-9)), 'best', 1.0, 1)
    (one,), (other,) = means([good, bad]), means([bad, good])
    assert one.angle_deg_max == other.angle_deg_max == good.angle_deg_max
    assert one.perpendicular_m_mean == good.perpendicular_m_mean and one.failures == (good.failures + bad.failures) / 2
    assert set(one.failed) == set(bad.failed)


def test_a_sweep_lists_every_failure_and_every_fit_cut_short(tmp_path):
    line_slam('simulate', 'house', tmp_path / 'house', '--frames', 40, '--lines', 40, '--outliers', 0.35, '--seed', 2)
    code, out, err = line_slam('optimize-lines', tmp_path / 'house', '--noise-px', 0.5, 1, '--form', 'orthonormal',
                               '--per-line', '--iterations', 2, '--no-figure', '--output', tmp_path / 'out')
    assert code == 0, err
    assert f'line 11: {CONTRADICTED}' in out and 'used all the steps they may take' in out
    assert CONTRADICTED in (tmp_path / 'out' / 'sweep.json').read_text()


def test_nothing_to_time_is_an_error_and_not_zero_seconds():
    problem = LineProblem.of(house(frames=2, noise_px=1.0))
    nothing = problem.only(problem.frame == 0)
    with pytest.raises(ValueError, match='nothing to time'):
        time_joint(nothing, PRESETS['authors'])
    with pytest.raises(ValueError, match='nothing to time'):
        line_speed.measure(nothing, 1)


def test_many_lines_are_started_in_parts_as_in_one():
    problem = LineProblem.of(house(lines=120, frames=60, noise_px=1.0))
    some = problem.only(problem.line >= 110)
    whole, part = solve_lines(problem, Method(sigma_px=1.0)), solve_lines(some, Method(sigma_px=1.0))
    np.testing.assert_array_equal(whole.reason[110:], part.reason[110:])
    np.testing.assert_allclose(whole.pluecker[110:], part.pluecker[110:], atol=1e-9)
