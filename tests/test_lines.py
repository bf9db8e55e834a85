"""Pluecker lines and planes: incidence, motion, triangulation and trimming, at all scales and where they degenerate."""
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from line_slam_ros.geometry import lines
from line_slam_ros.geometry.lie import (
    matrix_from_quaternion,
    pose_plus,
    rigid,
    rigid_inverse,
    so3_exp,
    transform_points,
)

repeatable = settings(deadline=None, derandomize=True)
HOUSE = Path(__file__).parents[1].parent / 'shared' / 'data' / 'house_sim'

vec3 = arrays(float, 3, elements=st.floats(-100, 100, allow_subnormal=False))


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def random_pose(rng, batch=()):
    return rigid(so3_exp(rng.normal(size=(*batch, 3))), rng.normal(size=(*batch, 3)))


def up_to_scale(L):
    """Comparable form of lines: norm 1, largest number positive."""
    L = L / np.linalg.norm(L, axis=-1, keepdims=True)
    return L * np.sign(np.take_along_axis(L, np.argmax(np.abs(L), axis=-1)[..., None], axis=-1))


def cameras_around(rng, a, b, count):
    """Poses T_WC whose optical axes go roughly to the middle of a segment, and its exact ends in each image."""
    T_WC, ends = [], []
    for _ in range(count):
        forward = rng.normal(size=3)
        forward /= np.linalg.norm(forward)
        side = np.cross(forward, rng.normal(size=3))
        side /= np.linalg.norm(side)
        R = np.column_stack([side, np.cross(forward, side), forward])
        T_WC.append(rigid(R @ so3_exp(0.1 * rng.normal(size=3)), (a + b) / 2 - rng.uniform(3, 6) * forward))
        p_C = transform_points(rigid_inverse(T_WC[-1]), np.stack([a, b]))
        ends.append(p_C[:, :2] / p_C[:, 2:])
    return np.array(T_WC), np.array(ends)


@pytest.mark.row(1)
@repeatable
@given(vec3, vec3)
def test_line_of_two_points_contains_both_and_its_moment_is_perpendicular(a, b):
    assume(np.linalg.norm(b - a) > 1e-3)
    L = lines.line_from_points(a, b)
    scale = 1 + np.linalg.norm(a) + np.linalg.norm(b)
    assert abs(L[:3] @ L[3:]) < 1e-12 * scale**3
    np.testing.assert_allclose(lines.point_distance(L, np.stack([a, b])), 0, atol=1e-12 * scale**2)
    np.testing.assert_allclose(lines.line_through(a, b - a), L, atol=1e-13 * scale**2)


@pytest.mark.row(1)
@pytest.mark.trap('line through the origin')
def test_equal_points_give_no_direction_and_a_line_through_the_origin_no_moment():
    assert np.isnan(lines.unit_direction(lines.line_from_points([1, 2, 3], [1, 2, 3]))).all()
    np.testing.assert_allclose(lines.line_from_points([1, 2, 3], [2, 4, 6]), [0, 0, 0, 1, 2, 3])


@pytest.mark.row(1, 2)
def test_moment_over_direction_is_the_distance_of_the_foot(rng):
    L = lines.unit_direction(lines.line_from_points(*rng.normal(size=(2, 50, 3))))
    foot = lines.closest_point(L)
    np.testing.assert_allclose(np.linalg.norm(foot, axis=-1), np.linalg.norm(L[:, :3], axis=-1), atol=1e-12)
    np.testing.assert_allclose(np.sum(foot * L[:, 3:], axis=-1), 0, atol=1e-12)
    np.testing.assert_allclose(lines.point_distance(L, foot), 0, atol=1e-12)


@pytest.mark.row(2)
def test_closest_point_is_on_the_line_and_nearer_than_its_neighbours(rng):
    L, p = lines.line_from_points(*rng.normal(size=(2, 50, 3))), rng.normal(size=(50, 3))
    foot = lines.closest_point(L, p)
    d = lines.unit_direction(L)[:, 3:]
    np.testing.assert_allclose(lines.point_distance(L, foot), 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(foot - p, axis=-1), lines.point_distance(L, p), atol=1e-12)
    for step in (-1e-3, 1e-3):
        assert (np.linalg.norm(foot + step * d - p, axis=-1) > lines.point_distance(L, p)).all()


@pytest.mark.parametrize('factor', [-1.0, 1e-6, 1e6])
def test_a_factor_on_a_line_does_not_change_it(rng, factor):
    L, other = lines.line_from_points(*rng.normal(size=(2, 2, 9, 3)))
    p = rng.normal(size=(9, 3))
    np.testing.assert_allclose(lines.closest_point(factor * L, p), lines.closest_point(L, p))
    np.testing.assert_allclose(lines.point_distance(factor * L, p), lines.point_distance(L, p))
    np.testing.assert_allclose(lines.line_angle(factor * L, other), lines.line_angle(L, other))
    np.testing.assert_allclose(lines.line_distance(factor * L, other), lines.line_distance(L, other))


@pytest.mark.parametrize('angle', [1e-9, 1e-4, 0.5, np.pi / 2])
def test_angle_and_common_perpendicular_of_crossing_lines(rng, angle):
    T = random_pose(rng, (20,))
    first = lines.line_through([0.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    second = lines.line_through([0.0, 0.0, 0.7], [np.cos(angle), np.sin(angle), 0.0])
    moved = lines.transform_lines(T, np.stack([first, second]))
    np.testing.assert_allclose(lines.line_angle(moved[:, 0], -moved[:, 1]), angle, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(lines.line_distance(moved[:, 0], moved[:, 1]), 0.7, rtol=1e-6)


def test_distance_of_parallel_lines_is_theirs_whatever_the_sign_of_direction():
    first, second = lines.line_through([0, 0, 0], [0, 0, 2.0]), lines.line_through([3.0, 4.0, 9.0], [0, 0, -1.0])
    np.testing.assert_allclose(lines.line_distance(first, second), 5)
    np.testing.assert_allclose(lines.line_angle(first, second), 0)


@pytest.mark.row(10)
def test_motion_of_a_line_is_the_motion_of_its_points(rng):
    T_AB = random_pose(rng)
    a_B, b_B = rng.normal(size=(2, 30, 3))
    expected = lines.line_from_points(transform_points(T_AB, a_B), transform_points(T_AB, b_B))
    L_B = lines.line_from_points(a_B, b_B)
    np.testing.assert_allclose(lines.transform_lines(T_AB, L_B), expected, atol=1e-13)
    np.testing.assert_allclose(L_B @ lines.line_motion(T_AB).T, expected, atol=1e-13)


@pytest.mark.row(10)
def test_motion_matrices_multiply_and_invert_like_the_motions(rng):
    T_AB, T_BC = random_pose(rng, (5,)), random_pose(rng, (5,))
    H_AB, H_BC = lines.line_motion(T_AB), lines.line_motion(T_BC)
    np.testing.assert_allclose(lines.line_motion(T_AB @ T_BC), H_AB @ H_BC, atol=1e-13)
    np.testing.assert_allclose(lines.line_motion(rigid_inverse(T_AB)), np.linalg.inv(H_AB), atol=1e-13)


@pytest.mark.parametrize('angle', [0.0, 1e-9, 1.0, np.pi])
@pytest.mark.parametrize('distance', [0.0, 1e-6, 3.0])
def test_line_motion_jacobian_is_the_derivative_by_the_pose(rng, angle, distance):
    T_AB = rigid(so3_exp([0.0, 0.6 * angle, 0.8 * angle]), rng.normal(size=3))
    L_B = lines.line_through([distance, 0.0, 0.0], [0.0, 0.6, 0.8])

    def moved(delta):
        return lines.line_motion(pose_plus(T_AB, delta)) @ L_B

    h = 1e-6
    numeric = np.stack([(moved(h * e) - moved(-h * e)) / (2 * h) for e in np.eye(6)], axis=-1)
    np.testing.assert_allclose(lines.line_motion_jacobian(T_AB, L_B), numeric, atol=1e-8)


def test_line_motion_jacobian_is_batched(rng):
    T_AB, L_B = random_pose(rng, (4,)), lines.line_from_points(*rng.normal(size=(2, 4, 3)))
    expected = [lines.line_motion_jacobian(T, L) for T, L in zip(T_AB, L_B, strict=True)]
    np.testing.assert_allclose(lines.line_motion_jacobian(T_AB, L_B), expected, atol=1e-14)


@pytest.mark.row(12)
@pytest.mark.parametrize('skew', [0.0, 7.0])
def test_projected_line_goes_through_the_projected_points(rng, skew):
    K = np.array([[458.0, skew, 367.0], [0.0, 457.0, 248.0], [0.0, 0.0, 1.0]])
    a, b = rng.normal(size=(2, 20, 3)) + [0, 0, 5]
    line = lines.line_from_points(a, b)[:, :3] @ lines.line_projection_matrix(K).T
    expected = np.cross(a @ K.T, b @ K.T)
    scale = np.linalg.norm(expected, axis=-1, keepdims=True) ** 2
    np.testing.assert_allclose(np.cross(line, expected) / scale, 0, atol=1e-12)
    fx, fy, x0, y0 = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    np.testing.assert_allclose(lines.line_projection_matrix(K), [
        [fy, 0, 0], [-skew, fx, 0], [skew * y0 - fy * x0, -fx * y0, fx * fy]], atol=1e-9)


@pytest.mark.row(7)
@repeatable
@given(vec3, vec3, vec3)
def test_plane_of_three_points_contains_them_or_is_nan(a, b, c):
    P = lines.plane_from_points(a, b, c)
    assume(np.linalg.norm(np.cross(b - a, c - a)) > 1e-3)
    np.testing.assert_allclose(np.stack([a, b, c]) @ P[:3] + P[3], 0, atol=1e-6)
    assert np.linalg.norm(P[:3]) == pytest.approx(1)


@pytest.mark.row(7)
def test_three_points_on_a_line_have_no_plane():
    assert np.isnan(lines.plane_from_points([0, 0, 1], [0, 0, 2], [0, 0, 5])).all()
    assert np.isnan(lines.plane_from_points([1, 1, 1], [1, 1, 1], [0, 0, 5])).all()


def test_observation_plane_contains_the_centre_and_the_segment(rng):
    a, b = rng.normal(size=(2, 3))
    T_WC, ends = cameras_around(rng, a, b, 8)
    P = lines.observation_plane(T_WC, ends)
    for p in (a, b, T_WC[:, :3, 3]):
        np.testing.assert_allclose(np.sum(P[:, :3] * p, axis=-1) + P[:, 3], 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(P[:, :3], axis=-1), 1)


def test_a_segment_without_length_has_no_observation_plane():
    assert np.isnan(lines.observation_plane(np.eye(4), [[0.1, 0.2], [0.1, 0.2]])).all()


@pytest.mark.row(8)
def test_two_planes_meet_in_their_line(rng):
    a, b = rng.normal(size=(2, 40, 3))
    P_1, P_2 = (lines.plane_from_points(a, b, rng.normal(size=(40, 3))) for _ in range(2))
    L = lines.line_from_planes(P_1, P_2)
    np.testing.assert_allclose(up_to_scale(L), up_to_scale(lines.line_from_points(a, b)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(L[:, 3:], axis=-1), 1)


@pytest.mark.row(8, 9)
@pytest.mark.trap('coincident planes')
@pytest.mark.parametrize('offset', [0.0, 1.0])
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_parallel_and_coincident_planes_are_reported_as_nan(offset, sign):
    P = np.array([0.6, 0.0, 0.8, 2.0])
    other = sign * (P + [0, 0, 0, offset])
    assert np.isnan(lines.line_from_planes(P, other)).all()
    if offset == 0.0:
        assert np.isnan(lines.line_from_many_planes([P, other, P])).all()


@pytest.mark.row(9)
def test_the_line_of_many_exact_planes_is_exact_and_rows_of_zeros_do_not_count(rng):
    a, b = rng.normal(size=(2, 3))
    planes = lines.observation_plane(*cameras_around(rng, a, b, 20))
    L = lines.line_from_many_planes(np.stack([planes, np.where(np.arange(20)[:, None] < 2, planes, 0.0)]))
    expected = up_to_scale(lines.line_from_points(a, b))
    np.testing.assert_allclose(up_to_scale(L), [expected, expected], atol=1e-10)
    np.testing.assert_allclose(np.sum(L[:, :3] * L[:, 3:], axis=-1), 0, atol=1e-12)


def test_segments_without_length_count_for_nothing(rng):
    a, b = rng.normal(size=(2, 3))
    T_WC, ends = cameras_around(rng, a, b, 6)
    ends[3, 1] = ends[3, 0]
    planes = lines.observation_plane(T_WC, ends)
    assert np.isnan(planes[3]).all()
    others = np.delete(planes, 3, axis=0)
    found, expected = (up_to_scale(lines.line_from_many_planes(some)) for some in (planes, others))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    i, j, cosine = lines.widest_pair(planes)
    assert 3 not in (i, j)
    assert cosine == lines.widest_pair(others)[2]


@pytest.mark.row(9)
def test_under_noise_many_planes_beat_the_widest_pair(rng):
    errors = []
    for _ in range(30):
        a, b = rng.normal(size=(2, 3))
        T_WC, ends = cameras_around(rng, a, b, 30)
        planes = lines.observation_plane(T_WC, ends + rng.normal(size=ends.shape) * 3 / 460)
        i, j, _ = lines.widest_pair(planes)
        both = lines.line_from_many_planes(planes), lines.line_from_planes(planes[i], planes[j])
        errors.append([lines.point_distance(L, (a + b) / 2) for L in both])
    many, pair = np.mean(errors, axis=0)
    assert many < 0.5 * pair


@pytest.mark.row(9, 32)
@pytest.mark.skipif(not HOUSE.is_dir(), reason=f'the house experiment of the shared data is missing: {HOUSE}')
def test_clean_views_of_the_house_give_its_lines_and_segments():
    """A fifth of 29346 views of 80 edges; poses are stored with five decimals, which the tolerances (m) allow for."""
    stored = np.loadtxt(HOUSE / 'cam_pose_tum.txt')
    segments = np.loadtxt(HOUSE / 'house.txt').reshape(-1, 2, 3)
    observed = np.loadtxt(HOUSE / 'observations.txt')[::5]
    line, ends = observed[:, 1].astype(int), observed[:, 2:].reshape(-1, 2, 2)
    T_WC = rigid(matrix_from_quaternion(stored[:, 4:]), stored[:, 1:4])[observed[:, 0].astype(int)]
    planes = lines.observation_plane(T_WC, ends)
    found = np.array([lines.line_from_many_planes(planes[line == k]) for k in range(len(segments))])
    assert lines.point_distance(found, segments.mean(axis=1)).mean() < 2e-5
    L_C = lines.transform_lines(rigid_inverse(T_WC), found[line][:, None])[:, 0]
    trimmed = transform_points(T_WC, lines.trim(L_C, ends))
    middle = [np.nanmedian(trimmed[line == k], axis=0) for k in range(len(segments))]
    np.testing.assert_allclose(middle, segments, atol=1e-4)


@pytest.mark.row(29)
@pytest.mark.trap('swapped end points')
def test_widest_pair_does_not_care_about_the_order_of_the_ends(rng):
    a, b = rng.normal(size=(2, 3))
    T_WC, ends = cameras_around(rng, a, b, 12)
    planes = lines.observation_plane(T_WC, ends)
    straight = lines.widest_pair(planes)
    ends[::2] = ends[::2, ::-1]
    swapped = lines.widest_pair(lines.observation_plane(T_WC, ends))
    assert swapped[:2] == straight[:2]
    assert swapped[2] == pytest.approx(straight[2])
    assert straight[2] == pytest.approx(min(lines.plane_cosine(p, q) for p in planes for q in planes))


@pytest.mark.row(29)
@pytest.mark.trap('motion along the line')
@pytest.mark.trap('motion within the observation plane')
@pytest.mark.trap('pure rotation')
@pytest.mark.parametrize('motion', ['along the line', 'within the observation plane', 'rotation only'])
def test_motions_that_cannot_show_depth_have_no_parallax(motion):
    a, b = np.array([-1.0, 0.5, 4.0]), np.array([1.0, 0.5, 4.0])
    moved = {'along the line': rigid(so3_exp([0.0, 0.1, 0.0]), [0.5, 0.0, 0.0]),
             'within the observation plane': rigid(so3_exp([0.05, 0.0, 0.1]), [0.3, 0.25, 2.0]),
             'rotation only': rigid(so3_exp([0.1, -0.1, 0.2]), [0.0, 0.0, 0.0])}[motion]
    T_WC = np.stack([np.eye(4), moved])
    p_C = transform_points(rigid_inverse(T_WC), np.stack([a, b]))
    planes = lines.observation_plane(T_WC, p_C[..., :2] / p_C[..., 2:])
    assert lines.widest_pair(planes)[2] == pytest.approx(1, abs=1e-12)
    assert np.isnan(lines.line_from_planes(*planes)).all()


@pytest.mark.row(31)
@pytest.mark.parametrize('form', ['projected', 'segment', 'plane'])
def test_all_forms_of_trimming_recover_the_ends_from_exact_views(rng, form):
    a, b = rng.normal(size=(2, 3))
    T_WC, ends = cameras_around(rng, a, b, 10)
    T_CW = rigid_inverse(T_WC)
    L_C = lines.transform_lines(T_CW, lines.line_from_points(a, b)[None])[:, 0]
    np.testing.assert_allclose(lines.trim(L_C, ends, form), transform_points(T_CW, np.stack([a, b])), atol=1e-9)


@pytest.mark.row(31)
def test_projected_form_trims_at_the_orthogonal_foot_in_the_image_even_off_the_line(rng):
    p, q = rng.normal(size=(2, 30, 3)) * [1, 1, 0.3] + [0, 0, 5]
    L_C = lines.line_from_points(p, q)
    ends = np.stack([p, q], axis=1)[..., :2] / np.stack([p, q], axis=1)[..., 2:] + 0.01 * rng.normal(size=(30, 2, 2))
    trimmed = lines.trim(L_C, ends)
    image = trimmed[..., :2] / trimmed[..., 2:]
    normal = L_C[:, None, :2]
    np.testing.assert_allclose(lines.point_distance(L_C[:, None], trimmed), 0, atol=1e-9)
    offset = ends - image
    np.testing.assert_allclose(offset[..., 0] * normal[..., 1] - offset[..., 1] * normal[..., 0], 0, atol=1e-10)
    residual = (np.sum(normal * ends, axis=-1) + L_C[:, 2:3]) / np.linalg.norm(normal, axis=-1)
    np.testing.assert_allclose(np.linalg.norm(offset, axis=-1), np.abs(residual), atol=1e-10)


@pytest.mark.row(31)
@pytest.mark.parametrize('form', ['segment', 'plane'])
def test_other_forms_trim_in_the_plane_of_the_ray_and_their_own_normal(rng, form):
    p, q = rng.normal(size=(2, 30, 3)) * [1, 1, 0.3] + [0, 0, 5]
    L_C, both = lines.line_from_points(p, q), np.stack([p, q], axis=1)
    rays = both / both[..., 2:] + [1, 1, 0] * (0.01 * rng.normal(size=(30, 2, 3)))
    trimmed = lines.trim(L_C, rays[..., :2], form)
    np.testing.assert_allclose(lines.point_distance(L_C[:, None], trimmed), 0, atol=1e-9)
    if form == 'segment':  # the offset in the image is perpendicular to the observed segment
        offset = rays[..., :2] - trimmed[..., :2] / trimmed[..., 2:]
        np.testing.assert_allclose(np.sum(offset * np.diff(rays[..., :2], axis=1), axis=-1), 0, atol=1e-12)
    else:
        across = np.cross(rays[:, :1], rays[:, 1:])
        np.testing.assert_allclose(np.sum(trimmed * np.cross(rays, across), axis=-1), 0, atol=1e-9)


@pytest.mark.row(33)
@pytest.mark.trap('points behind the camera')
@pytest.mark.trap('near end-on views')
@pytest.mark.source_error('D2 TrimLine')
def test_points_behind_the_camera_and_lines_seen_end_on_are_nan():
    ends = np.array([[0.1, 0.0], [0.2, 0.0]])
    behind = lines.line_from_points([-0.4, 0.0, -4.0], [-0.8, 0.0, -4.0])
    assert np.isnan(lines.trim(behind, ends)).all()
    end_on = lines.line_through([0.0, 0.0, 0.0], [0.1, 0.0, 1.0])  # its image is one point
    assert np.isnan(lines.trim(end_on, ends)).all()
    half = lines.line_from_points([1.0, 0.0, 10.0], [-1.0, 0.0, -5.0])  # crosses z = 0 within the segment
    trimmed = lines.trim(half, [[0.1, 0.0], [0.2, 0.0]])
    assert np.isfinite(trimmed[0]).all() and np.isnan(trimmed[1]).all()


@pytest.mark.row(32, 33)
@pytest.mark.trap('one bad frame')
def test_a_view_that_cannot_be_trimmed_does_not_stop_the_others(rng):
    a, b = rng.normal(size=(2, 3))
    T_WC, ends = cameras_around(rng, a, b, 3)
    L_C = lines.transform_lines(rigid_inverse(T_WC), lines.line_from_points(a, b)[None])[:, 0]
    L_C[1] *= [-1, -1, -1, 1, 1, 1]  # mirrored behind its camera
    found = np.isfinite(lines.trim(L_C, ends)).all(axis=(1, 2))
    np.testing.assert_array_equal(found, [True, False, True])


def test_an_unknown_form_of_trimming_names_those_that_exist():
    with pytest.raises(ValueError, match="projected, segment, plane, got 'nearest'"):
        lines.trim(np.ones(6), np.zeros((2, 2)), 'nearest')
