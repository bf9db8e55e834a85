"""The files of the line experiment: what is written reads back, what cannot be used names its file and line."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from line_slam_ros.experiment.files import (
    Experiment,
    LineViews,
    add_noise,
    read_experiment,
    read_landmarks,
    read_observations,
    read_poses,
    write_landmarks,
    write_observations,
    write_poses,
)
from line_slam_ros.geometry.lie import matrix_from_quaternion, rigid, so3_exp

SHARED = Path(__file__).parents[1].parent / 'shared' / 'data' / 'house_sim'
FRAMES, LINES = 6, 4
POSE = '{} 1 2 3 0 0 0 1\n'
FOCAL = 460.0


@pytest.fixture
def house_sim() -> Path:
    if not SHARED.is_dir():
        pytest.skip(f'the house experiment of the line code base is not here: {SHARED}')
    return SHARED


def random_views(seed: int = 0, count: int = 10) -> LineViews:
    rng = np.random.default_rng(seed)
    pairs = rng.permutation(FRAMES * LINES)[:count]  # in no order: the file's must be kept
    return LineViews(pairs // LINES, pairs % LINES, rng.normal(size=(count, 2, 2)))


def same(a: LineViews, b: LineViews) -> bool:
    return all(x.tobytes() == y.tobytes() for x, y in ((a.frame, b.frame), (a.line, b.line), (a.ends, b.ends)))


@pytest.fixture
def folder(tmp_path) -> Path:
    rng = np.random.default_rng(5)
    write_poses(tmp_path / 'cam_pose_tum.txt', 1.7e9 + np.arange(FRAMES) / 30,
                rigid(so3_exp(rng.normal(size=(FRAMES, 3))), rng.normal(size=(FRAMES, 3))))
    write_landmarks(tmp_path / 'house.txt', rng.normal(size=(LINES, 2, 3)))
    write_observations(tmp_path / 'observations.txt', random_views())
    return tmp_path


@pytest.mark.row(37)
def test_landmarks_and_observations_read_back_exactly(tmp_path):
    segments = np.random.default_rng(1).normal(size=(LINES, 2, 3)) * 10.0 ** np.arange(-9, 3, 3)[:, None, None]
    write_landmarks(tmp_path / 'house.txt', segments)
    assert read_landmarks(tmp_path / 'house.txt').tobytes() == segments.tobytes()
    write_observations(tmp_path / 'observations.txt', random_views())
    again = read_observations(tmp_path / 'observations.txt', FRAMES, LINES)
    assert same(again, random_views()) and again.frame.dtype == again.line.dtype == np.int64


@pytest.mark.row(37)
def test_poses_read_back(tmp_path):
    rng = np.random.default_rng(2)
    stamps = 1.7e9 + np.arange(50) / 30
    T_WC = rigid(so3_exp(rng.uniform(-3, 3, (50, 3))), rng.normal(size=(50, 3)))
    write_poses(tmp_path / 'poses.txt', stamps, T_WC)
    read_stamps, read_T_WC = read_poses(tmp_path / 'poses.txt')
    assert read_stamps.tobytes() == stamps.tobytes()
    assert read_T_WC[:, :3, 3].tobytes() == T_WC[:, :3, 3].tobytes()
    assert np.abs(read_T_WC - T_WC).max() < 2e-15  # rotations pass through a quaternion


@pytest.mark.row(37)
@pytest.mark.parametrize('scale', [1e-4, 0.99999, 1.0, 3.0, 1e4])
def test_quaternions_of_any_length_are_normalised(tmp_path, scale):
    q_xyzw = np.random.default_rng(3).normal(size=4)
    path = tmp_path / 'poses.txt'
    path.write_text('0 1 2 3 ' + ' '.join(repr(float(v)) for v in scale * q_xyzw) + '\n')
    R = read_poses(path)[1][0, :3, :3]
    assert np.abs(R - matrix_from_quaternion(q_xyzw)).max() < 4e-15
    assert np.abs(R.T @ R - np.eye(3)).max() < 4e-15


@pytest.mark.row(37)
def test_comments_blank_lines_and_windows_line_ends_do_not_count(tmp_path):
    path = tmp_path / 'house.txt'
    path.write_bytes(b'\xef\xbb\xbf# two lines\r\n\r\n 0 0 0  1 0 0 # floor\r\n\t\r\n0\t0 0 0 0 2.5e0\r\n')
    assert read_landmarks(path).tolist() == [[[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 2.5]]]


def poses(path):
    return read_poses(path)


def landmarks(path):
    return read_landmarks(path)


def observations(path):
    return read_observations(path, FRAMES, LINES)


BAD = [  # reader, text, line, complaint
    *[(reader, text, 1, 'without a row') for reader in (poses, landmarks, observations) for text in ('', '# nothing')],
    (observations, '#\n\n', 3, 'without a row'),
    (poses, POSE.format(0) + '\n# next\n1 1 2 3 0 0 1\n', 4, '"1 1 2 3 0 0 1", expected 8 numbers t x y z qx qy qz qw'),
    (landmarks, '0 0 0 1 0 0\n0 0 0 1 0\n', 2, 'expected 6 numbers x1 y1 z1 x2 y2 z2'),
    (landmarks, '0 0 0 1 0 0 0\n', 1, 'expected 6 numbers'),
    (landmarks, '0,0,0,1,0,0\n', 1, '"0,0,0,1,0,0", expected 6 numbers'),
    (observations, '#\n0 0 0 0 1 1\n0 1 0 0 1 1 1\n', 3, 'expected 6 numbers frame line u1 v1 u2 v2'),
    (observations, '0 0 0 0 1 1\n0 1 0 x 1 1\n', 2, '"0 1 0 x 1 1", expected 6 numbers'),
    (poses, b'0 1 2 3 0 0 0 \xff\n', 1, 'expected 8 numbers'),
    (landmarks, b'\x7fELF\x00\x1b[2J\r\n', 1, r'"\x7fELF\x00\x1b[2J", expected 6 numbers'),
    (observations, b'\x00' * 500, 1, '"' + 20 * r'\x00' + '", expected'),  # 80 characters
    (poses, POSE.format(0) + POSE.format('nan'), 2, 'NaN or infinity'),
    (landmarks, '\n0 0 0 1 inf 0\n', 2, 'NaN or infinity, expected finite numbers x1'),
    (observations, '0 0 0 0 1 NaN\n', 1, 'NaN or infinity'),
    (poses, POSE.format(0) + '1 1 2 3 0 0 0 0\n', 2, 'quaternion 0.0 0.0 0.0 0.0 is no rotation'),
    (poses, '1 1 2 3 1e-9 0 0 0\n', 1, 'expected qx qy qz qw of length 1'),
    (poses, '1 1 2 3 1e200 0 0 0\n', 1, 'expected qx qy qz qw of length 1'),
    (poses, POSE.format(0) + POSE.format(0.5) + POSE.format(0.5), 3, 'time 0.5 is not after'),
    (poses, POSE.format(1) + '#\n' + POSE.format(0.5), 3, 'time 0.5 is not after'),
    (landmarks, '0 0 0 1 0 0\n1 2 3 1 2 3\n', 2, 'both ends are 1.0 2.0 3.0'),
    (observations, '0 0 0 0 1 1\n6 0 0 0 1 1\n', 2, 'unknown frame 6, expected a whole number from 0 to 5'),
    (observations, '-1 0 0 0 1 1\n', 1, 'unknown frame -1'),
    (observations, '0.5 0 0 0 1 1\n', 1, 'unknown frame 0.5'),
    (observations, '5 4 0 0 1 1\n', 1, 'unknown line 4, expected a whole number from 0 to 3'),
    (observations, '5 1.5 0 0 1 1\n', 1, 'unknown line 1.5'),
    (observations, '0 1 0 0 1 1\n# more\n1 1 0 0 1 1\n0 1 0 0 2 2\n', 4, 'a second view of line 1 in frame 0'),
    (observations, '0 1 0 0 1 1\n1 1 .5 .25 .5 .25\n', 2, 'both ends are 0.5 0.25'),
]


@pytest.mark.row(37)
@pytest.mark.parametrize('reader, text, line, complaint', BAD)
def test_bad_files_are_refused_with_file_and_line(tmp_path, reader, text, line, complaint):
    path = tmp_path / 'bad.txt'
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError) as refused:
        reader(path)
    message = str(refused.value)
    assert message.startswith(f'{path}:{line}: ') and complaint in message and ', expected ' in message


@pytest.mark.row(37)
@pytest.mark.parametrize('reader', [poses, landmarks, observations])
def test_missing_files_are_named(tmp_path, reader):
    with pytest.raises(ValueError, match=r'none\.txt: No such file or directory, expected a text file with rows'):
        reader(tmp_path / 'none.txt')
    with pytest.raises(ValueError, match='Is a directory, expected a text file'):
        reader(tmp_path)


@pytest.mark.row(37)
def test_an_experiment_is_its_three_files(folder):
    experiment = read_experiment(folder)
    assert isinstance(experiment, Experiment)
    assert experiment.T_WC.shape == (FRAMES, 4, 4) and experiment.stamps.shape == (FRAMES,)
    assert experiment.segments.shape == (LINES, 2, 3) and same(experiment.views, random_views())
    write_observations(folder / 'others.txt', random_views(1))
    assert same(read_experiment(folder, 'others.txt').views, random_views(1))
    assert same(read_experiment(folder, folder / 'others.txt').views, random_views(1))


@pytest.mark.row(37)
def test_ids_are_checked_against_the_other_files_of_the_experiment(folder):
    path = folder / 'observations.txt'
    path.write_text(path.read_text() + f'0 {LINES} 0 0 1 1\n')
    with pytest.raises(ValueError, match=f'observations.txt:11: unknown line {LINES}'):
        read_experiment(folder)
    with pytest.raises(ValueError, match='none: no such directory, expected one with cam_pose_tum.txt, house.txt'):
        read_experiment(folder / 'none')


@pytest.mark.row(37)
def test_the_files_of_the_line_code_base_are_read(house_sim):
    experiment = read_experiment(house_sim)
    assert len(experiment.T_WC) == 600 and len(experiment.segments) == 80 and len(experiment.views.line) == 29346
    R = experiment.T_WC[:, :3, :3]  # the file has five decimals
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-14
    for path in sorted((house_sim / 'fov').iterdir()):
        assert len(read_experiment(house_sim, path).views.line) == 8813


@pytest.mark.row(38)
def test_the_same_seed_gives_the_same_noise():
    views = random_views()
    assert same(add_noise(views, 0.1, 7), add_noise(views, 0.1, 7))
    assert not same(add_noise(views, 0.1, 7), add_noise(views, 0.1, 8))
    assert same(add_noise(views, 0.0, 7), views)
    twice = add_noise(views, 0.2, 7).ends - views.ends
    assert np.abs(twice - 2 * (add_noise(views, 0.1, 7).ends - views.ends)).max() < 1e-15  # sigma only scales


@pytest.mark.row(38)
def test_noise_has_the_standard_deviation_asked_for():
    still = LineViews(np.zeros(50_000, np.int64), np.zeros(50_000, np.int64), np.zeros((50_000, 2, 2)))
    noise = add_noise(still, 0.01, 3).ends.reshape(-1, 4)
    covariance = noise.T @ noise / len(noise)
    assert np.abs(covariance / 1e-4 - np.eye(4)).max() < 0.03  # 3 sigma of the largest is .019


@pytest.mark.row(38)
@pytest.mark.parametrize('sigma', [-0.1, np.nan, np.inf, 1e308, 1001.0])
def test_noise_that_is_no_standard_deviation_is_refused(sigma):
    with pytest.raises(ValueError, match='noise must be a standard deviation from 0 to 1000'):
        add_noise(random_views(), sigma, 0)


@pytest.mark.row(38)
def test_the_most_noise_is_added_and_a_seed_below_zero_refused():
    assert np.isfinite(add_noise(random_views(), 1000.0, 0).ends).all()
    with pytest.raises(ValueError, match='seed must be 0 or more, got -1'):
        add_noise(random_views(), 0.0, -1)


@pytest.mark.row(38)
@pytest.mark.parametrize('pixels', ['1.5', '3', '4.5'])
@pytest.mark.parametrize('seed', range(3))
def test_noise_is_that_of_the_recorded_inputs(house_sim, pixels, seed):
    """Drawn for all views of the file, of which the recorded ones are a part, printed with twelve digits."""
    recorded = read_observations(house_sim / 'fov' / f'obs_noise{pixels}_seed{seed}.txt', 600, 80)
    noisy = add_noise(read_observations(house_sim / 'observations.txt', 600, 80), float(pixels) / FOCAL, seed)
    kept = np.isin(noisy.frame * 80 + noisy.line, recorded.frame * 80 + recorded.line)
    assert np.array_equal(noisy.frame[kept], recorded.frame) and np.array_equal(noisy.line[kept], recorded.line)
    assert np.abs(noisy.ends[kept] / recorded.ends - 1.0).max() < 5e-12
