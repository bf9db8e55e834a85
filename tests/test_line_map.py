"""The line map: trimming from many views, quality, merging, bounded memory."""
import numpy as np
import pytest
from line_scene import clipped, looking, see, views

from line_slam_ros.config import Mapping
from line_slam_ros.geometry.lie import rigid_inverse
from line_slam_ros.geometry.lines import closest_point, transform_lines, trim
from line_slam_ros.mapping.fusion import fuse, offsets, worst_sigma
from line_slam_ros.mapping.line_map import VIEWS, LineMap
from line_slam_ros.mapping.merging import KEPT_COLUMNS, Landmarks, Merging
from line_slam_ros.mapping.table import IdTable
from line_slam_ros.mapping.trimming import _foot
from line_slam_ros.types import LineSegments


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def pluecker_through(a, b):
    d = (b - a) / np.linalg.norm(b - a)
    return np.concatenate([np.cross(a, d), d])


def covariance(a, b, sigma):
    """Covariance of [n, d] of a line whose two points are each known with sigma (m) in every direction."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    h, points = 1e-6, np.concatenate([a, b])
    J = np.stack([(pluecker_through(*(points + e).reshape(2, 3)) - pluecker_through(*(points - e).reshape(2, 3)))
                  / (2 * h) for e in h * np.eye(6)], axis=1)
    return sigma**2 * J @ J.T


def feed(line_map, rng, line_id, a, b, count, **how):
    """Feed views of a segment, as line_scene.views makes them, with their ends in random order."""
    for T_WC, ends in zip(*views(rng, a, b, count, **how), strict=True):
        line_map.observe(np.array([line_id]), ends[None, :: rng.choice([-1, 1])], T_WC)


def add(line_map, rng, line_id, a, b, sigma=0.002, count=12, **how):
    a, b = np.asarray(a, float), np.asarray(b, float)
    line_map.refine(np.array([line_id]), pluecker_through(a, b)[None], covariance(a, b, sigma)[None],
                    np.array([count]))
    feed(line_map, rng, line_id, a, b, count, **how)


def keep(line_map, line_id, a, b, sigma=0.001):
    """Put a line among the kept ones, past trimming and merging."""
    row = line_map._kept.put(line_id)
    line = {'pluecker': pluecker_through(a, b), 'cov': covariance(a, b, sigma), 'ends': np.stack([a, b]), 'views': 9,
            'sigma': sigma}
    for name, value in line.items():
        line_map._kept[name][row] = value


def end_error(segments, a, b):
    """Mean error along the line of a single mapped segment, whichever way it runs."""
    assert len(segments) == 1
    ends = segments.ends[0]
    if (ends[1] - ends[0]) @ (np.asarray(b) - a) < 0:
        ends = ends[::-1]
    return np.linalg.norm(ends - [a, b], axis=1).mean()


A, B = np.array([-1.0, 4.0, 0.2]), np.array([1.0, 4.5, 0.6])


@pytest.mark.row(32)
@pytest.mark.trap('swapped end points')
@pytest.mark.source_error('D1 section 3')
@pytest.mark.parametrize('px, tolerance', [(0.0, 1e-9), (1.0, 0.006), (4.5, 0.03)])
def test_full_views_give_the_ends_however_they_are_ordered(rng, px, tolerance):
    line_map = LineMap(Mapping())
    add(line_map, rng, 3, A, B, count=30, px=px)
    assert end_error(line_map.segments(), A, B) <= tolerance


@pytest.mark.row(32)
@pytest.mark.trap('partial views')
@pytest.mark.source_error('D2 updatelineplk')
@pytest.mark.parametrize('px, tolerance', [(0.0, 0.01), (1.0, 0.02), (4.5, 0.06)])
def test_clipped_views_give_the_ends_that_few_of_them_reach(rng, px, tolerance):
    line_map = LineMap(Mapping())
    add(line_map, rng, 3, A, B, count=48, px=px, part=clipped(rng))
    assert end_error(line_map.segments(), A, B) <= tolerance


@pytest.mark.row(31)
def test_the_compiled_foot_is_that_of_the_geometry_module(rng):
    L_W = pluecker_through(A, B)
    for _ in range(20):
        T_WC = looking(rng.uniform([-2, -1, -1], [2, 1, 1]), (A + B) / 2)
        ends, out = rng.uniform(-0.4, 0.4, (2, 2)), np.empty(3)
        p_C = trim(transform_lines(rigid_inverse(T_WC), L_W[None])[0], ends)
        for k in range(2):
            assert _foot(L_W[:3], L_W[3:], T_WC[:3], ends[k], 100.0, out)
            assert out[0] == pytest.approx((T_WC[:3, :3] @ p_C[k] + T_WC[:3, 3]) @ L_W[3:], abs=1e-9)


@pytest.mark.row(32)
@pytest.mark.trap('one bad frame')
@pytest.mark.source_error('D2 updatelineplk break')
def test_one_bad_frame_moves_nothing(rng):
    line_map = LineMap(Mapping())
    add(line_map, rng, 3, A, B, count=10, part=lambda k: (-0.8, 1.9) if k == 4 else (0.0, 1.0))
    assert end_error(line_map.segments(), A, B) < 1e-9


@pytest.mark.row(33)
@pytest.mark.trap('points behind the camera')
@pytest.mark.trap('near end-on views')
def test_feet_behind_the_camera_and_along_the_line_are_not_used(rng):
    line_map = LineMap(Mapping())
    add(line_map, rng, 3, A, B, count=8)
    away = looking(np.array([0.0, 0.0, 0.0]), np.array([0.0, -4.0, 0.0]))
    direction = (B - A) / np.linalg.norm(B - A)
    end_on = looking(A - 3 * direction + [0.0, 0.0, 0.05], B)
    for T_WC in [away] * 10 + [end_on] * 10:
        line_map.observe(np.array([3]), np.array([[[-0.3, 0.01], [0.3, 0.02]]]), T_WC)
    assert end_error(line_map.segments(), A, B) < 1e-9


@pytest.mark.row(32)
@pytest.mark.trap('line longer than 8 m')
@pytest.mark.source_error('D2 updatelineplk 8 m')
def test_a_line_of_twelve_metres_is_kept_whole(rng):
    a, b = np.array([-6.0, 7.0, 0.0]), np.array([6.0, 7.0, 0.0])
    line_map = LineMap(Mapping())
    add(line_map, rng, 0, a, b, count=20, px=0.5, distance=7.0)
    line_map.retire(np.array([0]))
    assert end_error(line_map.segments(), a, b) < 0.05


def test_ends_follow_a_refined_estimate(rng):
    line_map = LineMap(Mapping())
    further = 1.3
    add(line_map, rng, 0, A, B, count=12)
    poses = line_map._active['poses'][0, :12].copy()
    line_map.refine(np.array([0]), -pluecker_through(further * A, further * B)[None],
                    covariance(further * A, further * B, 0.001)[None], np.array([12]))
    ends = line_map.segments().ends[0]
    centre = poses[:, :, 3].mean(axis=0)
    expected = centre + (np.stack([A, B]) - centre) * np.linalg.norm(further * A - centre) / np.linalg.norm(A - centre)
    assert np.linalg.norm(np.diff(ends, axis=0)) > 1.15 * np.linalg.norm(B - A)  # the same rays, further out
    np.testing.assert_allclose(ends, expected, atol=0.25)
    assert (ends[1] - ends[0]) @ (B - A) > 0  # a direction turned round by the estimator does not swap the ends


@pytest.mark.parametrize('change', [{'sigma': 0.2}, {'sigma': np.nan}, {'count': 3}, {'part': lambda k: (0.5, 0.51)}])
def test_doubtful_lines_are_neither_shown_nor_kept(rng, change):
    line_map = LineMap(Mapping())
    add(line_map, rng, 0, A, B, **change)
    assert len(line_map.active()) == len(line_map.segments()) == 0
    line_map.retire(np.array([0]))
    assert len(line_map.segments()) == 0


def test_a_line_without_parallax_is_not_shown(rng):
    line_map = LineMap(Mapping())
    line_map.refine(np.array([0]), pluecker_through(A, B)[None], covariance(A, B, 1e-3)[None], np.array([9]))
    T_WC = looking(np.zeros(3), (A + B) / 2)
    for _ in range(9):
        line_map.observe(np.array([0]), see(T_WC, A, B)[None], T_WC)
    assert len(line_map.segments()) == 0


def test_retired_lines_stay_and_their_views_are_forgotten(rng):
    line_map = LineMap(Mapping())
    for k in range(300):
        offset_k = np.array([0.0, 0.0, 0.2 * k])
        add(line_map, rng, k, A + offset_k, B + offset_k, count=4)
        line_map.retire(np.array([k, 10_000]))
    assert len(line_map.segments()) == 300 and len(line_map.active()) == 0
    assert len(line_map._active._ids) == 64  # rows of the active table, allocated once


def test_views_of_a_long_track_are_bounded_and_spread_over_its_life(rng):
    line_map = LineMap(Mapping())
    add(line_map, rng, 0, A, B, count=5)
    for k in range(1000):
        T_WC = np.eye(4)
        T_WC[0, 3] = k
        line_map.observe(np.array([0]), np.zeros((1, 2, 2)), T_WC)
    count = line_map._active['count'][0]
    x = line_map._active['poses'][0, :count, 0, 3]
    assert VIEWS // 2 <= count <= VIEWS
    assert np.ptp(np.diff(x)[1:]) == 0 and x[-1] >= 1000 - 2 * (x[-1] - x[-2])


def test_duplicates_become_one_better_line(rng):
    line_map = LineMap(Mapping())
    shift = np.array([0.0, 0.01, 0.01])
    add(line_map, rng, 8, A + shift, A + 0.7 * (B - A) + shift, sigma=0.01)
    add(line_map, rng, 5, A + 0.6 * (B - A), B, sigma=0.003)
    before = {i: s for i, s in zip(line_map.active().ids, line_map.active().sigma, strict=True)}
    line_map.retire(np.array([8]))
    line_map.retire(np.array([5]))
    merged = line_map.segments()
    assert list(merged.ids) == [5] and merged.views[0] == 24
    assert merged.sigma[0] < before[8]
    assert end_error(merged, A, B) < 0.02


def test_a_crooked_piece_beside_a_line_is_merged_without_bending_it(rng):
    line_map, middle, along = LineMap(Mapping()), (A + B) / 2, (B - A) / np.linalg.norm(B - A)
    add(line_map, rng, 1, A, B, sigma=0.002, count=30)
    crooked = 0.1 * (along + [0, 0, np.tan(np.radians(4))])  # 4 degrees off in 20 cm, surer of it than it should be
    add(line_map, rng, 2, middle - crooked, middle + crooked, sigma=0.001)
    line_map.retire(np.array([1, 2]))
    assert list(line_map.segments().ids) == [1] and end_error(line_map.segments(), A, B) < 0.02


@pytest.mark.parametrize('name, a, b', [
    ('parallel, 10 cm apart', A + [0, 0, 0.1], B + [0, 0, 0.1]),
    ('collinear, 50 cm apart', B + 0.5 * (B - A) / np.linalg.norm(B - A), B + (B - A)),
    ('crossing', (A + B) / 2 + [0, 0, -1], (A + B) / 2 + [0, 0, 1])])
@pytest.mark.parametrize('sigma', [0.001, 0.04])
def test_distinct_lines_are_not_merged(rng, name, a, b, sigma):
    line_map = LineMap(Mapping(max_sigma_m=0.2))
    add(line_map, rng, 1, A, B, sigma=sigma)
    add(line_map, rng, 2, a, b, sigma=sigma)
    line_map.retire(np.array([1, 2]))
    assert list(line_map.segments().ids) == [1, 2], name


def test_certain_lines_that_meet_at_four_degrees_are_not_merged(rng):
    line_map, length = LineMap(Mapping()), np.linalg.norm(B - A)
    add(line_map, rng, 1, A, B, sigma=0.001)
    add(line_map, rng, 2, B, B + (B - A) + [0, 0, length * np.tan(np.radians(4))], sigma=0.001)
    line_map.retire(np.array([1, 2]))
    assert list(line_map.segments().ids) == [1, 2]


def test_an_active_duplicate_of_a_kept_line_is_shown_merged(rng):
    line_map = LineMap(Mapping())
    add(line_map, rng, 1, A, B)
    line_map.retire(np.array([1]))
    add(line_map, rng, 2, A, B)
    assert list(line_map.segments().ids) == [1] and list(line_map.active().ids) == [2]


def landmarks(*lines):
    """Of (id, a, b, sigma)."""
    return Landmarks(np.array([i for i, *_ in lines]), np.stack([pluecker_through(a, b) for _, a, b, _ in lines]),
                     np.stack([covariance(*line) for _, *line in lines]), np.array([[a, b] for _, a, b, _ in lines]),
                     np.full(len(lines), 9), np.array([sigma for *_, sigma in lines]))


def test_one_landmark_after_the_other_gives_the_map_of_all_at_once(rng):
    """Among duplicates, pieces and namesakes, old and new; and the kept ones are untouched until commit."""
    corners = rng.uniform([-2, 3, -1], [2, 5, 1], (12, 2, 3))
    new = []
    for k in range(40):
        a, b = corners[k % 12] + rng.normal(scale=0.004, size=(2, 3))
        share = rng.uniform(0.0, 0.5, 2)
        new.append((501 + 10 * k, a + share[0] * (b - a), b - share[1] * (b - a), 0.005))
    away = np.array([9.0, 0.0, 0.0])  # namesakes of kept lines elsewhere, a more certain and a less certain one
    new += [(500, corners[0, 0] + away, corners[0, 1] + away, 0.003), (1000, A - away, B - away, 0.009)]
    both = LineMap(Mapping()), LineMap(Mapping())
    for line_map in both:
        for k, (a, b) in enumerate(corners[:6]):
            keep(line_map, 500 * k, a, b, 0.004)
    before = {name: both[0]._kept[name].copy() for name in KEPT_COLUMNS}
    merging = Merging(both[0]._kept, landmarks(*new), Mapping())
    shown = merging.segments()
    for name, column in before.items():
        np.testing.assert_array_equal(both[0]._kept[name], column)
    merging.commit()
    for line in new:
        Merging(both[1]._kept, landmarks(line), Mapping()).commit()
    tables = [line_map._kept for line_map in both]
    assert 12 <= len(shown) < 30 and 500 in shown.ids and 1000 in shown.ids
    for name in ('pluecker', 'ends', 'views', 'sigma'):
        at_once, one_by_one = (table[name][np.argsort(table.ids)] for table in tables)
        np.testing.assert_array_equal(at_once, getattr(shown, name))
        np.testing.assert_allclose(one_by_one, getattr(shown, name), atol=1e-9)


def test_fusion_reaches_lines_far_from_the_window(rng):
    """A line that grows by fusion meets kept lines where no active line is; a thousand others are in nobody's way."""
    line_map, along = LineMap(Mapping()), B - A
    pieces = [(0.9 * k, 0.9 * k + 1.0) for k in range(6)]  # each overlaps the next
    for k in range(1000):
        a = rng.uniform([-50, 10, -50], [50, 60, 50])
        keep(line_map, 1000 + k, a, a + [1, 0, 0])
    for k, (begin, end) in enumerate(pieces[1:]):
        keep(line_map, 100 + k, A + begin * along, A + end * along)
    add(line_map, rng, 5, *(A + np.outer(pieces[0], along)))
    merged = line_map.segments()
    assert list(merged.ids[:2]) == [5, 1000] and len(merged) == 1001
    whole = LineSegments(merged.ids[:1], merged.pluecker[:1], merged.ends[:1], merged.views[:1], merged.sigma[:1])
    assert end_error(whole, A, A + pieces[-1][1] * along) < 1e-6
    line_map.retire(np.array([5]))
    for name in ('ids', 'pluecker', 'ends', 'views', 'sigma'):
        np.testing.assert_array_equal(getattr(line_map.segments(), name), getattr(merged, name))


def test_what_changes_nothing_leaves_the_version(rng):
    line_map = LineMap(Mapping())
    add(line_map, rng, 1, A, B)
    version = line_map.version
    line_map.drop(np.array([7]))
    line_map.retire(np.empty(0, np.int64))
    line_map.segments()
    assert line_map.version == version


def test_an_id_that_comes_back_is_listed_once(rng):
    line_map = LineMap(Mapping())
    add(line_map, rng, 1, A, B)
    line_map.retire(np.array([1]))
    add(line_map, rng, 1, A + [0, 0, 1], B + [0, 0, 1], sigma=0.01)
    assert list(line_map.segments().ids) == [1]
    assert end_error(line_map.segments(), A, B) < 1e-9  # another line, and less certain


def test_the_same_calls_give_the_same_map():
    def build():
        rng, line_map = np.random.default_rng(2), LineMap(Mapping())
        for k in range(60):
            a = rng.uniform([-2, 3, -1], [2, 5, 1])
            add(line_map, rng, k, a, a + rng.normal(size=3) + [1, 0, 0], px=1.0, count=6)
            if k % 3 == 2:
                line_map.retire(np.array([k - 2, k - 1]))
        return line_map.segments()
    first, second = build(), build()
    assert len(first) > 30 and np.all(np.diff(first.ids) > 0)
    for name in ('ids', 'pluecker', 'ends', 'views', 'sigma'):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_version_changes_with_the_map_and_clear_empties_it(rng):
    line_map = LineMap(Mapping())
    seen = {line_map.version}
    add(line_map, rng, 1, A, B)
    seen.add(line_map.version)
    line_map.retire(np.array([1]))
    seen.add(line_map.version)
    assert len(line_map.segments()) == 1
    line_map.clear()
    seen.add(line_map.version)
    assert len(seen) == 4 and len(line_map.segments()) == 0


def offset_from(pluecker, cov, point):
    """From a point to its foot on a line: mean (3,) and covariance (3, 3)."""
    mean, across = np.empty(3), np.empty((3, 3))
    offsets(pluecker, cov, point[None], np.eye(3), mean, across)
    return mean, across


def test_across_covariance_agrees_with_samples(rng):
    pluecker, cov, point = pluecker_through(A, B), covariance(A, B, 0.01), A + 1.5 * (B - A)
    samples = np.stack([pluecker_through(*(np.stack([A, B]) + 0.01 * rng.normal(size=(2, 3)))) for _ in range(20000)])
    moved = closest_point(samples, point) - point
    mean, across = offset_from(pluecker, cov, point)
    np.testing.assert_allclose(mean, closest_point(pluecker, point) - point, atol=1e-12)
    np.testing.assert_allclose(np.cov(moved.T), across, atol=0.05 * 2.5e-4)
    largest = np.sqrt(np.linalg.eigvalsh(across)[-1])
    assert worst_sigma(pluecker[None], cov[None], np.stack([A, point])[None])[0] == pytest.approx(largest)


def test_fusion_is_the_maximum_likelihood_line(rng):
    """Against many noisy estimates: the error of the fusion is what its covariance says, in all four parameters."""
    a2, b2 = A + 0.4 * (B - A), A + 1.8 * (B - A)
    normalised = []
    for _ in range(400):
        noisy = np.stack([A, B]) + 0.01 * rng.normal(size=(2, 3)), np.stack([a2, b2]) + 0.004 * rng.normal(size=(2, 3))
        pluecker, cov, ends = np.empty(6), np.empty((6, 6)), np.empty((2, 3))
        sigma = fuse(pluecker_through(*noisy[0]), covariance(*noisy[0], 0.01), noisy[0],
                     pluecker_through(*noisy[1]), covariance(*noisy[1], 0.004), noisy[1], pluecker, cov, ends)
        assert abs(pluecker[:3] @ pluecker[3:]) < 1e-12
        assert sigma == pytest.approx(worst_sigma(pluecker[None], cov[None], ends[None])[0])
        for point in (A, b2):
            error, across = offset_from(pluecker, cov, point)
            normalised.append(error @ np.linalg.pinv(across, rcond=1e-6) @ error)
    assert np.mean(normalised) == pytest.approx(2.0, abs=0.25)


def test_table_keeps_records_when_it_grows_and_shrinks():
    table = IdTable(value=((2,), np.float64))
    for k in range(200):
        row = table.put(k)
        table['value'][row] = k
    for k in range(0, 200, 2):
        table.remove(k)
    assert sorted(table.ids) == list(range(1, 200, 2)) and 4 not in table and 5 in table
    rows = table.rows([1, 99, 4])
    assert rows[2] == -1 and table['value'][rows[:2], 0].tolist() == [1, 99]
    with pytest.raises(KeyError):
        table.remove(4)
