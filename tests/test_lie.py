"""SO(3) and rigid transforms: properties over all angles, the compiled versions against the batched ones."""
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from line_slam_ros.geometry import lie, lie_kernels

repeatable = settings(deadline=None, derandomize=True)
ANGLES = [0.0, 1e-200, 1e-12, 1e-9, 1e-5, 9.99e-5, 1.01e-4, 9.9e-4, 1.01e-3, 0.1, 1.0, 2.0, 3.0,
          np.pi - 1e-4, np.pi - 1e-8, np.pi]
vec3 = arrays(float, 3, elements=st.floats(-10, 10, allow_subnormal=False))
quaternion = arrays(float, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 1e-3)


def axes(count=20):
    """Random unit vectors and the coordinate axes, which are the corners of the case distinctions."""
    v = np.random.default_rng(1).normal(size=(count, 3))
    return np.concatenate([v / np.linalg.norm(v, axis=1, keepdims=True), np.eye(3), -np.eye(3)])


def compiled(kernel, argument, shape):
    out = np.empty(shape)
    kernel(np.ascontiguousarray(argument, float), out)
    return out


def numeric_right_jacobian(w, h=1e-6):
    """Columns Log(Exp(w)' Exp(w + h e)) by central differences."""
    R_inverse = lie.so3_exp(w).T
    return np.stack([(lie.so3_log(R_inverse @ lie.so3_exp(w + h * e)) - lie.so3_log(R_inverse @ lie.so3_exp(w - h * e)))
                     / (2 * h) for e in np.eye(3)], axis=-1)


def random_pose(rng, batch=()):
    return lie.rigid(lie.so3_exp(rng.normal(size=(*batch, 3))), rng.normal(size=(*batch, 3)))


@repeatable
@given(vec3, vec3)
def test_hat_is_the_cross_product(a, b):
    np.testing.assert_allclose(lie.hat(a) @ b, np.cross(a, b), atol=1e-12)


@repeatable
@given(vec3)
def test_exp_is_a_rotation(w):
    R = lie.so3_exp(w)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)


@repeatable
@given(vec3)
def test_exp_of_minus_w_is_the_inverse(w):
    np.testing.assert_allclose(lie.so3_exp(-w), lie.so3_exp(w).T, atol=1e-12)


@pytest.mark.parametrize('angle', ANGLES)
def test_exp_agrees_with_scipy_at_every_angle(angle):
    w = angle * axes()
    np.testing.assert_allclose(lie.so3_exp(w), Rotation.from_rotvec(w).as_matrix(), atol=1e-14)


@pytest.mark.parametrize('angle', [a for a in ANGLES if a < np.pi])
def test_log_returns_the_vector_that_exp_took_near_zero_and_near_pi(angle):
    w = angle * axes()
    np.testing.assert_allclose(lie.so3_log(lie.so3_exp(w)), w, rtol=1e-12, atol=4e-15)


def test_log_at_pi_is_one_of_the_two_vectors_of_that_rotation():
    w = np.pi * axes()
    found = lie.so3_log(lie.so3_exp(w))
    sign = np.sign(np.sum(found * w, axis=-1, keepdims=True))
    np.testing.assert_allclose(sign * found, w, atol=1e-12)


@repeatable
@given(vec3)
def test_norm_of_log_is_at_most_pi(w):
    assert np.linalg.norm(lie.so3_log(lie.so3_exp(w))) <= np.pi + 1e-12


@pytest.mark.parametrize('function', [lie.hat, lie.so3_exp, lie.right_jacobian, lie.right_jacobian_inverse])
@pytest.mark.parametrize('batch', [(), (0,), (1,), (3, 2)])
def test_batch_axes_are_kept(function, batch):
    w = np.random.default_rng(0).normal(size=(*batch, 3))
    assert function(w).shape == (*batch, 3, 3)
    for index in np.ndindex(batch):
        np.testing.assert_array_equal(function(w)[index], function(w[index]))


@pytest.mark.parametrize('angle', ANGLES)
def test_right_jacobian_is_the_derivative_of_exp(angle):
    for w in angle * axes(5):
        np.testing.assert_allclose(lie.right_jacobian(w), numeric_right_jacobian(w), atol=1e-9)


@pytest.mark.parametrize('angle', ANGLES)
def test_right_jacobian_inverse_is_the_inverse(angle):
    w = angle * axes()
    product = lie.right_jacobian_inverse(w) @ lie.right_jacobian(w)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-9)


@pytest.mark.trap('quaternion not of unit length')
@repeatable
@given(quaternion)
def test_quaternion_round_trip_keeps_the_rotation_and_gives_positive_w(q_xyzw):
    unit = q_xyzw / np.linalg.norm(q_xyzw)
    found = lie.quaternion_from_matrix(lie.matrix_from_quaternion(q_xyzw))
    assert found[3] >= 0
    np.testing.assert_allclose(np.abs(found @ unit), 1, atol=1e-12)


@pytest.mark.trap('quaternion not of unit length')
def test_quaternions_agree_with_scipy_also_at_half_turns():
    w = np.concatenate([np.pi * axes(), 2.0 * axes()])
    q_xyzw = Rotation.from_rotvec(w).as_quat()
    R = Rotation.from_rotvec(w).as_matrix()
    np.testing.assert_allclose(lie.matrix_from_quaternion(3.0 * q_xyzw), R, atol=1e-14)
    found = lie.quaternion_from_matrix(lie.so3_exp(w))
    np.testing.assert_allclose(np.abs(np.sum(found * q_xyzw, axis=-1)), 1, atol=1e-14)


@pytest.mark.row(10)
def test_rigid_inverse_is_exact_and_batched():
    T_AB = random_pose(np.random.default_rng(2), (4, 5))
    np.testing.assert_allclose(T_AB @ lie.rigid_inverse(T_AB), np.broadcast_to(np.eye(4), T_AB.shape), atol=1e-14)


@pytest.mark.row(10, 11)
def test_neighbouring_letters_cancel_in_a_chain_of_frames():
    rng = np.random.default_rng(3)
    T_WB, T_BC, p_C = random_pose(rng), random_pose(rng), rng.normal(size=(7, 3))
    p_W = lie.transform_points(T_WB, lie.transform_points(T_BC, p_C))
    np.testing.assert_allclose(lie.transform_points(T_WB @ T_BC, p_C), p_W, atol=1e-14)
    T_CW = lie.rigid_inverse(T_WB @ T_BC)
    np.testing.assert_allclose(lie.transform_points(T_CW, p_W), p_C, atol=1e-14)


@pytest.mark.row(18)
def test_pose_plus_turns_on_the_right_and_adds_in_the_parent_frame():
    rng = np.random.default_rng(4)
    T_AB, delta = random_pose(rng, (6,)), rng.normal(size=(6, 6))
    moved = lie.pose_plus(T_AB, delta)
    np.testing.assert_allclose(lie.so3_log(np.swapaxes(T_AB[:, :3, :3], -1, -2) @ moved[:, :3, :3]),
                               lie.so3_log(lie.so3_exp(delta[:, :3])), atol=1e-13)
    np.testing.assert_allclose(moved[:, :3, 3] - T_AB[:, :3, 3], delta[:, 3:], atol=1e-15)


@pytest.mark.row(18)
@pytest.mark.parametrize('angle', [0.0, 1e-9, 1.0, 3.0])
def test_ambient_pose_jacobian_is_the_derivative_of_pose_plus(angle):
    T_AB = lie.rigid(lie.so3_exp(angle * axes(5)[0]), [1.0, -2.0, 3.0])

    def ambient(delta):
        moved = lie.pose_plus(T_AB, delta)
        return np.concatenate([moved[:3, 3], lie.quaternion_from_matrix(moved[:3, :3])])

    h = 1e-6
    numeric = np.stack([(ambient(h * e) - ambient(-h * e)) / (2 * h) for e in np.eye(6)], axis=-1)
    np.testing.assert_allclose(lie.pose_plus_jacobian(ambient(np.zeros(6))[3:]), numeric, atol=1e-9)


@pytest.mark.parametrize('angle', ANGLES)
@pytest.mark.parametrize('name, kernel', [('so3_exp', 'exp_so3'), ('right_jacobian', 'right_jacobian'),
                                          ('right_jacobian_inverse', 'right_jacobian_inverse')])
def test_compiled_functions_of_a_vector_agree_with_the_batched_ones(name, kernel, angle):
    w = angle * axes(5)
    found = [compiled(getattr(lie_kernels, kernel), v, (3, 3)) for v in w]
    np.testing.assert_allclose(found, getattr(lie, name)(w), atol=1e-11)


@pytest.mark.parametrize('angle', ANGLES)
def test_compiled_log_agrees_with_the_batched_one(angle):
    R = lie.so3_exp(angle * axes())
    found, expected = np.array([compiled(lie_kernels.log_so3, r, 3) for r in R]), lie.so3_log(R)
    if angle == np.pi:  # either sign is right
        found *= np.sign(np.sum(found * expected, axis=-1, keepdims=True))
    np.testing.assert_allclose(found, expected, atol=1e-11)


def test_compiled_products_agree_with_numpy():
    A, B = np.random.default_rng(5).normal(size=(2, 3, 3))
    C = np.empty((3, 3))
    lie_kernels.multiply(A, B, C)
    np.testing.assert_allclose(C, A @ B, atol=1e-15)
    lie_kernels.multiply_transposed(A, B, C)
    np.testing.assert_allclose(C, A.T @ B, atol=1e-15)


@pytest.mark.row(6)
def test_a_hundred_thousand_compiled_updates_stay_in_so3():
    steps = 0.1 * np.random.default_rng(6).normal(size=(1000, 3))
    R = np.eye(3)
    for _ in range(100):
        for d in steps:
            lie_kernels.retract_rotation(R, d, R)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)


def test_compiled_update_is_right_multiplication_by_exp():
    R, d = lie.so3_exp([0.3, -2.0, 1.0]), np.array([0.5, 0.2, -0.1])
    out = np.empty((3, 3))
    lie_kernels.retract_rotation(R, d, out)
    np.testing.assert_allclose(out, R @ lie.so3_exp(d), atol=1e-14)
