"""All forms of a line behind one interface: the same line, a true tangent, the same residual and optimum."""
import numpy as np
import pytest

from line_slam_ros.geometry import host_line, lines, orthonormal
from line_slam_ros.geometry.lie import so3_exp
from line_slam_ros.geometry.line_forms import (
    VALUES,
    freedom,
    move_line,
    store_line,
    store_lines,
    unit_world_lines,
    world_line,
)
from line_slam_ros.types import LINE_FORMS, LineForm

FOUR = [form for form in LineForm if form is not LineForm.HOST]
FRAMED = [LineForm.ORTHONORMAL, LineForm.ORTHONORMAL_LEFT, LineForm.PLUECKER]
HOSTED = [LineForm.HOST, LineForm.HOST_FREE]
ORIGIN = np.array([3.0, -2.0, 100.0])


@pytest.fixture
def rng():
    return np.random.default_rng(31)


def evaluate(form, values, origin=ORIGIN):
    n, d, J = np.full(3, np.nan), np.full(3, np.nan), np.full((6, 4), np.nan)
    world_line(int(form), values, origin, n, d, J)
    return np.concatenate([n, d]), J


def moved(form, values, step):
    out = np.full(VALUES, np.nan)
    move_line(int(form), values, np.concatenate([step, np.zeros(4 - len(step))]), out)
    return out


def seen_from(rng, a_H, b_H):
    """R_WH, ends_H and the line about the host's centre, axes of W, of two points in the host camera."""
    R_WH = so3_exp(rng.normal(size=3))
    p = np.array([a_H, b_H], float)
    return R_WH, p[:, :2] / p[:, 2:], lines.line_from_points(*(p @ R_WH.T))


def stored(form, rng, a_H=(-1.0, 0.3, 4.0), b_H=(1.5, -0.4, 6.0)):
    R_WH, ends_H, L = seen_from(rng, a_H, b_H)
    values = np.full(VALUES, np.nan)
    assert store_line(int(form), L[:3], L[3:], R_WH, ends_H, values)
    return values, L


def up_to_scale(L):
    return L / np.linalg.norm(L) * np.sign(L[np.argmax(np.abs(L))])


def test_forms_go_by_their_names():
    assert [LineForm.of(name) for name in LINE_FORMS] == list(LineForm)
    assert [LineForm.of(name).freedom for name in ('orthonormal', 'host', 'host_free')] == [4, 2, 4]
    assert all(freedom(int(form)) == form.freedom for form in LineForm)
    with pytest.raises(ValueError, match="orthonormal, .*, host_free, got 'quaternion'"):
        LineForm.of('quaternion')


@pytest.mark.row(3, 4, 30)
@pytest.mark.parametrize('form', LineForm)
@pytest.mark.parametrize('shift', [np.zeros(3), ORIGIN])
def test_every_form_gives_back_the_line_it_stores(rng, form, shift):
    values, L = stored(form, rng)
    expected = L + np.concatenate([np.cross(shift, L[3:]), np.zeros(3)])
    np.testing.assert_allclose(up_to_scale(evaluate(form, values, shift)[0]), up_to_scale(expected), atol=1e-12)


@pytest.mark.parametrize('form', LineForm)
def test_batches_are_the_single_ones_with_unit_direction(rng, form):
    cases = [seen_from(rng, rng.normal(size=3) + [0, 0, 5], rng.normal(size=3) + [0, 0, 5]) for _ in range(9)]
    R_WH, ends_H, L = (np.array(column) for column in zip(*cases, strict=True))
    values, ok = np.empty((9, VALUES)), np.zeros(9, bool)
    store_lines(int(form), L, R_WH, ends_H, values, ok)
    assert ok.all()
    found, J = unit_world_lines(int(form), values, np.tile(ORIGIN, (9, 1)))
    for k in range(9):
        single, _ = evaluate(form, values[k])
        np.testing.assert_allclose(found[k], single / np.linalg.norm(single[3:]), atol=1e-12)
        step = 1e-6 * rng.normal(size=4)
        after, before = (evaluate(form, moved(form, values[k], sign * step))[0] for sign in (1, -1))
        change = after / np.linalg.norm(after[3:]) - before / np.linalg.norm(before[3:])
        np.testing.assert_allclose(2 * J[k] @ step, change, atol=1e-8 * np.abs(change).max() + 1e-12)


NEAR = {'general': ((-1.0, 0.3, 4.0), (1.5, -0.4, 6.0)), 'far': ((-300.0, 30.0, 900.0), (200.0, 0.0, 1000.0)),
        'near': ((-0.01, 0.02, 0.1), (0.02, 0.02, 0.12)), 'steep': ((0.02, 0.0, 2.0), (0.3, 0.001, 6.0))}


@pytest.mark.row(15)
@pytest.mark.parametrize('form', LineForm)
@pytest.mark.parametrize('where', NEAR)
def test_tangent_is_the_derivative_of_the_move(rng, form, where):
    values, _ = stored(form, rng, *NEAR[where])
    step = 1e-6 * np.eye(4)
    _, J = evaluate(form, values)
    for k in range(form.freedom):
        numeric = (evaluate(form, moved(form, values, step[k]))[0] - evaluate(form, moved(form, values, -step[k]))[0])
        np.testing.assert_allclose(J[:, k], numeric / 2e-6, atol=1e-6 * max(1.0, np.abs(J).max()))
    np.testing.assert_array_equal(J[:, form.freedom:], 0.0)


ODD = {'through the origin': [0.0, 0, 0, 1, 2, 3], 'n parallel to z': [0.0, 0, 2, 1, 0, 0],
       'nearly through the origin': [0.0, 0, -1e-9, 0, 1, 0], 'far': [1e3, 0, 0, 0, 1, 0]}
ANY_SEGMENT = np.array([[0.0, 0.0], [0.1, 0.0]])


@pytest.mark.row(3, 6)
@pytest.mark.trap('plane z = 0')
@pytest.mark.trap('line through the origin')
@pytest.mark.trap('phi across 0 and pi/2')
@pytest.mark.parametrize('form', FRAMED)
@pytest.mark.parametrize('L', ODD.values(), ids=ODD)
def test_forms_without_singularity_hold_and_move_any_line(form, L):
    L, values = np.array(L, float), np.empty(VALUES)
    assert store_line(int(form), L[:3], L[3:], np.eye(3), ANY_SEGMENT, values)
    np.testing.assert_allclose(up_to_scale(evaluate(form, values, np.zeros(3))[0]), up_to_scale(L), atol=1e-13)
    for sign in (1.0, -1.0):  # phi passes pi / 2 without a fold
        there = moved(form, values, [0.0, 0.0, 0.0, sign * 0.3])
        back = moved(form, there, [0.0, 0.0, 0.0, -sign * 0.3])
        if form is not LineForm.PLUECKER:  # its frame is chosen anew where n = 0
            np.testing.assert_allclose(up_to_scale(evaluate(form, back, np.zeros(3))[0]), up_to_scale(L), atol=1e-13)
        assert np.isfinite(there).all()


@pytest.mark.row(4)
@pytest.mark.trap('plane z = 0')
@pytest.mark.trap('line through the origin')
@pytest.mark.parametrize('L', [[0, 0, 0, 1.0, 2, 3], [0.0, 0, 2, 1, 0, 0], [1.0, 0, 0, 0, 0, 0]])
def test_orth4_refuses_lines_near_its_singularities(L):
    L = np.array(L, float)
    assert not store_line(int(LineForm.ORTH4), L[:3], L[3:], np.eye(3), ANY_SEGMENT, np.empty(VALUES))


@pytest.mark.row(4)
def test_orth4_moved_into_gimbal_lock_is_not_a_number():
    U = so3_exp([0.0, 0.5, 0.0])
    values = np.zeros(VALUES)
    values[:4] = orthonormal.orth4_from_orthonormal(U, 0.7)
    assert np.isnan(moved(LineForm.ORTH4, values, [0.0, np.pi / 2 - 0.5, 0.0, 0.0])).all()


@pytest.mark.row(33)
@pytest.mark.trap('points behind the camera')
@pytest.mark.parametrize('form', HOSTED)
def test_host_forms_refuse_a_line_behind_the_camera_or_along_the_ray(rng, form):
    ends = np.array([[-0.1, 0.0], [0.1, 0.0]])
    for L in (lines.line_from_points([-1.0, 0, -4], [1.0, 0, -4]), lines.line_through([0.0, 0, 0], [0.0, 0, 1])):
        assert not store_line(int(form), L[:3], L[3:], np.eye(3), ends, np.empty(VALUES))


@pytest.mark.parametrize('form', HOSTED)
def test_host_forms_never_step_behind_the_camera(rng, form):
    values, _ = stored(form, rng)
    assert moved(form, values, [0.0, -100.0])[10] == pytest.approx(0.2 * values[10])


def test_host_form_keeps_its_plane_and_the_free_one_tilts_it(rng):
    pinned, _ = stored(LineForm.HOST, rng)
    step = np.array([0.1, 0.02, 0.3, -0.2])
    np.testing.assert_array_equal(moved(LineForm.HOST, pinned, step)[:9], pinned[:9])
    tilted = moved(LineForm.HOST_FREE, pinned, step)[:9].reshape(3, 3)
    np.testing.assert_allclose(tilted, pinned[:9].reshape(3, 3) @ so3_exp([0.3, -0.2, 0.0]), atol=1e-14)


@pytest.mark.row(6, 15, 19)
def test_compiled_forms_agree_with_the_batched_mathematics(rng):
    values, L = stored(LineForm.ORTHONORMAL, rng)
    U, phi = orthonormal.orthonormal_from_pluecker(L)
    np.testing.assert_allclose(values[:10], np.append(U.ravel(), phi), atol=1e-14)
    step = rng.normal(size=4)
    for form, jacobian, plus in (
            (LineForm.ORTHONORMAL, orthonormal.jacobian_right, orthonormal.plus_right),
            (LineForm.ORTHONORMAL_LEFT, orthonormal.jacobian_left, orthonormal.plus_left)):
        np.testing.assert_allclose(evaluate(form, values, np.zeros(3))[1], jacobian(U, phi), atol=1e-14)
        U_new, phi_new = plus(U, phi, step)
        np.testing.assert_allclose(moved(form, values, step)[:10], np.append(U_new.ravel(), phi_new), atol=1e-12)
    values, _ = stored(LineForm.ORTH4, rng)
    expected = orthonormal.orth4_plus(values[:4], 0.1 * step)
    np.testing.assert_allclose(moved(LineForm.ORTH4, values, 0.1 * step)[:4], expected, atol=1e-12)


@pytest.mark.row(20, 30)
def test_compiled_host_form_agrees_with_the_batched_mathematics(rng):
    R_WH, ends_H, L = seen_from(rng, (-1.0, 0.3, 4.0), (1.5, -0.4, 6.0))
    values = np.empty(VALUES)
    assert store_line(int(LineForm.HOST), L[:3], L[3:], R_WH, ends_H, values)
    R_HL, L_H = host_line.host_frame(ends_H), np.concatenate([L[:3] @ R_WH, L[3:] @ R_WH])
    rho_theta = host_line.rho_theta_from_pluecker(L_H, R_HL)
    np.testing.assert_allclose(values, np.concatenate([(R_WH @ R_HL).ravel(), rho_theta[::-1]]), atol=1e-13)
    found, J = evaluate(LineForm.HOST, values, np.zeros(3))
    L_H = np.concatenate([found[:3] @ R_WH, found[3:] @ R_WH])
    np.testing.assert_allclose(L_H, host_line.pluecker_from_rho_theta(rho_theta, R_HL), atol=1e-13)
    J_H = np.concatenate([R_WH.T @ J[:3, :2], R_WH.T @ J[3:, :2]])
    np.testing.assert_allclose(J_H, host_line.jacobian(rho_theta, R_HL)[:, ::-1], atol=1e-13)
    step = np.array([3.0, 0.01])
    np.testing.assert_allclose(moved(LineForm.HOST, values, step)[9:], host_line.plus(rho_theta, step[::-1])[::-1])
