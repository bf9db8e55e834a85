"""Every Jacobian block of the visual factors against central differences; the factors of older line code as chains."""
from types import SimpleNamespace

import numpy as np
import pytest

from line_slam_ros.factors.line_reprojection import line_reprojection, line_residual
from line_slam_ros.factors.point_reprojection import inverse_depth_point, point_reprojection, point_residual
from line_slam_ros.geometry import host_line, lines, orthonormal
from line_slam_ros.geometry.lie import pose_plus, rigid, rigid_inverse, so3_exp, transform_points

SEEDS = range(6)


def numeric(function, size, h):
    """Central differences of the fourth order: step h may be large beside rounding, small beside curvature."""
    def difference(e):
        near, far = function(h * e) - function(-h * e), function(2 * h * e) - function(-2 * h * e)
        return (8 * near - far) / (12 * h)
    return np.stack([difference(e) for e in np.eye(size)], axis=-1)


def check(analytic, numerical, rtol=1e-6):
    """Equal to rtol of the block's largest entry."""
    np.testing.assert_allclose(analytic, numerical, rtol=0, atol=rtol * max(np.abs(numerical).max(), 1e-9))


def random_pose(rng, angle=None):
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    return rigid(so3_exp(axis * (rng.uniform(0, 3) if angle is None else angle)), rng.normal(size=3))


def parts(T):
    return np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])


def line(T_WB, T_BC, L_W, ends):
    out = SimpleNamespace(r=np.full(2, np.nan), J_pose=np.full((2, 6), np.nan), J_ext=np.full((2, 6), np.nan),
                          J_line=np.full((2, 6), np.nan))
    out.valid = line_reprojection(*parts(T_WB), *parts(T_BC), L_W[:3].copy(), L_W[3:].copy(), ends, out.r, out.J_pose,
                                  out.J_ext, out.J_line)
    return out


def point(T_WB, T_BC, p_W, x):
    out = SimpleNamespace(r=np.full(2, np.nan), J_pose=np.full((2, 6), np.nan), J_ext=np.full((2, 6), np.nan),
                          J_point=np.full((2, 3), np.nan))
    out.valid = point_reprojection(*parts(T_WB), *parts(T_BC), p_W, x, out.r, out.J_pose, out.J_ext, out.J_point)
    return out


def to_image(p_C):
    return p_C[..., :2] / p_C[..., 2:]


# Segments in the camera's frame: two points, the smallest distance in the scene (which limits the step)
SEGMENTS = {
    'general': ([-1.0, 0.3, 4.0], [1.5, -0.4, 6.0], 1.0),
    'far': ([-300.0, 30.0, 900.0], [200.0, 0.0, 1000.0], 1.0),
    'very near': ([-0.01, 0.02, 0.1], [0.02, 0.02, 0.12], 0.01),
    'nearly end on': ([0.02, 0.0, 2.0], [0.021, 0.001, 6.0], 1e-3),
    'nearly through the optical centre': ([1e-4, 0.0, 1.0], [2e-4, 2e-4, 3.0], 1e-4),
    'parallel to the axis': ([0.5, 0.2, 2.0], [0.5, 0.2, 8.0], 0.1),
    'through the world origin': (None, [1.0, 0.5, 5.0], 0.3),
    'short': ([0.3, 0.2, 3.0], [0.3001, 0.2, 3.0], 1.0),
}


@pytest.fixture(params=[(name, seed) for name in SEGMENTS for seed in SEEDS[:3]], ids=lambda p: f'{p[0]}, seed {p[1]}')
def line_case(request):
    """A line factor's arguments with noise on the ends; extrinsic of half a turn for one of the seeds."""
    name, seed = request.param
    rng = np.random.default_rng(seed)
    a_C, b_C, size = SEGMENTS[name]
    T_WB, T_BC = random_pose(rng), random_pose(rng, np.pi if seed == 0 else None)
    T_WC = T_WB @ T_BC
    origin_C = transform_points(rigid_inverse(T_WC), np.zeros((1, 3)))[0]
    ends_C = np.array([origin_C if a_C is None else a_C, b_C])
    ends = to_image(ends_C) if a_C is not None else np.array([[0.1, 0.2], [0.2, 0.1]])
    L_W = lines.unit_direction(lines.line_from_points(*transform_points(T_WC, ends_C)))
    return SimpleNamespace(T_WB=T_WB, T_BC=T_BC, L_W=L_W, ends=ends + 0.01 * rng.normal(size=(2, 2)), h=1e-3 * size)


@pytest.mark.row(13, 25)
def test_exact_ends_leave_no_line_residual():
    rng = np.random.default_rng(0)
    for _ in range(20):
        T_WB, T_BC, p_C = random_pose(rng), random_pose(rng), rng.normal(size=(2, 3)) + [0, 0, 5]
        L_W = lines.line_from_points(*transform_points(T_WB @ T_BC, p_C))
        np.testing.assert_allclose(line(T_WB, T_BC, L_W, to_image(p_C)).r, 0, atol=1e-13)


@pytest.mark.row(13)
def test_line_residual_is_the_distance_in_the_image_whatever_the_factor_on_the_line(line_case):
    c = line_case
    found = line(c.T_WB, c.T_BC, c.L_W, c.ends)
    n_C = lines.transform_lines(rigid_inverse(c.T_WB @ c.T_BC), c.L_W[None])[0, :3]
    foot = -n_C[2] * n_C[:2] / (n_C[:2] @ n_C[:2])
    along = np.array([-n_C[1], n_C[0]]) / np.linalg.norm(n_C[:2])
    offset = c.ends - foot
    distance = np.linalg.norm(offset - (offset @ along)[:, None] * along, axis=-1)
    np.testing.assert_allclose(np.abs(found.r), distance, atol=1e-9)
    np.testing.assert_allclose(line(c.T_WB, c.T_BC, 7.0 * c.L_W, c.ends).r, found.r, atol=1e-12)
    np.testing.assert_allclose(line(c.T_WB, c.T_BC, -c.L_W, c.ends).r, -found.r, atol=1e-12)


@pytest.mark.row(16, 25)
@pytest.mark.trap('extrinsic not the identity')
def test_line_jacobian_by_the_body_pose(line_case):
    c = line_case
    check(line(c.T_WB, c.T_BC, c.L_W, c.ends).J_pose,
          numeric(lambda d: line(pose_plus(c.T_WB, d), c.T_BC, c.L_W, c.ends).r, 6, c.h))


@pytest.mark.row(17, 25)
@pytest.mark.trap('extrinsic not the identity')
def test_line_jacobian_by_the_extrinsic(line_case):
    c = line_case
    check(line(c.T_WB, c.T_BC, c.L_W, c.ends).J_ext,
          numeric(lambda d: line(c.T_WB, pose_plus(c.T_BC, d), c.L_W, c.ends).r, 6, c.h))


@pytest.mark.row(14, 25)
def test_line_jacobian_by_the_six_pluecker_numbers(line_case):
    c = line_case
    check(line(c.T_WB, c.T_BC, c.L_W, c.ends).J_line,
          numeric(lambda d: line(c.T_WB, c.T_BC, c.L_W + d, c.ends).r, 6, 0.1 * c.h))


@pytest.mark.row(13)
def test_line_without_an_image_is_refused_and_nothing_is_written():
    through_centre = lines.line_through([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    found = line(np.eye(4), np.eye(4), through_centre, np.zeros((2, 2)))
    assert not found.valid
    assert np.isnan(np.concatenate([found.r, found.J_pose.ravel(), found.J_ext.ravel(), found.J_line.ravel()])).all()
    assert line(np.eye(4), np.eye(4), lines.line_through([1e-6, 0, 0], [0.0, 0.0, 1.0]), np.zeros((2, 2))).valid


def test_not_a_number_in_the_state_is_refused():
    assert not line(np.eye(4), np.eye(4), np.full(6, np.nan), np.zeros((2, 2))).valid


@pytest.mark.row(15, 25)
def test_line_residual_by_the_four_parameters_is_the_chain_of_both(line_case):
    c = line_case
    U, phi = orthonormal.orthonormal_from_pluecker(c.L_W)
    L_W = orthonormal.pluecker_from_orthonormal(U, phi)
    chained = line(c.T_WB, c.T_BC, L_W, c.ends).J_line @ orthonormal.jacobian_right(U, phi)
    check(chained, numeric(lambda d: line(c.T_WB, c.T_BC, orthonormal.pluecker_from_orthonormal(
        *orthonormal.plus_right(U, phi, d)), c.ends).r, 4, c.h))


@pytest.fixture(params=SEEDS)
def two_views(request):
    """A segment seen from the host i and from j, both bodies turned, extrinsic not the identity."""
    rng = np.random.default_rng(100 + request.param)
    T_BC = random_pose(rng)
    p_Ci = rng.normal(size=(2, 3)) * [1, 1, 0.5] + [0, 0, 5]
    T_WBi = random_pose(rng)
    T_CiCj = rigid(so3_exp(0.2 * rng.normal(size=3)), 0.5 * rng.normal(size=3))
    p_Cj = transform_points(rigid_inverse(T_CiCj), p_Ci)
    return SimpleNamespace(T_WBi=T_WBi, T_WBj=T_WBi @ T_BC @ T_CiCj @ rigid_inverse(T_BC), T_BC=T_BC,
                           L_Ci=lines.unit_direction(lines.line_from_points(*p_Ci)), ends_i=to_image(p_Ci),
                           ends_j=to_image(p_Cj) + 0.01 * rng.normal(size=(2, 2)))


def in_camera(v, T_WBi, T_WBj, T_BC, L_Ci):
    """Residual in view j of a line held in the host camera's coordinates."""
    return line(T_WBj, T_BC, lines.line_motion(T_WBi @ T_BC) @ L_Ci, v.ends_j)


@pytest.mark.row(24, 26)
@pytest.mark.trap('extrinsic not the identity')
@pytest.mark.source_error('D2 in-camera factor')
def test_host_anchored_line_factor_has_all_four_blocks(two_views):
    """Extrinsic block: both ends of the chain, the host's and the observer's."""
    v = two_views
    found = in_camera(v, v.T_WBi, v.T_WBj, v.T_BC, v.L_Ci)
    L_Bi = lines.line_motion(v.T_BC) @ v.L_Ci
    by_pose_i = found.J_line @ lines.line_motion_jacobian(v.T_WBi, L_Bi)
    by_ext = found.J_ext + found.J_line @ lines.line_motion(v.T_WBi) @ lines.line_motion_jacobian(v.T_BC, v.L_Ci)
    by_line = found.J_line @ lines.line_motion(v.T_WBi @ v.T_BC)
    check(by_pose_i, numeric(lambda d: in_camera(v, pose_plus(v.T_WBi, d), v.T_WBj, v.T_BC, v.L_Ci).r, 6, 1e-3))
    check(found.J_pose, numeric(lambda d: in_camera(v, v.T_WBi, pose_plus(v.T_WBj, d), v.T_BC, v.L_Ci).r, 6, 1e-3))
    check(by_ext, numeric(lambda d: in_camera(v, v.T_WBi, v.T_WBj, pose_plus(v.T_BC, d), v.L_Ci).r, 6, 1e-3))
    check(by_line, numeric(lambda d: in_camera(v, v.T_WBi, v.T_WBj, v.T_BC, v.L_Ci + d).r, 6, 1e-4))


@pytest.mark.row(21)
def test_two_parameter_factor_is_the_pluecker_factor_of_the_same_line_up_to_sign(two_views):
    v = two_views
    R_HL = host_line.host_frame(v.ends_i)
    L_host = host_line.pluecker_from_rho_theta(host_line.rho_theta_from_pluecker(v.L_Ci, R_HL), R_HL)
    two, six = in_camera(v, v.T_WBi, v.T_WBj, v.T_BC, L_host).r, in_camera(v, v.T_WBi, v.T_WBj, v.T_BC, v.L_Ci).r
    np.testing.assert_allclose(np.sign(two[0] * six[0]) * two, six, atol=1e-12)


@pytest.mark.row(21)
def test_two_parameter_factor_jacobian_by_rho_and_theta(two_views):
    v = two_views
    R_HL = host_line.host_frame(v.ends_i)
    start = host_line.rho_theta_from_pluecker(v.L_Ci, R_HL)

    def residual(delta):
        L_host = host_line.pluecker_from_rho_theta(host_line.plus(start, delta), R_HL)
        return in_camera(v, v.T_WBi, v.T_WBj, v.T_BC, L_host)

    chained = residual(np.zeros(2)).J_line @ lines.line_motion(v.T_WBi @ v.T_BC) @ host_line.jacobian(start, R_HL)
    check(chained, numeric(lambda d: residual(d).r, 2, 1e-4))


@pytest.mark.row(22)
@pytest.mark.source_error('D2 one-camera factor')
def test_two_parameter_factor_in_its_own_host_is_void(two_views):
    v = two_views
    R_HL = host_line.host_frame(v.ends_i)
    L_host = host_line.pluecker_from_rho_theta([0.37, 1.1], R_HL)
    found = line(np.eye(4), np.eye(4), L_host, v.ends_i)
    np.testing.assert_allclose(found.r, 0, atol=1e-14)
    np.testing.assert_allclose(found.J_line @ host_line.jacobian([0.37, 1.1], R_HL), 0, atol=1e-14)


@pytest.mark.row(23)
def test_one_camera_factor_is_the_world_factor_with_the_camera_as_world(two_views):
    v = two_views
    alone = line(np.eye(4), np.eye(4), v.L_Ci, v.ends_i + 0.01)
    moved = line(v.T_WBi, v.T_BC, lines.line_motion(v.T_WBi @ v.T_BC) @ v.L_Ci, v.ends_i + 0.01)
    np.testing.assert_allclose(alone.r, moved.r, atol=1e-12)
    np.testing.assert_allclose(alone.J_line, moved.J_line @ lines.line_motion(v.T_WBi @ v.T_BC), atol=1e-9)


@pytest.mark.row(27)
def test_start_frame_factor_has_the_line_block_of_the_relative_motion(two_views):
    """The line lives in the first camera; the observing camera's pose is relative to it."""
    v = two_views
    T_CiCj = rigid_inverse(v.T_WBi @ v.T_BC) @ v.T_WBj @ v.T_BC
    found = line(T_CiCj, np.eye(4), v.L_Ci, v.ends_j)
    np.testing.assert_allclose(found.r, in_camera(v, v.T_WBi, v.T_WBj, v.T_BC, v.L_Ci).r, atol=1e-12)
    check(found.J_line, numeric(lambda d: line(T_CiCj, np.eye(4), v.L_Ci + d, v.ends_j).r, 6, 1e-4))


# Points in the camera's frame and the step that suits their distance
POINTS = {'general': ([0.4, -0.3, 3.0], 1e-3), 'far': ([200.0, 100.0, 1000.0], 1e-3),
          'on the axis': ([0.0, 0.0, 2.0], 1e-3), 'nearly at the camera': ([0.001, 0.002, 0.0015], 1e-6),
          'at the edge of a wide view': ([5.0, 3.0, 1.0], 1e-4)}


@pytest.fixture(params=[(name, seed) for name in POINTS for seed in SEEDS[:3]], ids=lambda p: f'{p[0]}, seed {p[1]}')
def point_case(request):
    name, seed = request.param
    rng = np.random.default_rng(seed)
    p_C, h = POINTS[name]
    T_WB, T_BC = random_pose(rng), random_pose(rng, np.pi if seed == 0 else None)
    p_W = transform_points(T_WB @ T_BC, np.array([p_C]))[0]
    return SimpleNamespace(T_WB=T_WB, T_BC=T_BC, p_W=p_W, p_C=np.array(p_C), x=rng.normal(size=2), h=h)


def test_point_residual_is_projection_minus_observation(point_case):
    c = point_case
    np.testing.assert_allclose(point(c.T_WB, c.T_BC, c.p_W, c.x).r, to_image(c.p_C) - c.x, atol=1e-11)


def test_point_jacobian_by_the_body_pose(point_case):
    c = point_case
    check(point(c.T_WB, c.T_BC, c.p_W, c.x).J_pose,
          numeric(lambda d: point(pose_plus(c.T_WB, d), c.T_BC, c.p_W, c.x).r, 6, c.h))


def test_point_jacobian_by_the_extrinsic(point_case):
    c = point_case
    check(point(c.T_WB, c.T_BC, c.p_W, c.x).J_ext,
          numeric(lambda d: point(c.T_WB, pose_plus(c.T_BC, d), c.p_W, c.x).r, 6, c.h))


def test_point_jacobian_by_the_point(point_case):
    c = point_case
    check(point(c.T_WB, c.T_BC, c.p_W, c.x).J_point,
          numeric(lambda d: point(c.T_WB, c.T_BC, c.p_W + d, c.x).r, 3, c.h * max(1.0, c.p_C[2])))


@pytest.mark.row(33)
@pytest.mark.trap('points behind the camera')
@pytest.mark.parametrize('depth', [0.0, -1.0, 1e-4, np.nan])
def test_point_not_in_front_of_the_camera_is_refused_and_nothing_is_written(depth):
    found = point(np.eye(4), np.eye(4), np.array([0.1, 0.2, depth]), np.zeros(2))
    assert not found.valid
    assert np.isnan(np.concatenate([found.r, found.J_pose.ravel(), found.J_ext.ravel(), found.J_point.ravel()])).all()


@pytest.mark.parametrize('rho', [1e-3, 0.2, 5.0, -0.1])
def test_inverse_depth_point_and_its_jacobian(rho):
    T_WA = random_pose(np.random.default_rng(1))
    coordinates = np.array([0.2, -0.3, rho])

    def moved(delta):
        p_W, J = np.empty(3), np.empty((3, 3))
        inverse_depth_point(*parts(T_WA), coordinates + delta, p_W, J)
        return p_W, J

    p_W, J = moved(np.zeros(3))
    p_A = np.array([[0.2, -0.3, 1.0]]) / rho
    np.testing.assert_allclose(p_W, transform_points(T_WA, p_A)[0], rtol=1e-12, atol=1e-12)
    check(J, numeric(lambda d: moved(d)[0], 3, 1e-3 * abs(rho)), rtol=1e-5)


@pytest.mark.parametrize('seed', SEEDS)
def test_residuals_alone_are_those_that_come_with_jacobians(seed):
    rng = np.random.default_rng(seed)
    T_WB, T_BC, r = random_pose(rng), random_pose(rng), np.full(2, np.nan)
    p_W, x = (T_WB @ T_BC @ [0.3, -0.2, 4.0, 1.0])[:3], rng.normal(size=2)
    assert point_residual(*parts(T_WB), *parts(T_BC), p_W, x, r)
    np.testing.assert_allclose(r, point(T_WB, T_BC, p_W, x).r, rtol=1e-12)
    L_W, ends = rng.normal(size=6), rng.normal(size=(2, 2))
    assert line_residual(*parts(T_WB), *parts(T_BC), L_W[:3].copy(), L_W[3:].copy(), ends, r)
    np.testing.assert_allclose(r, line(T_WB, T_BC, L_W, ends).r, rtol=1e-12)


def test_residuals_alone_refuse_what_has_no_image():
    here, r = parts(np.eye(4)), np.full(2, np.nan)
    assert not point_residual(*here, *here, np.array([0.1, 0.2, -1.0]), np.zeros(2), r)
    assert not line_residual(*here, *here, np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.zeros((2, 2)), r)
    assert np.isnan(r).all()
