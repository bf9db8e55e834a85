"""The four-parameter line: round trips, updates without folds, derivatives, and the chart with singularities."""
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from line_slam_ros.geometry import lines, orthonormal
from line_slam_ros.geometry.lie import so3_exp

repeatable = settings(deadline=None, derandomize=True)
vec3 = arrays(float, 3, elements=st.floats(-100, 100, allow_subnormal=False))

LINES = {
    'general': lines.line_through([1.0, -2.0, 0.5], [0.3, 0.4, -0.5]),
    'in the plane z = 0': lines.line_through([1.0, 2.0, 0.0], [0.6, -0.8, 0.0]),
    'along z': lines.line_through([3.0, 1.0, 0.0], [0.0, 0.0, 1.0]),
    'through the origin': lines.line_through([0.0, 0.0, 0.0], [0.6, 0.0, 0.8]),
    'nearly through the origin': lines.line_through([1e-10, 0.0, 0.0], [0.0, 0.6, 0.8]),
    'at infinity': np.array([0.0, 0.6, 0.8, 0.0, 0.0, 0.0]),
    'far': lines.line_through([1e9, 0.0, 0.0], [0.0, 0.6, 0.8]),
}


def normed(L):
    return L / np.linalg.norm(L, axis=-1, keepdims=True)


def numeric(function, size, h=1e-6):
    return np.stack([(function(h * e) - function(-h * e)) / (2 * h) for e in np.eye(size)], axis=-1)


@pytest.mark.row(3)
@pytest.mark.trap('plane z = 0')
@pytest.mark.trap('line through the origin')
@pytest.mark.parametrize('name', LINES)
def test_round_trip_returns_the_line_also_where_the_frame_is_not_unique(name):
    U, phi = orthonormal.orthonormal_from_pluecker(LINES[name])
    np.testing.assert_allclose(U.T @ U, np.eye(3), atol=1e-14)
    assert np.linalg.det(U) == pytest.approx(1)
    np.testing.assert_allclose(orthonormal.pluecker_from_orthonormal(U, phi), normed(LINES[name]), atol=1e-12)


@pytest.mark.row(3)
@repeatable
@given(vec3, vec3)
def test_round_trip_of_any_line(p, d):
    assume(np.linalg.norm(d) > 1e-3)
    L = lines.line_through(p, d)
    U, phi = orthonormal.orthonormal_from_pluecker(L)
    np.testing.assert_allclose(U.T @ U, np.eye(3), atol=1e-13)
    np.testing.assert_allclose(orthonormal.pluecker_from_orthonormal(U, phi), normed(L), atol=1e-12)


def test_distance_is_the_cotangent_of_phi():
    _, phi = orthonormal.orthonormal_from_pluecker(LINES['general'])
    assert 1 / np.tan(phi) == pytest.approx(np.linalg.norm(lines.closest_point(LINES['general'])))


def test_a_moment_not_quite_perpendicular_becomes_so():
    L = LINES['general'] + 1e-6 * np.arange(6)
    U, phi = orthonormal.orthonormal_from_pluecker(L)
    found = orthonormal.pluecker_from_orthonormal(U, phi)
    assert found[:3] @ found[3:] == pytest.approx(0, abs=1e-15)
    np.testing.assert_allclose(found, normed(L), atol=1e-5)


def test_six_zeros_are_no_line():
    U, phi = orthonormal.orthonormal_from_pluecker(np.zeros(6))
    assert np.isnan(U).any() and np.isnan(orthonormal.pluecker_from_orthonormal(U, phi)).any()


def test_batch_axes_are_kept():
    L = np.stack(list(LINES.values()))[:6].reshape(2, 3, 6)
    U, phi = orthonormal.orthonormal_from_pluecker(L)
    assert U.shape == (2, 3, 3, 3) and phi.shape == (2, 3)
    assert orthonormal.jacobian_right(U, phi).shape == orthonormal.jacobian_left(U, phi).shape == (2, 3, 6, 4)
    for index in np.ndindex(2, 3):
        single_U, single_phi = orthonormal.orthonormal_from_pluecker(L[index])
        np.testing.assert_allclose(U[index], single_U, atol=1e-15)
        np.testing.assert_allclose(orthonormal.jacobian_right(U, phi)[index],
                                   orthonormal.jacobian_right(single_U, single_phi), atol=1e-15)


@pytest.mark.row(15)
@pytest.mark.parametrize('name', LINES)
@pytest.mark.parametrize('side', ['right', 'left'])
def test_jacobian_is_the_derivative_of_the_update(name, side):
    plus, jacobian = getattr(orthonormal, f'plus_{side}'), getattr(orthonormal, f'jacobian_{side}')
    U, phi = orthonormal.orthonormal_from_pluecker(LINES[name])

    def moved(delta):
        return orthonormal.pluecker_from_orthonormal(*plus(U, phi, delta))

    np.testing.assert_allclose(jacobian(U, phi), numeric(moved, 4), atol=1e-9)


@pytest.mark.row(15)
@pytest.mark.trap('phi across 0 and pi/2')
@pytest.mark.parametrize('phi', [-0.3, 0.0, np.pi / 2, 1.9])
def test_jacobians_hold_beyond_the_usual_range_of_phi(phi):
    U = so3_exp([0.3, -1.0, 2.0])
    for plus, jacobian in ((orthonormal.plus_right, orthonormal.jacobian_right),
                           (orthonormal.plus_left, orthonormal.jacobian_left)):
        found = numeric(lambda delta, plus=plus: orthonormal.pluecker_from_orthonormal(*plus(U, phi, delta)), 4)
        np.testing.assert_allclose(jacobian(U, phi), found, atol=1e-9)


@pytest.mark.row(6)
def test_left_and_right_updates_are_the_same_motion_seen_from_both_sides():
    U, phi, delta = so3_exp([0.3, -1.0, 2.0]), 0.7, np.array([0.4, -0.2, 0.9, 0.1])
    turned = np.concatenate([U @ delta[:3], delta[3:]])
    for left, right in zip(orthonormal.plus_left(U, phi, turned), orthonormal.plus_right(U, phi, delta), strict=True):
        np.testing.assert_allclose(left, right, atol=1e-14)


@pytest.mark.row(6)
@pytest.mark.parametrize('plus', [orthonormal.plus_right, orthonormal.plus_left])
def test_a_thousand_updates_stay_in_so3(plus):
    U, phi = orthonormal.orthonormal_from_pluecker(LINES['general'])
    for delta in 0.5 * np.random.default_rng(0).normal(size=(1000, 4)):
        U, phi = plus(U, phi, delta)
    np.testing.assert_allclose(U.T @ U, np.eye(3), atol=3e-15)
    assert np.linalg.det(U) == pytest.approx(1)


@pytest.mark.row(6)
@pytest.mark.trap('phi across 0 and pi/2')
@pytest.mark.parametrize('start', [0.0, np.pi / 2])
def test_phi_passes_zero_and_a_right_angle_without_a_fold(start):
    U = so3_exp([0.3, -1.0, 2.0])
    before, after = (orthonormal.pluecker_from_orthonormal(*orthonormal.plus_right(U, start, [0, 0, 0, step]))
                     for step in (-1e-4, 1e-4))
    assert np.linalg.norm(after - before) == pytest.approx(2e-4, rel=1e-6)


@pytest.mark.row(4)
@pytest.mark.parametrize('name', ['general', 'along z'])
def test_euler_form_round_trip(name):
    orth4 = orthonormal.orth4_from_pluecker(LINES[name])
    found = orthonormal.pluecker_from_orthonormal(*orthonormal.orthonormal_from_orth4(orth4))
    np.testing.assert_allclose(found, normed(LINES[name]), atol=1e-12)


@pytest.mark.row(5)
def test_point_and_direction_survive_the_euler_form():
    p, d = np.array([1.0, 2.0, 3.0]), np.array([0.6, 0.0, -0.8])
    orth4 = orthonormal.orth4_from_pluecker(lines.line_through(p, d))
    L = lines.unit_direction(orthonormal.pluecker_from_orthonormal(*orthonormal.orthonormal_from_orth4(orth4)))
    np.testing.assert_allclose(L[3:], d, atol=1e-14)
    np.testing.assert_allclose(lines.closest_point(L, p), p, atol=1e-13)


@pytest.mark.row(4)
@pytest.mark.trap('plane z = 0')
@pytest.mark.trap('line through the origin')
@pytest.mark.parametrize('name, message', [('in the plane z = 0', 'parallel to z'), ('through the origin', 'origin'),
                                           ('nearly through the origin', 'origin'), ('at infinity', 'infinity')])
def test_euler_form_raises_where_it_cannot_hold_the_line(name, message):
    with pytest.raises(ValueError, match=message):
        orthonormal.orth4_from_pluecker(LINES[name])


@pytest.mark.row(19)
def test_euler_form_takes_the_same_right_update_as_the_frame():
    orth4, delta = np.array([0.3, -0.9, 2.0, 0.6]), np.array([0.2, 0.1, -0.3, 0.05])
    expected = orthonormal.plus_right(*orthonormal.orthonormal_from_orth4(orth4), delta)
    found = orthonormal.orthonormal_from_orth4(orthonormal.orth4_plus(orth4, delta))
    for part, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(part, wanted, atol=1e-14)


@pytest.mark.row(19)
@pytest.mark.parametrize('ay', [0.0, 1.0, -1.5])
def test_ambient_jacobian_of_the_euler_form_is_the_derivative_of_its_update(ay):
    orth4 = np.array([0.3, ay, 1.0, 0.6])
    found = numeric(lambda delta: orthonormal.orth4_plus(orth4, delta), 4)
    np.testing.assert_allclose(orthonormal.orth4_plus_jacobian(orth4), found, rtol=1e-6, atol=1e-8)


@pytest.mark.row(19)
def test_ambient_and_tangent_jacobians_chain_to_the_same_derivative():
    """d L / d orth4 times d orth4 / d delta is d L / d delta: the two kinds are not interchangeable."""
    orth4 = np.array([0.3, -0.9, 2.0, 0.6])
    ambient = numeric(lambda step: orthonormal.pluecker_from_orthonormal(
        *orthonormal.orthonormal_from_orth4(orth4 + step)), 4)
    tangent = orthonormal.jacobian_right(*orthonormal.orthonormal_from_orth4(orth4))
    np.testing.assert_allclose(ambient @ orthonormal.orth4_plus_jacobian(orth4), tangent, atol=1e-8)
    assert np.abs(ambient - tangent).max() > 0.1


@pytest.mark.row(4, 19)
def test_euler_form_raises_at_gimbal_lock():
    with pytest.raises(ValueError, match='gimbal'):
        orthonormal.orth4_plus_jacobian([0.3, np.pi / 2, 1.0, 0.6])
    with pytest.raises(ValueError, match='parallel to z'):
        orthonormal.orth4_plus([0.3, np.pi / 2 - 0.1, 0.0, 0.6], _turn_to_lock())


def _turn_to_lock():
    """The right update that takes (0.3, pi/2 - 0.1, 0) to ay = pi/2."""
    U, _ = orthonormal.orthonormal_from_orth4([0.3, np.pi / 2 - 0.1, 0.0, 0.6])
    return np.concatenate([U.T @ [0.0, 0.1, 0.0], [0.0]])
