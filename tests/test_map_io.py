"""Line maps on disk."""
import numpy as np
import pytest

from line_slam_ros.mapping.io import read_csv, write_csv, write_ply
from line_slam_ros.types import LineSegments


@pytest.fixture
def lines():
    rng = np.random.default_rng(4)
    ends, d = rng.normal(size=(7, 2, 3)) / 3, rng.normal(size=(7, 6))
    return LineSegments(np.array([2**40, 3, 1, 9, 5, 8, 0]), d, ends, np.arange(7), rng.uniform(size=7) * 1e-9)


@pytest.mark.source_error('D2 savefeatures')
@pytest.mark.parametrize('empty', [False, True])
def test_csv_round_trip_is_exact(tmp_path, lines, empty):
    lines = LineSegments.empty() if empty else lines
    write_csv(tmp_path / 'lines.csv', lines)
    back = read_csv(tmp_path / 'lines.csv')
    for name in ('ids', 'pluecker', 'ends', 'views', 'sigma'):
        one, other = getattr(lines, name), getattr(back, name)
        assert one.dtype == other.dtype and one.shape == other.shape
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize('text, complaint', [
    ('', 'not a line map'), ('a,b\n1,2\n', 'not a line map'), ('HEADER\n1,2\n', 'line 2: 15 fields'),
    ('HEADER\n1,2,3,4,5,6,seven,8,9,10,11,12,13,14,15\n', "line 2: .*'seven'")])
def test_what_is_not_a_line_map_is_named(tmp_path, lines, text, complaint):
    path = tmp_path / 'lines.csv'
    write_csv(path, LineSegments.empty())
    path.write_text(text.replace('HEADER\n', path.read_text()))
    with pytest.raises(ValueError, match=f'lines.csv.*{complaint}'):
        read_csv(path)


def test_ply_holds_vertices_and_edges(tmp_path, lines):
    write_ply(tmp_path / 'lines.ply', lines)
    header, body = (tmp_path / 'lines.ply').read_bytes().split(b'end_header\n', 1)
    assert header.startswith(b'ply\nformat binary_little_endian 1.0\n')
    assert b'element vertex 14\n' in header and b'element edge 7\n' in header
    vertices = np.frombuffer(body[: 14 * 24], '<f8').reshape(-1, 3)
    edges = np.frombuffer(body[14 * 24:], '<i4').reshape(-1, 2)
    np.testing.assert_array_equal(vertices[edges], lines.ends)
