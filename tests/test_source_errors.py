"""The errors of the two sources: each wrong formula beside the truth, and the numbers of docs/line-geometry.md.

D1 is the equation document, D2 the line code base. The wrong formulas are written out here and used nowhere else.
"""
import numpy as np
import pytest
from line_scene import FOCAL, clipped, looking, see, views
from rows import SOURCE_ERRORS

from line_slam_ros.config import Estimator, Mapping
from line_slam_ros.factors.line_reprojection import line_reprojection
from line_slam_ros.factors.robust import robust
from line_slam_ros.geometry import host_line, lines, orthonormal
from line_slam_ros.geometry.lie import (
    hat,
    matrix_from_quaternion,
    pose_plus,
    pose_plus_jacobian,
    quaternion_from_matrix,
    rigid,
    rigid_inverse,
    so3_exp,
    so3_log,
    transform_points,
)
from line_slam_ros.mapping.line_map import LineMap
from line_slam_ros.types import Loss

A, B = np.array([-1.0, 4.0, 0.2]), np.array([1.0, 4.5, 0.6])  # a segment two metres long
T_BC = rigid(so3_exp([0.2, -0.4, 1.5]), [0.05, -0.02, 0.03])
SOURCES_T_BC = rigid([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [0.05, 0.04, 0.03])  # their experiment's


def agrees(item, *found):
    """What the page says about an item is what was computed here, to 1 %."""
    np.testing.assert_allclose(found, SOURCE_ERRORS[item].numbers, rtol=0.01, err_msg=item)


def meet(L, N, e):
    """D1 (8): where a line meets the plane N . p + e = 0."""
    return (np.cross(L[:3], N) + e * L[3:]) / -(L[3:] @ N)


def numeric(function, size, h):
    """Central differences of the fourth order."""
    def difference(e):
        near, far = function(h * e) - function(-h * e), function(2 * h * e) - function(-2 * h * e)
        return (8 * near - far) / (12 * h)
    return np.stack([difference(e) for e in np.eye(size)], axis=-1)


def factor(T_WB, T_BC, L_W, ends):
    """Residual (2,) and its derivatives by pose, extrinsic and line, (2, 6) each, of our factor."""
    out = np.empty(2), np.empty((2, 6)), np.empty((2, 6)), np.empty((2, 6))
    parts = [np.ascontiguousarray(T[:3, part]) for T in (T_WB, T_BC) for part in (slice(3), 3)]
    assert line_reprojection(*parts, L_W[:3].copy(), L_W[3:].copy(), ends, *out)
    return out


def relative(found, true):
    return np.linalg.norm(np.subtract(found, true)) / np.linalg.norm(true)


# The equation document


@pytest.mark.source_error('D1 (15)')
def test_the_derivative_by_the_left_update_has_another_sign():
    U, phi = so3_exp([0.3, -1.0, 2.0]), 0.7
    u_1, u_2, w_1, w_2 = U[:, 0], U[:, 1], np.cos(phi), np.sin(phi)

    def blocks(sign):
        return np.block([[-hat(w_1 * u_1), -w_2 * u_1[:, None]], [-hat(w_2 * u_2), sign * w_1 * u_2[:, None]]])

    true = numeric(lambda d: orthonormal.pluecker_from_orthonormal(*orthonormal.plus_left(U, phi, d)), 4, 1e-3)
    np.testing.assert_allclose(blocks(1.0), true, atol=1e-9)
    np.testing.assert_allclose(orthonormal.jacobian_left(U, phi), true, atol=1e-9)
    agrees('D1 (15)', np.linalg.norm(blocks(-1.0)[:, 3] - true[:, 3]), np.linalg.norm(true[:, 3]))


@pytest.mark.source_error('D1 (7)')
def test_the_auxiliary_point_of_trimming_needs_the_camera_centre():
    """Cameras one metre before the world's origin, looking at it; exact lines behind it, one pixel of noise."""
    rng, errors = np.random.default_rng(1), []
    for _ in range(200):
        C = rng.normal(size=3) / 3 - [0.0, 1.0, 0.0]
        C /= np.linalg.norm(C)
        T_WC = looking(C, np.zeros(3))
        L_W, ends = lines.line_from_points(A, B), see(T_WC, A, B) + rng.normal(size=(2, 2)) / FOCAL
        a, b = transform_points(T_WC, np.column_stack([ends, np.ones(2)]))
        feet = []
        for across in (np.cross(a, b), np.cross(a - C, b - C)):
            N = np.cross(a - C, across)
            feet.append(meet(L_W, N, -(N @ C)))
        L_C = lines.transform_lines(rigid_inverse(T_WC), L_W[None])[0]
        np.testing.assert_allclose(transform_points(T_WC, lines.trim(L_C, ends, 'plane'))[0], feet[1], atol=1e-9)
        errors.append([np.linalg.norm(foot - A) for foot in feet])
    agrees('D1 (7)', *(100 * np.mean(errors, axis=0)), *(100 * np.max(errors, axis=0)))


@pytest.mark.source_error('D1 (8)')
@pytest.mark.trap('near end-on views')
def test_the_meeting_point_with_a_plane_does_not_exist_when_the_line_runs_in_it():
    """A line half a metre beside the optical axis: its image runs into the principal point, u = 460 * 0.5 / z px."""
    L_C, across = lines.line_through([0.5, 0.0, 0.0], [0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    with np.errstate(divide='ignore', invalid='ignore'):
        assert not np.isfinite(meet(L_C, np.cross([0.0, 0.0, 1.0], across), 0.0)).all()
    near, far = (meet(L_C, np.cross([u / FOCAL, 0.0, 1.0], across), 0.0)[2] for u in (1.15, 0.15))
    agrees('D1 (8)', near, far)
    trimmed = lines.trim(L_C, np.array([[0.0, 0.0], [1.15 / FOCAL, 0.0]]))
    assert np.isnan(trimmed[0]).all()
    np.testing.assert_allclose(trimmed[1], [0.5, 0.0, 200.0], rtol=1e-12)


@pytest.mark.source_error('D1 (3)')
def test_acos_loses_the_far_line_and_asin_the_near_one():
    (n, d), near = (1e9, 1.0), (1e-9, 1.0)
    assert np.arccos(n / np.hypot(n, d)) == 0.0  # a line at infinity
    _, phi = orthonormal.orthonormal_from_pluecker(lines.line_through([n, 0.0, 0.0], [0.0, 0.6, 0.8]))
    np.testing.assert_allclose(1.0 / np.tan(phi), n, rtol=1e-12)
    lost = 1.0 / np.tan(np.arcsin(near[1] / np.hypot(*near)))
    _, phi = orthonormal.orthonormal_from_pluecker(lines.line_through([near[0], 0.0, 0.0], [0.0, 0.6, 0.8]))
    np.testing.assert_allclose(1.0 / np.tan(phi), near[0], rtol=1e-6)
    assert np.arccos(np.cos(-0.3)) == pytest.approx(0.3)  # and acos has no sign
    assert lost < 1e-15


@pytest.mark.source_error('D1 section 3')
def test_the_outermost_of_noisy_ends_is_not_the_end():
    """Full views: what counts is that noise falls on both sides of the true end."""
    extended, _, ours = end_rules(4.5, lambda rng: lambda k: (0.0, 1.0))
    agrees('D1 section 3', 100 * extended, 100 * ours)


@pytest.mark.source_error('D2 updatelineplk')
@pytest.mark.trap('partial views')
def test_the_innermost_of_partial_views_is_not_the_end():
    _, shrunk, ours = end_rules(4.5, clipped)
    _, shrunk_clean, ours_clean = end_rules(0.0, clipped)
    assert shrunk_clean > 0.5 and ours_clean < 0.01
    agrees('D2 updatelineplk', 100 * shrunk, 100 * ours)


def end_rules(px, part_of):
    """Mean error (m) of both ends of a known line by the outermost foot, by the innermost one and in our map."""
    errors, d = [], (B - A) / np.linalg.norm(B - A)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        T_WC, ends = views(rng, A, B, 60, px, part_of(rng))
        L_W = lines.line_through(A, d)
        L_C = lines.transform_lines(rigid_inverse(T_WC), L_W[None])[:, 0]
        along = (transform_points(T_WC, lines.trim(L_C, ends)) - A) @ d
        truth = np.array([0.0, np.linalg.norm(B - A)])
        line_map = LineMap(Mapping())
        line_map.refine(np.array([0]), L_W[None], np.zeros((1, 6, 6)), np.array([60]))
        for T, e in zip(T_WC, ends, strict=True):
            line_map.observe(np.array([0]), e[None], T)
        voted = (line_map.segments().ends[0] - A) @ d
        errors.append([np.abs(found - truth).mean() for found in (
            [along[:, 0].min(), along[:, 1].max()], [along[:, 0].max(), along[:, 1].min()], voted)])
    return np.mean(errors, axis=0)


# The line code base: geometry


@pytest.mark.source_error('D2 pluckerOrigin')
def test_the_foot_is_d_x_n_and_not_n_x_d():
    L = lines.line_from_points(A, B)
    n, d = L[:3], L[3:]
    foot, wrong = lines.closest_point(L), np.cross(n, d) / (d @ d)
    np.testing.assert_allclose(wrong, -foot, atol=1e-12)
    np.testing.assert_allclose(lines.point_distance(L, foot), 0.0, atol=1e-12)
    agrees('D2 pluckerOrigin', lines.point_distance(L, wrong), np.linalg.norm(n) / np.linalg.norm(d))


@pytest.mark.source_error('D2 plk_to_orth')
@pytest.mark.trap('plane z = 0')
def test_euler_angles_lose_the_direction_of_a_line_in_the_plane_z_0():
    L = lines.line_through([1.0, 2.0, 0.0], [0.6, -0.8, 0.0])
    U, phi = orthonormal.orthonormal_from_pluecker(L)
    wrong = np.array([np.arctan2(U[2, 1], U[2, 2]), np.arcsin(-U[2, 0]), np.arctan2(U[1, 0], U[0, 0]), phi])
    back = orthonormal.pluecker_from_orthonormal(*orthonormal.orthonormal_from_orth4(wrong))
    agrees('D2 plk_to_orth', np.degrees(lines.line_angle(back, L)))
    assert lines.line_angle(orthonormal.pluecker_from_orthonormal(U, phi), L) < 1e-12
    with pytest.raises(ValueError, match='parallel to z'):
        orthonormal.orth4_from_orthonormal(U, phi)
    through_origin = lines.line_through(np.zeros(3), [0.6, 0.0, 0.8])
    with np.errstate(invalid='ignore'):
        assert np.isnan(through_origin[:3] / np.linalg.norm(through_origin[:3])).all()
    assert np.isfinite(orthonormal.orthonormal_from_pluecker(through_origin)[0]).all()


@pytest.mark.source_error('D2 line_to_pose')
def test_a_moved_foot_is_not_the_foot_of_the_moved_line():
    L = lines.line_from_points(A, B)
    moved = transform_points(T_BC, lines.closest_point(L)[None])[0]
    L_moved = lines.line_motion(T_BC) @ L
    np.testing.assert_allclose(lines.point_distance(L_moved, moved), 0.0, atol=1e-12)
    agrees('D2 line_to_pose', 100 * np.linalg.norm(moved - lines.closest_point(L_moved)))


@pytest.mark.source_error('D2 TrimLine')
@pytest.mark.trap('points behind the camera')
@pytest.mark.trap('near end-on views')
def test_trimming_without_a_guard_returns_points_behind_the_camera_and_along_the_line():
    behind, ends = lines.line_from_points([-0.4, 0.0, -4.0], [-0.8, 0.1, -4.0]), np.array([[0.1, 0.0], [0.2, -0.025]])
    across = np.cross([*ends[0], 1.0], [*ends[1], 1.0])
    found = meet(behind, np.cross([*ends[0], 1.0], across), 0.0)
    assert np.isnan(lines.trim(behind, ends)).all()
    L_W, end_on = lines.unit_direction(lines.line_from_points(A, B)), looking(A - 3 * (B - A) + [0.0, 0.0, 0.1], B)
    seen = see(end_on, A, B) + [[0.0, 0.0], [0.0, 1.0 / FOCAL]]
    L_C = lines.transform_lines(rigid_inverse(end_on), L_W[None])[0]
    slipped = transform_points(end_on, lines.trim(L_C, seen, 'segment'))
    flat = np.degrees(lines.line_angle(L_C, lines.line_through(np.zeros(3), [*seen[1], 1.0])))
    agrees('D2 TrimLine', found[2], flat, 100 * np.linalg.norm(slipped[1] - B))
    line_map = LineMap(Mapping())
    line_map.refine(np.array([0]), L_W[None], np.zeros((1, 6, 6)), np.array([9]))
    for _ in range(9):
        line_map.observe(np.array([0]), seen[None], end_on)
    assert len(line_map.segments()) == 0  # no foot of a view at less than five degrees is used


# The line code base: parameterisations


@pytest.mark.source_error('D2 line Plus')
@pytest.mark.trap('phi across 0 and pi/2')
def test_phi_by_asin_folds_at_a_right_angle_and_is_sometimes_not_a_number():
    U, phi, step = so3_exp([0.3, -1.0, 2.0]), 1.5, 0.2
    folded = np.arcsin(np.sin(phi) * np.cos(step) + np.cos(phi) * np.sin(step))
    wrong, ours = (orthonormal.pluecker_from_orthonormal(U, angle) for angle in (folded, phi + step))
    np.testing.assert_allclose(ours, orthonormal.pluecker_from_orthonormal(
        *orthonormal.plus_right(U, phi, [0, 0, 0, step])), atol=1e-15)
    np.testing.assert_allclose(lines.closest_point(wrong), -lines.closest_point(ours), atol=1e-12)
    agrees('D2 line Plus', 100 * lines.line_distance(wrong, ours))
    to_right_angle = np.linspace(0.0, 1.5, 1000)
    sine = np.sin(to_right_angle) * np.sin(to_right_angle) + np.cos(to_right_angle) * np.cos(to_right_angle)
    assert (sine > 1.0).any()
    with np.errstate(invalid='ignore'):
        assert np.isnan(np.arcsin(sine)).any()


@pytest.mark.source_error('D2 line Jacobian')
def test_an_identity_in_place_of_the_ambient_derivative_of_orth4_is_wrong():
    """What an automatic derivative by the four stored numbers is multiplied with."""
    orth4 = np.array([0.3, -0.9, 2.0, 0.6])
    ambient = numeric(lambda step: orthonormal.pluecker_from_orthonormal(
        *orthonormal.orthonormal_from_orth4(orth4 + step)), 4, 1e-3)
    tangent = orthonormal.jacobian_right(*orthonormal.orthonormal_from_orth4(orth4))
    np.testing.assert_allclose(ambient @ orthonormal.orth4_plus_jacobian(orth4), tangent, atol=1e-9)
    agrees('D2 line Jacobian', relative(ambient @ np.eye(4), tangent))


@pytest.mark.source_error('D2 pose Plus')
def test_the_first_order_quaternion_falls_short_of_the_angle():
    d = np.array([0.6, 0.0, 0.8])  # one radian
    turned = so3_log(matrix_from_quaternion([*(d / 2), 1.0]))
    agrees('D2 pose Plus', 100 * (1.0 - np.linalg.norm(turned)))
    np.testing.assert_allclose(so3_log(pose_plus(np.eye(4), [*d, 0.0, 0.0, 0.0])[:3, :3]), d, atol=1e-14)


@pytest.mark.source_error('D2 pose Jacobian')
def test_the_ambient_derivative_of_a_pose_must_not_meet_an_analytic_one():
    """The analytic factor's derivative by [p, dtheta] stands in the first six of the seven columns of [p, q]."""
    T_WB = np.eye(4)
    L_W, ends = lines.line_from_points(A[[0, 2, 1]], B[[0, 2, 1]]), see(T_BC, A[[0, 2, 1]], B[[0, 2, 1]]) + 0.01
    J = factor(T_WB, T_BC, L_W, ends)[1]
    true = numeric(lambda d: factor(pose_plus(T_WB, d), T_BC, L_W, ends)[0], 6, 1e-3)
    np.testing.assert_allclose(J, true, atol=1e-8)
    seven = np.column_stack([J[:, 3:], J[:, :3], np.zeros(2)])
    wrong = seven @ pose_plus_jacobian(quaternion_from_matrix(T_WB[:3, :3]))
    np.testing.assert_allclose((seven @ np.eye(7, 6))[:, [3, 4, 5, 0, 1, 2]], J)
    np.testing.assert_allclose(wrong[:, 3:], J[:, 3:])
    agrees('D2 pose Jacobian', relative(wrong[:, :3], J[:, :3]))


@pytest.mark.source_error('D2 Twist inverse')
@pytest.mark.trap('quaternion not of unit length')
def test_a_quaternion_of_five_decimals_is_not_a_rotation_until_it_has_unit_length():
    """Poses up to 20 m from the origin, times their inverse."""
    rng, errors = np.random.default_rng(3), []
    for _ in range(1000):
        R, p = so3_exp(rng.normal(size=3)), rng.uniform(-20.0, 20.0, 3)
        q_xyzw = np.round(quaternion_from_matrix(R), 5)
        Q = hat(q_xyzw[:3])
        R_stored = np.eye(3) + 2.0 * q_xyzw[3] * Q + 2.0 * Q @ Q  # the formula for unit quaternions
        errors.append(np.linalg.norm(R_stored @ (R_stored.T @ -p) + p))
        T = rigid(matrix_from_quaternion(q_xyzw), p)
        np.testing.assert_allclose(T @ rigid_inverse(T), np.eye(4), atol=1e-13)
    agrees('D2 Twist inverse', 1000 * max(errors))


# The line code base: factors


@pytest.mark.source_error('D2 invTbc')
def test_the_inverse_of_the_extrinsic_maps_body_to_camera():
    """A point five metres ahead of the camera."""
    p_C = np.array([[0.1, -0.2, 5.0]])
    p_B = transform_points(SOURCES_T_BC, p_C)
    np.testing.assert_allclose(transform_points(rigid_inverse(SOURCES_T_BC), p_B), p_C, atol=1e-14)
    agrees('D2 invTbc', np.linalg.norm(transform_points(SOURCES_T_BC, p_B) - p_C))


def two_views(seed):
    """(T_WBi, T_WBj, T_BC, line in camera i, what camera j, four metres away, sees of it)."""
    rng = np.random.default_rng(seed)
    p_Ci = rng.normal(size=(2, 3)) * [1, 1, 0.5] + [0, 0, 5]
    away = rng.normal(size=3)
    T_CiCj = looking(4.0 * away / np.linalg.norm(away), p_Ci.mean(axis=0), up=(0.0, -1.0, 0.0))
    T_WBi = rigid(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    return (T_WBi, T_WBi @ SOURCES_T_BC @ T_CiCj @ rigid_inverse(SOURCES_T_BC), SOURCES_T_BC,
            lines.line_from_points(*p_Ci), see(T_CiCj, *p_Ci))


@pytest.mark.source_error('D2 in-camera factor')
@pytest.mark.trap('extrinsic not the identity')
def test_the_relative_position_of_two_cameras_is_turned_by_the_transposed_extrinsic():
    found = []
    for seed in range(100):
        T_WBi, T_WBj, T_BC, L_Ci, ends = two_views(seed)
        T_CjCi = rigid_inverse(T_WBj @ T_BC) @ T_WBi @ T_BC
        R_BC, p_BjCi = T_BC[:3, :3], (rigid_inverse(T_WBj) @ T_WBi @ T_BC)[:3, 3]
        np.testing.assert_allclose(R_BC.T @ (p_BjCi - T_BC[:3, 3]), T_CjCi[:3, 3], atol=1e-12)
        T_wrong = rigid(T_CjCi[:3, :3], R_BC @ (p_BjCi - T_BC[:3, 3]))
        J = factor(rigid_inverse(T_CjCi), np.eye(4), L_Ci, ends)[3]
        by_line_j = J @ lines.line_motion(rigid_inverse(T_CjCi))
        found.append(relative(by_line_j @ lines.line_motion(T_wrong), J))
    agrees('D2 in-camera factor', *np.percentile(found, [10, 50, 90]))
    true = numeric(lambda d: factor(rigid_inverse(T_CjCi), np.eye(4), L_Ci + d, ends)[0], 6, 1e-4)
    np.testing.assert_allclose(by_line_j @ lines.line_motion(T_CjCi), true, atol=1e-7)


@pytest.mark.source_error('D2 relative pose')
def test_the_inverse_of_a_pose_is_not_its_transpose():
    T_WBi, T_WBj, T_BC, _, _ = two_views(0)
    T_i, T_j = T_WBi @ T_BC, T_WBj @ T_BC
    p_Ci = np.array([0.1, -0.2, 5.0, 1.0])
    true = np.linalg.inv(T_j) @ T_i @ p_Ci
    np.testing.assert_allclose(rigid_inverse(T_j) @ T_i @ p_Ci, true, atol=1e-12)
    agrees('D2 relative pose', np.linalg.norm((T_j.T @ T_i @ p_Ci - true)[:3]))


@pytest.mark.source_error('D2 one-camera factor')
def test_the_residual_of_the_host_says_nothing_about_theta_and_rho():
    ends = np.array([[0.1, 0.2], [-0.3, 0.4]])
    R_HL, rng = host_line.host_frame(ends), np.random.default_rng(5)
    for rho_theta in np.column_stack([rng.uniform(-2.0, 2.0, 50), rng.uniform(-np.pi, np.pi, 50)]):
        r, _, _, J_line = factor(np.eye(4), np.eye(4), host_line.pluecker_from_rho_theta(rho_theta, R_HL), ends)
        np.testing.assert_allclose(r, 0.0, atol=1e-14)
        np.testing.assert_allclose(J_line @ host_line.jacobian(rho_theta, R_HL), 0.0, atol=1e-12)


@pytest.mark.source_error('D2 rho')
def test_rho_is_the_inverse_of_the_range_and_not_of_the_depth():
    """A segment four metres deep, forty degrees off the axis."""
    p_H = np.array([[4 * np.tan(np.radians(40)), y, 4.0] for y in (-0.5, 0.5)])
    ends, L_H = p_H[:, :2] / p_H[:, 2:], lines.line_from_points(*p_H)
    R_HL = host_line.host_frame(ends)
    rho, theta = host_line.rho_theta_from_pluecker(L_H, R_HL)
    np.testing.assert_allclose(lines.point_distance(L_H, R_HL[:, 1] / rho), 0.0, atol=1e-12)
    wrong = host_line.pluecker_from_rho_theta([1.0 / 4.0, theta], R_HL)
    agrees('D2 rho', 1.0 / rho, 100 * lines.point_distance(wrong, p_H.mean(axis=0)))


@pytest.mark.source_error('D2 rho start')
def test_a_start_of_fixed_rho_is_always_five_metres_away():
    """Seen again half a metre to the side."""
    errors, beside = [], rigid(np.eye(3), [0.5, 0.0, 0.0])
    for depth in (2.0, 20.0):
        p_H = np.array([[0.1, -0.5, depth], [-0.1, 0.5, depth]])
        R_HL, L_H = host_line.host_frame(p_H[:, :2] / depth), lines.line_from_points(*p_H)
        rho, theta = host_line.rho_theta_from_pluecker(L_H, R_HL)
        fixed, exact = (factor(beside, np.eye(4), host_line.pluecker_from_rho_theta([x, theta], R_HL),
                               see(beside, *p_H))[0] for x in (0.2, rho))
        np.testing.assert_allclose(exact, 0.0, atol=1e-14)
        errors.append(FOCAL * np.abs(fixed).max())
    agrees('D2 rho start', *errors)


@pytest.mark.source_error('D2 triangulate_line')
@pytest.mark.trap('swapped end points')
def test_parallax_without_the_absolute_value_takes_swapped_ends_for_parallax():
    """4.5 px of noise, every second view swapped: the most opposite normals are those of almost the same plane."""
    chosen, errors, worst = [], [], 0.998  # 3.62 degrees
    for seed in range(100):
        T_WC, ends = views(np.random.default_rng(seed), A, B, 30, px=4.5)
        ends[::2] = ends[::2, ::-1]
        planes, L_W = lines.observation_plane(T_WC, ends), lines.line_from_points(A, B)
        cosine = planes[:, :3] @ planes[:, :3].T
        i, j = divmod(int(np.argmin(cosine)), 30)
        assert cosine[i, j] < worst  # passes for parallax
        chosen.append(abs(cosine[i, j]) > worst)
        first, second, ours = lines.widest_pair(planes)
        assert ours < worst
        errors.append([np.degrees(lines.line_angle(L, L_W)) for L in (
            lines.line_from_planes(planes[i], planes[j]), lines.line_from_planes(planes[first], planes[second]),
            lines.line_from_many_planes(planes))])
    agrees('D2 triangulate_line', 100 * np.mean(chosen), *np.median(errors, axis=0))


@pytest.mark.source_error('D2 general line')
def test_two_numbers_keep_the_noise_of_the_first_view():
    """Mean distance of the ends from the best line in the plane of one view, and from the line of 10 and 320 views."""
    errors = []
    for seed in range(20):
        T_WC, ends = views(np.random.default_rng(seed), A, B, 320, px=4.5)
        planes, both = lines.observation_plane(T_WC, ends), np.stack([A, B])
        found = [lines.line_from_many_planes(planes[:count]) for count in (10, 320)]
        errors.append([np.abs(both @ planes[0, :3] + planes[0, 3]).mean(),
                       *(lines.point_distance(L, both).mean() for L in found)])
    agrees('D2 general line', *(100 * np.mean(errors, axis=0)))


# The line code base: weights


@pytest.mark.source_error('D2 sqrt_info lost')
def test_without_whitening_the_robust_loss_does_not_see_outliers():
    """A residual of 50 px at the sources' 460 px, measured by its sigma of 1 px or not at all."""
    squared = (50.0 / FOCAL) ** 2
    agrees('D2 sqrt_info lost', *(robust(int(Loss.CAUCHY), s, 1.0)[1] for s in (squared, squared * FOCAL**2)))


@pytest.mark.source_error('D2 sqrt_info fixed')
def test_a_sigma_of_a_pixel_or_so_takes_good_data_of_more_noise_for_outliers():
    """Mean weight of the two residuals of a view at 4.5 px of noise: Cauchy(1) at 3.2 px, ours at its own sigma."""
    squared = np.sum(np.random.default_rng(0).normal(size=(20_000, 2)) ** 2, axis=1)
    fixed, ours = (np.mean([robust(int(Loss.CAUCHY), s, c2)[1] for s in scale * squared])
                   for scale, c2 in (((4.5 / 3.2) ** 2, 1.0), (1.0, Estimator().loss_scale ** 2)))
    agrees('D2 sqrt_info fixed', fixed, ours)
