"""The simulated house: its lines, its camera, and every effect on what the camera sees."""
from __future__ import annotations

import numpy as np
import pytest

from line_slam_ros.geometry.lie import rigid, rigid_inverse, so3_exp, transform_points
from line_slam_ros.geometry.lines import line_from_points, transform_lines
from line_slam_ros.simulation.house import (
    BODY,
    LEAST_PART,
    NEAREST,
    SHORTEST,
    Effects,
    Pinhole,
    closed_loop,
    look_at,
    observe,
    random_house,
)

CAMERA = Pinhole()
WIDE = Pinhole(752, 480, 450.0, 330.0, 370.0, 250.0)
SEEDS = range(5)


def elevation(segments):
    """Angle above the horizon (L,) in degrees."""
    d = segments[:, 1] - segments[:, 0]
    return np.degrees(np.arcsin(np.abs(d[:, 2]) / np.linalg.norm(d, axis=1)))


def views(seed=1, camera=CAMERA, frames=120, **effects):
    segments, (_, T_WC) = random_house(seed), closed_loop(seed, frames)
    return segments, T_WC, observe(segments, T_WC, camera, Effects(**effects), seed)


def residuals(segments, T_WC, frame, line, ends):
    """Distance (M, 2) of observed ends from the projected line, normalised units."""
    n = transform_lines(rigid_inverse(T_WC[frame]), line_from_points(*np.moveaxis(segments[line], 1, 0))[:, None])
    l_C = n[..., 0, :3] / np.linalg.norm(n[..., 0, :2], axis=-1, keepdims=True)
    return np.sum(ends * l_C[:, None, :2], axis=-1) + l_C[:, None, 2]


def whole_ends(segments, T_WC, frame, line):
    """Projection (M, 2, 2) of both ends of the whole segments; meaningless behind the camera."""
    p_C = transform_points(rigid_inverse(T_WC[frame]), segments[line])
    return p_C[..., :2] / p_C[..., 2:], p_C[..., 2]


def shares(ends, of):
    """Where ends (M, 2, 2) lie on the way from the first to the second of the segments ``of`` (M, 2, 2): (M, 2)."""
    d = of[:, 1] - of[:, 0]
    return np.sum((ends - of[:, :1]) * d[:, None], axis=-1) / np.sum(d * d, axis=-1)[:, None]


@pytest.mark.parametrize('seed', SEEDS)
def test_a_house_has_vertical_level_and_slanted_lines(seed):
    segments = random_house(seed)
    angle = elevation(segments)
    kinds = angle > 89.999, angle < 0.001, (angle > 10.0) & (angle < 75.0)
    assert len(segments) == 80 and np.all(np.sum(kinds, axis=0) == 1)
    assert min(map(np.sum, kinds)) >= 8  # gables, rails and what hangs on the walls
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    assert 0.5 < length.min() and 4.0 < length.max() < 10.0 and segments[..., 2].min() == 0.0
    assert np.abs(segments[..., :2]).max() < np.hypot(5.0, 5.0) and segments[..., 2].max() < 6.5


@pytest.mark.parametrize('lines', [BODY, BODY + 1, 37, 500])
def test_a_house_has_the_lines_asked_for(lines):
    segments = random_house(3, lines)
    assert segments.shape == (lines, 2, 3) and len(np.unique(segments.reshape(lines, 6), axis=0)) == lines
    assert {True, False} == set(elevation(segments) > 89.0)


@pytest.mark.parametrize('seed', SEEDS)
def test_a_house_stands_on_its_floor_and_ends_in_a_ridge(seed):
    segments = random_house(seed)
    low, high = np.sort(segments[..., 2], axis=1).T
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    assert np.sum(high == 0.0) == 4 and length[high == 0.0].min() >= 7.0  # edges of the floor, no sill of the door
    posts = (low == 0.0) & (elevation(segments) > 89.999)
    assert np.sum(posts) == 6 and np.sum(posts & (high < 2.5)) == 2  # four corners, two posts of the door
    top = np.abs(high - high.max()) < 1e-9
    tips = np.unique(segments[top][np.abs(segments[top][..., 2] - high.max()) < 1e-9].round(9), axis=0)
    assert np.sum(top) == 5 and len(tips) == 2  # four slants meet the two ends of the ridge
    slants = length[top & (high - low > 0.1)]
    assert len(slants) == 4 and np.ptp(slants) < 1e-9


def test_same_seed_same_bytes_other_seed_other_world():
    for make in (random_house, lambda seed: closed_loop(seed)[1], lambda seed: views(
            seed, noise_px=1.0, partial=0.3, outliers=0.1, swapped=0.5)[2][2]):
        assert make(4).tobytes() == make(4).tobytes()
        assert make(4).tobytes() != make(5).tobytes()


@pytest.mark.parametrize('seed', SEEDS)
def test_the_camera_goes_round_smoothly_upright_and_sees_every_line(seed):
    stamps, T_WC = closed_loop(seed)
    assert len(T_WC) == 600 and np.allclose(np.diff(stamps), 1 / 30)
    R, p = T_WC[:, :3, :3], T_WC[:, :3, 3]
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-14 and np.linalg.det(R).min() > 0.99
    assert np.abs(R[:, 2, 0]).max() < 1e-15 and R[:, 2, 1].max() < -0.75  # x level, y down
    step = np.linalg.norm(p - np.roll(p, 1, axis=0), axis=1)  # the last row leads on to the first
    assert step.max() < 0.05 and np.ptp(p[:, 2]) > 0.5
    turn = np.arccos(np.clip((np.einsum('nij,nij->n', R, np.roll(R, 1, axis=0)) - 1) / 2, -1, 1))
    assert np.degrees(turn).max() < 2.5
    segments = random_house(seed)
    _, line, _ = observe(segments, T_WC, CAMERA, Effects(), seed)
    assert np.bincount(line, minlength=len(segments)).min() >= 20


def test_look_at_puts_the_target_on_the_axis():
    rng = np.random.default_rng(0)
    p, target = rng.normal(size=(2, 20, 3))
    target_C = transform_points(rigid_inverse(look_at(p, target)), target[:, None])[:, 0]
    assert np.abs(target_C[:, :2]).max() < 1e-12 and np.allclose(target_C[:, 2], np.linalg.norm(target - p, axis=1))


@pytest.mark.parametrize('fov_limit', [True, False])
@pytest.mark.parametrize('camera', [CAMERA, WIDE])
def test_clean_views_lie_on_the_projected_lines(fov_limit, camera):
    segments, T_WC, (frame, line, ends) = views(camera=camera, fov_limit=fov_limit)
    assert np.abs(residuals(segments, T_WC, frame, line, ends)).max() < 1e-12
    assert len(np.unique(frame * len(segments) + line)) == len(frame)
    assert np.all(np.diff(frame) >= 0)
    long = np.linalg.norm((ends[:, 1] - ends[:, 0]) * camera.focals, axis=1)
    assert long.min() >= SHORTEST


@pytest.mark.parametrize('camera', [CAMERA, WIDE])
def test_the_field_of_view_ends_at_the_border_and_cuts_there(camera):
    segments, T_WC, (frame, line, ends) = views(camera=camera)
    uv = ends * camera.focals + (camera.cx, camera.cy)
    size = np.array([camera.width, camera.height])
    assert uv.min() > -1e-9 and np.all(uv < size + 1e-9)
    whole, depth = whole_ends(segments, T_WC, frame, line)
    cut = np.any(np.abs(ends - whole) > 1e-12, axis=-1) | (depth < NEAREST)
    at_border = np.any((uv < 1e-9) | (uv > size - 1e-9), axis=-1)
    assert np.all(at_border[cut]) and 0.1 < cut.mean() < 0.9
    inside = (depth > NEAREST) & np.all(np.abs(whole - camera.borders.mean(axis=0)) <= np.diff(camera.borders, axis=0)
                                        / 2, axis=-1)
    assert np.array_equal(inside, ~cut)


def test_without_the_limit_all_lines_in_front_are_seen_whole():
    segments, T_WC, (frame, line, ends) = views(fov_limit=False)
    whole, depth = whole_ends(segments, T_WC, frame, line)
    assert depth.min() >= NEAREST and np.abs(ends - whole).max() < 1e-12
    assert np.abs(ends * 460.0).max() > 320.0
    z = transform_points(rigid_inverse(T_WC)[:, None], segments)[..., 2]
    ahead = np.nonzero((z >= NEAREST).all(axis=-1))
    length = 460.0 * np.linalg.norm(np.diff(whole_ends(segments, T_WC, *ahead)[0], axis=1)[:, 0], axis=1)
    assert np.array_equal(np.stack(ahead)[:, length >= SHORTEST], np.stack([frame, line]))


def test_what_is_too_short_in_the_image_is_no_view():
    end_on, far, near = [[0.1, 0.0, 1.0], [0.2, 0.0, 2.01]], [[0.0, 0.0, 30.0], [1.0, 0.0, 30.0]], [
        [0.0, 0.0, 5.0], [1.0, 0.0, 5.0]]
    _, line, ends = observe(np.array([end_on, far, near]), np.eye(4)[None], CAMERA, Effects(), 0)
    assert line.tolist() == [2] and np.array_equal(ends[0], [[0.0, 0.0], [0.2, 0.0]])


def test_lines_behind_the_camera_and_across_its_plane():
    ahead, behind = [[-1.0, 0.0, 2.0], [1.0, 0.0, 2.0]], [[-1.0, 0.0, -2.0], [1.0, 0.0, -2.0]]
    across, close = [[0.1, 0.1, -1.0], [0.3, 0.2, 3.0]], [[0.01, 0.02, -1.0], [0.01, 0.02, 4.0]]
    segments = np.array([behind, ahead, across, close])
    assert observe(segments, np.eye(4)[None], CAMERA, Effects(fov_limit=False), 0)[1].tolist() == [1]
    _, line, ends = observe(segments, np.eye(4)[None], CAMERA, Effects(), 0)
    assert line.tolist() == [1, 2, 3]
    assert np.allclose(ends[2], [[0.01 / NEAREST, 0.02 / NEAREST], [0.0025, 0.005]])
    assert np.allclose(ends[1, 1], [0.1, 0.2 / 3.0]) and np.allclose(ends[1, 0].max(), 320 / 460)


def test_partial_views_lie_on_the_line_inside_the_full_segment():
    segments, T_WC, (frame, line, ends) = views(partial=0.4)
    assert np.abs(residuals(segments, T_WC, frame, line, ends)).max() < 1e-12
    part = shares(ends, views()[2][2])
    assert part.min() > -1e-12 and part.max() < 1.0 + 1e-12
    extent = part[:, 1] - part[:, 0]
    assert extent.min() > LEAST_PART - 1e-12
    cut = extent < 1.0 - 1e-9
    assert cut.mean() == pytest.approx(0.4, abs=0.04)
    assert extent[cut].mean() == pytest.approx((1.0 + LEAST_PART) / 2.0, abs=0.03)
    assert part[cut].mean() == pytest.approx(0.5, abs=0.03)


def test_outliers_are_wrong_segments_inside_the_image():
    segments, T_WC, (frame, line, ends) = views(outliers=0.1)
    wrong = np.any(ends != views()[2][2], axis=(1, 2))
    assert wrong.mean() == pytest.approx(0.1, abs=0.02)
    uv = ends * 460.0 + 320.0
    assert uv.min() > -1e-9 and uv.max() < 640.0 + 1e-9
    assert 64.0 <= np.linalg.norm(np.diff(uv[wrong], axis=1), axis=-1).min()
    assert np.median(460.0 * np.abs(residuals(segments, T_WC, frame, line, ends))[wrong]) > 50.0


def test_swapped_views_have_their_ends_in_the_other_order():
    ends, before = views(swapped=0.3)[2][2], views()[2][2]
    swapped = np.any(ends != before, axis=(1, 2))
    assert swapped.mean() == pytest.approx(0.3, abs=0.04)
    assert np.array_equal(ends[swapped], before[swapped][:, ::-1])


def test_noise_has_the_size_asked_for_in_pixels_of_any_camera():
    noise = (views(camera=WIDE, noise_px=1.5)[2][2] - views(camera=WIDE)[2][2]) * WIDE.focals
    assert np.abs(noise.mean(axis=0)).max() < 0.12 and np.std(noise, axis=0) == pytest.approx(1.5, rel=0.05)


def test_a_share_of_one_is_every_view_and_of_zero_none():
    before = views()[2][2]
    assert np.array_equal(views(swapped=1.0)[2][2], before[:, ::-1])
    assert np.all(np.any(views(outliers=1.0)[2][2] != before, axis=(1, 2)))
    assert np.array_equal(views(partial=0.0, outliers=0.0, swapped=0.0)[2][2], before)


def test_effects_do_not_change_each_other():
    """The noise of a view, which view is wrong and which is swapped stay when another effect comes."""
    clean = views()[2][2]
    noise = views(noise_px=1.0)[2][2] - clean
    wrong = views(outliers=0.2)[2][2]
    assert np.abs(views(outliers=0.2, noise_px=1.0)[2][2] - wrong - noise).max() < 1e-12
    part = views(partial=0.5)[2][2]
    kept = ~np.any(wrong != clean, axis=(1, 2))
    both = views(partial=0.5, outliers=0.2)[2][2]
    assert np.array_equal(both[kept], part[kept]) and np.array_equal(both[~kept], wrong[~kept])
    everything = views(partial=0.5, outliers=0.2, swapped=0.3)[2][2]
    cut = np.any(part != clean, axis=(1, 2))
    swapped = np.any(views(swapped=0.3)[2][2] != clean, axis=(1, 2))
    assert np.array_equal(everything, np.where(swapped[:, None, None], both[:, ::-1], both))
    assert np.abs(np.corrcoef([~kept, cut, swapped]) - np.eye(3)).max() < 0.08  # the same views are not hit by all


def test_noise_does_not_depend_on_the_field_of_view():
    noise = {}
    for fov_limit in (True, False):
        frame, line, ends = views(fov_limit=fov_limit, noise_px=1.0)[2]
        clean = views(fov_limit=fov_limit)[2][2]
        noise[fov_limit] = dict(zip(zip(frame.tolist(), line.tolist(), strict=True), ends - clean, strict=True))
    both = noise[True].keys() & noise[False].keys()
    assert len(both) > 1000
    assert max(np.abs(noise[True][pair] - noise[False][pair]).max() for pair in both) < 1e-12


def test_a_world_that_is_never_seen_is_refused():
    away = rigid(so3_exp([0.0, 0.0, 0.0]), [0.0, 0.0, 100.0])[None]  # above the roof, looking up
    with pytest.raises(ValueError, match='no line is in view of any camera; put the camera into the house'):
        observe(random_house(0), away, CAMERA, Effects(fov_limit=False), 0)


@pytest.mark.parametrize('make, complaint', [
    (lambda: Pinhole(width=0), 'image size must be at least 1x1 px, got 0x640'),
    (lambda: Pinhole(fy=0.0), 'focal length must be a positive number'),
    (lambda: Pinhole(fx=np.nan), 'focal length must be a positive number'),
    (lambda: Pinhole(cx=np.inf), 'principal point must be two finite numbers'),
    (lambda: Effects(noise_px=-1.0), 'noise must lie from 0 to .* px, got -1'),
    (lambda: Effects(noise_px=np.nan), 'noise must lie from 0 to'),
    (lambda: Effects(noise_px=1e308), 'noise must lie from 0 to'),
    (lambda: Effects(partial=1.1), 'partial is a share and must lie from 0 to 1, got 1.1'),
    (lambda: Effects(outliers=-0.1), 'outliers is a share'),
    (lambda: Effects(swapped=np.nan), 'swapped is a share'),
    (lambda: random_house(0, BODY - 1), 'at least 22 lines, got 21'),
    (lambda: random_house(-1), 'seed must be 0 or more, got -1'),
    (lambda: closed_loop(0, 1), 'at least 2 frames, got 1')])
def test_nonsense_is_refused(make, complaint):
    with pytest.raises(ValueError, match=complaint):
        make()
