"""The two-parameter line pinned to its host's observation plane."""
import numpy as np
import pytest

from line_slam_ros.geometry import host_line, lines, orthonormal


@pytest.fixture
def segments():
    """Ends (50, 2, 3) in front of the host camera, and what it sees of them (50, 2, 2)."""
    p_H = np.random.default_rng(5).normal(size=(50, 2, 3)) * [1, 1, 0.5] + [0, 0, 5]
    return p_H, p_H[..., :2] / p_H[..., 2:]


def up_to_scale(L):
    L = L / np.linalg.norm(L, axis=-1, keepdims=True)
    return L * np.sign(np.take_along_axis(L, np.argmax(np.abs(L), axis=-1)[..., None], axis=-1))


@pytest.mark.row(28)
def test_local_frame_is_a_rotation_with_y_in_and_z_across_the_observation_plane(segments):
    _, ends = segments
    R_HL = host_line.host_frame(ends)
    np.testing.assert_allclose(np.swapaxes(R_HL, -1, -2) @ R_HL, np.broadcast_to(np.eye(3), R_HL.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R_HL), 1)
    middle = np.concatenate([ends.mean(axis=1), np.ones((50, 1))], axis=-1)
    np.testing.assert_allclose(np.cross(R_HL[..., 1], middle), 0, atol=1e-14)
    normal = lines.observation_plane(np.eye(4), ends)[:, :3]
    np.testing.assert_allclose(R_HL[..., 2], normal, atol=1e-12)


@pytest.mark.row(28)
def test_a_segment_without_length_has_no_local_frame():
    assert np.isnan(host_line.host_frame([[0.1, 0.2], [0.1, 0.2]])).any()


@pytest.mark.row(30)
@pytest.mark.source_error('D2 rho start')
def test_exact_start_describes_the_line_through_the_points(segments):
    p_H, ends = segments
    R_HL, L_H = host_line.host_frame(ends), lines.line_from_points(p_H[:, 0], p_H[:, 1])
    found = host_line.pluecker_from_rho_theta(host_line.rho_theta_from_pluecker(L_H, R_HL), R_HL)
    np.testing.assert_allclose(up_to_scale(found), up_to_scale(L_H), atol=1e-12)


@pytest.mark.row(30)
@pytest.mark.source_error('D2 rho')
def test_rho_is_the_inverse_range_along_the_middle_ray(segments):
    p_H, ends = segments
    R_HL = host_line.host_frame(ends)
    rho = host_line.rho_theta_from_pluecker(lines.line_from_points(p_H[:, 0], p_H[:, 1]), R_HL)[:, 0]
    assert (rho > 0).all()
    L_H = lines.line_from_points(p_H[:, 0], p_H[:, 1])
    np.testing.assert_allclose(lines.point_distance(L_H, R_HL[..., 1] / rho[:, None]), 0, atol=1e-12)


@pytest.mark.row(30)
def test_two_and_four_parameter_starts_are_the_same_line(segments):
    p_H, ends = segments
    R_HL, L_H = host_line.host_frame(ends), lines.line_from_points(p_H[:, 0], p_H[:, 1])
    two = host_line.pluecker_from_rho_theta(host_line.rho_theta_from_pluecker(L_H, R_HL), R_HL)
    four = orthonormal.pluecker_from_orthonormal(*orthonormal.orthonormal_from_pluecker(L_H))
    np.testing.assert_allclose(up_to_scale(two), up_to_scale(four), atol=1e-12)


@pytest.mark.parametrize('rho', [-0.5, 0.0, 1e-9, 0.2, 50.0])
@pytest.mark.parametrize('theta', [-np.pi, 0.0, np.pi / 2, 1.0])
def test_jacobian_is_the_derivative_of_the_line(rho, theta):
    R_HL, x, h = host_line.host_frame([[0.1, 0.2], [-0.3, 0.4]]), np.array([rho, theta]), 1e-6
    numeric = np.stack([(host_line.pluecker_from_rho_theta(x + h * e, R_HL)
                         - host_line.pluecker_from_rho_theta(x - h * e, R_HL)) / (2 * h) for e in np.eye(2)], axis=-1)
    np.testing.assert_allclose(host_line.jacobian(x, R_HL), numeric, rtol=1e-7, atol=1e-8)


def test_jacobian_is_batched(segments):
    _, ends = segments
    R_HL, x = host_line.host_frame(ends), np.random.default_rng(6).normal(size=(50, 2))
    expected = [host_line.jacobian(a, b) for a, b in zip(x, R_HL, strict=True)]
    np.testing.assert_allclose(host_line.jacobian(x, R_HL), expected, atol=1e-15)


@pytest.mark.row(20)
@pytest.mark.parametrize('theta, wrapped', [(0.0, 0.0), (np.pi, -np.pi), (-np.pi, -np.pi), (3.5, 3.5 - 2 * np.pi),
                                            (-3.5, 2 * np.pi - 3.5), (7 * np.pi, -np.pi)])
def test_theta_is_wrapped_into_minus_pi_to_pi(theta, wrapped):
    found = host_line.plus([0.2, 0.0], [0.1, theta])
    np.testing.assert_allclose(found, [0.3, wrapped], atol=1e-14)
    assert -np.pi <= found[1] < np.pi
    assert host_line.plus([0.2, 0.0], [0.1, np.nextafter(-np.pi, -4.0)])[1] == -np.pi


@pytest.mark.row(20)
def test_half_a_turn_of_theta_is_the_same_line_backwards():
    R_HL = host_line.host_frame([[0.1, 0.2], [-0.3, 0.4]])
    forward, back = (host_line.pluecker_from_rho_theta([0.3, theta], R_HL) for theta in (0.4, 0.4 + np.pi))
    np.testing.assert_allclose(forward, -back, atol=1e-15)


@pytest.mark.row(22)
def test_the_hosts_own_residual_is_zero_whatever_rho_and_theta(segments):
    _, ends = segments
    R_HL, rng = host_line.host_frame(ends), np.random.default_rng(7)
    L_H = host_line.pluecker_from_rho_theta(rng.normal(size=(50, 2)), R_HL)
    rays = np.concatenate([ends, np.ones((50, 2, 1))], axis=-1)
    np.testing.assert_allclose(np.sum(L_H[:, None, :3] * rays, axis=-1), 0, atol=1e-14)


def test_a_line_through_the_hosts_centre_has_infinite_rho():
    ends = np.array([[-0.1, 0.0], [0.1, 0.0]])
    L_H = lines.line_through([0.0, 0.0, 0.0], [0.5, 0.0, 1.0])
    assert np.isinf(host_line.rho_theta_from_pluecker(L_H, host_line.host_frame(ends))[0])


def test_lines_off_the_host_plane_are_projected_on_it(segments):
    p_H, ends = segments
    R_HL = host_line.host_frame(ends + 1e-3 * np.random.default_rng(8).normal(size=ends.shape))
    L_H = lines.line_from_points(p_H[:, 0], p_H[:, 1])
    found = host_line.pluecker_from_rho_theta(host_line.rho_theta_from_pluecker(L_H, R_HL), R_HL)
    np.testing.assert_allclose(np.cross(found[:, :3], R_HL[..., 2]), 0, atol=1e-14)
    projected = L_H[:, 3:] - np.sum(L_H[:, 3:] * R_HL[..., 2], axis=-1, keepdims=True) * R_HL[..., 2]
    np.testing.assert_allclose(lines.line_angle(found, lines.line_through(np.zeros(3), projected)), 0, atol=1e-12)
