"""The documented traps of line geometry, walked into from end to end: views in, line and ends out."""
from dataclasses import replace

import numpy as np
import pytest
from line_scene import FOCAL, clipped, looking, see, views

from line_slam_ros.config import Config, Mapping
from line_slam_ros.estimation.line_mapper import LineEstimator
from line_slam_ros.factors.line_reprojection import line_reprojection
from line_slam_ros.geometry import lines, orthonormal
from line_slam_ros.geometry.lie import matrix_from_quaternion, quaternion_from_matrix, rigid, rigid_inverse, so3_exp
from line_slam_ros.mapping.line_map import LineMap
from line_slam_ros.types import LineObservations

A, B = np.array([-1.0, 4.0, 0.2]), np.array([1.0, 4.5, 0.6])


@pytest.fixture
def rng():
    return np.random.default_rng(17)


def mapped(T_WC, ends, **mapping):
    """What the mapper makes of one line's views, with its defaults but for those given."""
    config = replace(Config(), mapping=Mapping(**mapping))
    estimator, line_map = LineEstimator(config), LineMap(config.mapping)
    for T, seen in zip(T_WC, ends, strict=True):
        estimator.add(LineObservations(np.array([0]), seen[None], np.full((1, 2), 1e-3)), T)
        estimator.hand_over(line_map)
    return line_map.segments()


def assert_found(segments, a, b, atol):
    assert len(segments) == 1
    ends = segments.ends[0]
    np.testing.assert_allclose(ends if (ends[1] - ends[0]) @ (b - a) > 0 else ends[::-1], [a, b], atol=atol)


@pytest.mark.trap('plane z = 0')
@pytest.mark.trap('line through the origin')
@pytest.mark.parametrize('name, a, b', [
    ('on the floor', [-1.0, 4.0, 0.0], [1.0, 4.5, 0.0]), ('through the origin', [-1.0, 0.1, 0.2], [1.0, -0.1, -0.2]),
    ('along x through the origin', [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]), ('upright', [0.3, 4.0, -1.0], [0.3, 4.0, 1.0])])
def test_lines_at_the_singularities_of_the_angles_are_mapped_exactly(rng, name, a, b):
    a, b = np.array(a), np.array(b)
    assert_found(mapped(*views(rng, a, b, 12), max_sigma_m=0.1), a, b, 1e-6)


def refined(U, phi, T_WC, ends, steps=20):
    """Gauss-Newton on the residuals of all views by the orthonormal update, about the world's origin."""
    r, J_pose, J_ext, J_line = np.empty(2), np.empty((2, 6)), np.empty((2, 6)), np.empty((2, 6))
    for _ in range(steps):
        L_W, H, g = orthonormal.pluecker_from_orthonormal(U, phi), np.zeros((4, 4)), np.zeros(4)
        for T, seen in zip(T_WC, ends, strict=True):
            assert line_reprojection(np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy(), np.eye(3), np.zeros(3),
                                     L_W[:3], L_W[3:], seen, r, J_pose, J_ext, J_line)
            J = J_line @ orthonormal.jacobian_right(U, phi)
            H, g = H + J.T @ J, g + J.T @ r
        U, phi = orthonormal.plus_right(U, phi, -np.linalg.solve(H, g))
    return U, phi


@pytest.mark.trap('phi across 0 and pi/2')
def test_the_estimate_passes_the_origin(rng):
    """The truth is 5 cm on one side of the origin, the start 5 cm on the other: phi passes pi/2 in between."""
    true, start = (lines.line_through([0.0, 0.0, z], [1.0, 0.1, 0.0]) for z in (0.05, -0.05))
    U, phi = orthonormal.orthonormal_from_pluecker(true)
    T_WC, ends = views(rng, *([x, 0.1 * x, 0.05] for x in (-1.0, 1.0)), 8)
    U_start, phi_start = orthonormal.plus_right(U, phi, [0.0, 0.0, 0.0, 2 * (np.pi / 2 - phi)])
    np.testing.assert_allclose(lines.line_distance(orthonormal.pluecker_from_orthonormal(U_start, phi_start), start), 0,
                               atol=1e-12)
    U_end, phi_end = refined(U_start, phi_start, T_WC, ends)
    assert phi_start > np.pi / 2 > phi_end
    np.testing.assert_allclose(orthonormal.pluecker_from_orthonormal(U_end, phi_end),
                               orthonormal.pluecker_from_orthonormal(U, phi), atol=1e-12)


@pytest.mark.trap('phi across 0 and pi/2')
def test_the_estimate_comes_back_from_beyond_infinity(rng):
    """A line 100 m away whose start lies at -100 m: phi passes 0 in between."""
    a, b = np.array([-40.0, 100.0, 3.0]), np.array([40.0, 100.0, 8.0])
    T_WC = np.stack([looking([x, 0.0, z], [0.0, 100.0, 5.0]) for x, z in ((0, 0), (5, 3), (-6, 8), (3, -9), (0, 12.0))])
    ends = np.stack([see(T, a, b) for T in T_WC])
    U, phi = orthonormal.orthonormal_from_pluecker(lines.line_from_points(a, b))
    U_end, phi_end = refined(U, -phi, T_WC, ends)
    assert phi_end > 0.0
    np.testing.assert_allclose(orthonormal.pluecker_from_orthonormal(U_end, phi_end),
                               orthonormal.pluecker_from_orthonormal(U, phi), atol=1e-10)


@pytest.mark.trap('coincident planes')
@pytest.mark.trap('motion along the line')
@pytest.mark.trap('motion within the observation plane')
@pytest.mark.trap('pure rotation')
@pytest.mark.parametrize('along, ahead', [(0.3, 0.0), (0.0, 0.3), (0.3, 0.2), (0.0, 0.0)])
@pytest.mark.parametrize('px', [0.0, 0.5])
def test_views_from_one_plane_make_no_line(rng, along, ahead, px):
    """However the camera moves within the plane of its centre and the line, and turns."""
    d, towards = (B - A) / np.linalg.norm(B - A), (A + B) / 2
    T_WC = np.stack([rigid(looking(np.zeros(3), towards)[:3, :3] @ so3_exp(0.05 * rng.normal(size=3)),
                           k / 12 * (along * d + ahead * towards)) for k in range(12)])
    ends = np.stack([see(T, A, B) for T in T_WC]) + rng.normal(size=(12, 2, 2)) * px / FOCAL
    assert len(mapped(T_WC, ends)) == 0


@pytest.mark.trap('swapped end points')
@pytest.mark.trap('one bad frame')
@pytest.mark.source_error('D2 updatelineplk break')
@pytest.mark.row(32)
@pytest.mark.parametrize('bad', range(12))
def test_a_bad_view_changes_nothing_wherever_it_comes_also_first(rng, bad):
    T_WC, ends = views(rng, A, B, 12)
    ends[::3] = ends[::3, ::-1]
    line_map = LineMap(Mapping())
    line_map.refine(np.array([0]), lines.unit_direction(lines.line_from_points(A, B))[None], np.zeros((1, 6, 6)),
                    np.array([12]))
    ends[bad] = [[0.3, 0.2], [0.31, -0.4]]
    for T, seen in zip(T_WC, ends, strict=True):
        line_map.observe(np.array([0]), seen[None], T)
    assert_found(line_map.segments(), A, B, 1e-9)


@pytest.mark.trap('partial views')
@pytest.mark.trap('line longer than 8 m')
@pytest.mark.row(32)
def test_partial_views_of_a_long_line_recover_it(rng):
    """Each end is reached by one view in six; twenty metres, no noise."""
    a, b = np.array([-10.0, 12.0, 0.0]), np.array([10.0, 13.0, 0.5])
    T_WC, ends = views(rng, a, b, 48, part=clipped(rng), distance=12.0)
    assert_found(mapped(T_WC, ends, max_sigma_m=0.1), a, b, 0.1)


@pytest.mark.trap('points behind the camera')
@pytest.mark.row(33)
@pytest.mark.parametrize('form', ['projected', 'segment', 'plane'])
def test_a_camera_that_turns_its_back_trims_nothing(rng, form):
    T_WC, ends = views(rng, A, B, 5)
    away = T_WC @ rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))  # the same planes, seen from behind
    L_C = lines.transform_lines(rigid_inverse(away), lines.line_from_points(A, B)[None])[:, 0]
    assert np.isnan(lines.trim(L_C, ends * [-1.0, 1.0], form)).all()


@pytest.mark.trap('near end-on views')
@pytest.mark.parametrize('degrees, used', [(3.0, False), (8.0, True)])
def test_the_map_uses_no_foot_at_less_than_five_degrees_to_the_line(rng, degrees, used):
    direction = (B - A) / np.linalg.norm(B - A)
    line_map = LineMap(Mapping(min_parallax_deg=0.0))
    line_map.refine(np.array([0]), lines.line_through(A, direction)[None], np.zeros((1, 6, 6)), np.array([9]))
    side = np.cross(direction, [0.0, 0.0, 1.0])
    eye = B + 6.0 * direction + 6.0 * np.tan(np.radians(degrees)) * side  # seen from there, A is at a flatter angle
    for _ in range(9):
        line_map.observe(np.array([0]), see(looking(eye, B), B, B - 0.5 * direction)[None], looking(eye, B))
    assert bool(len(line_map.segments())) is used


@pytest.mark.trap('quaternion not of unit length')
@pytest.mark.parametrize('factor', [1e-3, 0.99999, 1.0, 1.00001, 700.0])
def test_a_pose_from_a_quaternion_of_any_length_is_a_pose(rng, factor):
    R = so3_exp(rng.normal(size=(20, 3)))
    found = matrix_from_quaternion(factor * quaternion_from_matrix(R))
    np.testing.assert_allclose(found, R, atol=1e-14)
    T = rigid(found, 20.0 * rng.normal(size=(20, 3)))
    np.testing.assert_allclose(T @ rigid_inverse(T), np.broadcast_to(np.eye(4), T.shape), atol=1e-13)


@pytest.mark.trap('extrinsic not the identity')
@pytest.mark.row(11)
def test_a_camera_mounted_aside_sees_the_same_line_as_one_that_is_the_body(rng):
    """Residual by body pose and extrinsic, half turns included, against the camera's own pose."""
    L_W, out = lines.line_from_points(A, B), [np.empty((2, 6)) for _ in range(3)]
    for T_BC in (np.eye(4), rigid(so3_exp([0.0, np.pi, 0.0]), [0.1, 0.2, 0.3]), rigid(so3_exp(rng.normal(size=3)),
                                                                                     rng.normal(size=3))):
        (T_WC,), (ends,) = views(rng, A, B, 1, px=3.0)
        T_WB, r = T_WC @ rigid_inverse(T_BC), np.empty((2, 2))
        for k, (first, second) in enumerate(((T_WB, T_BC), (T_WC, np.eye(4)))):
            parts = [np.ascontiguousarray(T[:3, part]) for T in (first, second) for part in (slice(3), 3)]
            assert line_reprojection(*parts, L_W[:3], L_W[3:], ends, r[k], *out)
        np.testing.assert_allclose(r[0], r[1], atol=1e-13)
