"""The benchmark over recordings: its list, its rows, its Markdown, and a short one end to end."""
from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest
from bag_samples import OFFICE, line_slam

from line_slam_ros.benchmark.report import recordings_section
from line_slam_ros.benchmark.rows import Row, finished_row, merged, read_rows, write_rows
from line_slam_ros.benchmark.sections import number, put_section, with_section
from line_slam_ros.benchmark.suite import Variant, chosen, read_suite
from line_slam_ros.cli.benchmark_runs import prepared
from line_slam_ros.cli.replaying import Clip

ROOT = Path(__file__).parents[1]
EUROC = ROOT.parent / 'shared' / 'data' / 'euroc_v101_asl'
LIST = f"""
recordings:
  office:
    bag: {OFFICE / 'bag'}
    truth_topic: /ground_truth/pose
    lines: [{OFFICE / 'gt_lines.csv'}]
    start: 3
    duration: 4
    variants: [points and lines, lines only]
    degrade:
      smaller: {{resize: 0.5}}
  without a file:
    bag: nowhere
"""


@pytest.fixture
def listed(tmp_path):
    """Writes a YAML file."""
    def write(text):
        path = tmp_path / 'list.yaml'
        path.write_text(text)
        return path
    return write


def test_the_list_of_the_repository_can_be_read():
    recordings = read_suite(ROOT / 'benchmarks' / 'recordings.yaml')
    shipped = recordings[0]
    assert shipped.missing() == [] or not OFFICE.is_dir()
    assert [v.name for v in shipped.variants] == ['points and lines', 'points only', 'lines only', '2-parameter lines']
    worse = [r for r in recordings if r.copy_of == 'office']
    assert len(worse) == 9 and all(len(r.variants) == 1 and r.degradation.changes() for r in worse)


def test_variants_and_settings_of_a_list(listed):
    recordings = read_suite(listed("""
variants:
  few: {points.max_count: 25}
  host: {estimator.line_representation: host}
recordings:
  a: {bag: x, settings: {use_lines: false}, variants: [host], calibration: y/c.yaml}
  b: {asl: folder, camera: cam1}
"""))
    a, b = recordings
    assert a.variants == (Variant('host', {'estimator.line_representation': 'host'}),)
    assert a.settings == {'use_lines': False} and a.calibration == listed('').parent / 'y' / 'c.yaml'
    assert [v.name for v in b.variants] == ['few', 'host'] and b.camera == 'cam1' and b.bag is None
    assert len(a.missing()) == 2


@pytest.mark.parametrize('text, complaint', [
    ('', 'list.yaml: expected "name: value" lines'),
    ('recordings: [1', 'list.yaml: not readable as YAML'),
    ('recordings: {}', 'at least one variant and one entry under recordings'),
    ('recordings: {a: {bag: x}}\nvariant: {}', "list.yaml: unknown key 'variant'; use variants, recordings"),
    ('recordings: {a: {bag: x, truht: y}}', "recordings.a: unknown key 'truht'"),
    ('recordings: {a: {truth: y}}', 'recordings.a: give either bag or asl'),
    ('recordings: {a: {bag: x, asl: y}}', 'recordings.a: give either bag or asl'),
    ('recordings: {a: {bag: x, truth: y, truth_topic: /z}}', 'recordings.a: give either truth or truth_topic'),
    ('recordings: {a: {bag: 3}}', 'recordings.a.bag must be text, got 3'),
    ('recordings: {a: {bag: x, lines: y}}', "recordings.a.lines must be a list of files, got 'y'"),
    ('recordings: {a: {bag: x, start: soon}}', "recordings.a.start must be seconds, got 'soon'"),
    ('recordings: {a: {bag: x, duration: -1}}', 'recordings.a.duration must be seconds, got -1'),
    ('recordings: {a: {bag: x, variants: [none]}}', 'recordings.a.variants must list some of points and lines, '),
    ('recordings: {a: {bag: x, settings: {use_line: 1}}}', "recordings.a.settings: unknown parameter 'use_line'"),
    ('recordings: {a: {bag: x, degrade: {d: {blur: 1}}}}', "recordings.a.degrade.d: unknown degradation 'blur'"),
    ('recordings: {a: {bag: x, degrade: {d: 1}}}', 'recordings.a.degrade.d: expected "name: value" lines, got 1'),
    ('recordings: {a: {bag: x}}\nvariants: {v: {estimator.window: 0}}', 'variants.v: estimator.window must lie in')])
def test_mistakes_in_the_list_are_named_with_file_and_key(listed, text, complaint):
    path = listed(text)
    with pytest.raises(ValueError) as caught:
        read_suite(path)
    assert complaint in str(caught.value) and str(path) in str(caught.value)


def test_recordings_are_chosen_by_pattern_and_variants_by_name(listed):
    recordings = read_suite(listed(LIST))
    assert [r.name for r in chosen(recordings, ['office*'], [])] == ['office', 'office, smaller']
    only = chosen(recordings, ['office'], ['lines only'])
    assert [v.name for r in only for v in r.variants] == ['lines only']
    with pytest.raises(ValueError, match=r"no recording is called 'attic'; there are office, "):
        chosen(recordings, ['attic'], [])
    with pytest.raises(ValueError, match=r"no variant is called 'x'; there are points and lines, "):
        chosen(recordings, [], ['x'])


@pytest.fixture(scope='module')
def measured(tmp_path_factory):
    """Output directory and exit code of a benchmark over four seconds."""
    if not (OFFICE / 'bag').is_dir():
        pytest.skip(f'the shipped bag {OFFICE / "bag"} is missing')
    directory = tmp_path_factory.mktemp('benchmark')
    (directory / 'list.yaml').write_text(LIST)
    (directory / 'page.md').write_text('# By hand\n\nabove\n')
    code, out, err = line_slam('benchmark', 'recordings', directory / 'list.yaml', '--output', directory / 'out',
                               '--only', 'office*', 'without*', '--markdown', directory / 'page.md')
    assert code == 0, err
    return directory, out, err


def rows_of(directory):
    rows = json.loads((directory / 'out' / 'results.json').read_text())['rows']
    return {(row['recording'], row['variant']): row for row in rows}


def test_a_benchmark_gives_plausible_figures(measured):
    directory, *_ = measured
    row = rows_of(directory)['office', 'points and lines']
    trajectory, run, lines = row['trajectory'], row['run'], row['lines']
    assert row['status'] == 'ok' and run['frames'] == 81 and run['estimates'] > 40 and run['resets'] == 0
    assert 0.0 < trajectory['ate_rmse_m'] < 0.05 and trajectory['ate_rmse_m'] <= trajectory['ate_max_m']
    assert 0.5 < trajectory['length_m'] < 4.0 and abs(trajectory['scale'] - 1.0) < 0.1
    assert 0.0 < trajectory['rpe_1s_translation_rmse_m'] < 0.1
    assert 0.0 < trajectory['rpe_10pct_translation_rmse_m'] < 0.1
    assert lines['count'] >= 3 and lines['precision'][3] > 0.5 and lines['recall_m'][3] > 1.0
    assert 0.0 < run['first_estimate_after_s'] <= 3.0 and run['stages_ms']['total']['p50'] > 0.0


def test_the_run_began_where_the_list_says(measured):
    first = float((measured[0] / 'out' / 'office' / 'points_and_lines' / 'trajectory.tum').read_text().split()[0])
    truth = [float(line.split()[0]) for line in (OFFICE / 'groundtruth.tum').read_text().splitlines()
             if not line.startswith('#')]
    assert 3.0 < first - truth[0] < 7.1


def test_a_degraded_copy_ran_at_its_size(measured):
    row = rows_of(measured[0])['office, smaller', 'points and lines']
    assert row['status'] == 'ok' and row['copy_of'] == 'office' and row['run']['settings']['degrade.resize'] == 0.5
    assert row['trajectory']['ate_rmse_m'] < 0.1


def test_lines_alone_do_not_start_and_that_is_said_not_suffered(measured):
    row = rows_of(measured[0])['office', 'lines only']
    assert row['status'] == 'no start' and row['trajectory'] is None and 'corners' in row['reason']


def test_a_recording_that_is_not_there_is_missing_not_failed(measured):
    row = rows_of(measured[0])['without a file', '']
    assert row['status'] == 'missing' and 'nowhere' in row['reason']


def test_the_page_has_the_tables_and_what_was_written_by_hand(measured):
    directory, out, err = measured
    page = (directory / 'page.md').read_text()
    assert page.startswith('# By hand\n\nabove\n\n<!-- benchmark recordings')
    section = (directory / 'out' / 'recordings.md').read_text().strip()
    assert section in page and section in out
    assert 'no start' in section and '- without a file: missing' in section and 'office, smaller' in section
    assert 'office, points and lines: ok, ATE 0.' in err


def test_sections_are_replaced_and_the_rest_stays(tmp_path):
    path = tmp_path / 'page.md'
    path.write_text('before\n')
    put_section(path, 'a', 'one')
    put_section(path, 'b', 'two')
    path.write_text(path.read_text() + 'after\n')
    once = path.read_text()
    put_section(path, 'a', 'one')
    assert path.read_text() == once
    put_section(path, 'a', '| three |')
    assert path.read_text() == once.replace('\none\n', '\n| three |\n')


@pytest.mark.parametrize('spoil', [
    lambda text: text.replace('<!-- end of benchmark a -->', ''), lambda text: text + text,
    lambda text: '\n'.join(reversed(text.splitlines()))])
def test_broken_markers_are_named_and_nothing_is_written(tmp_path, spoil):
    path = tmp_path / 'page.md'
    path.write_text(spoil(with_section('', 'a', 'one')))
    before = path.read_text()
    with pytest.raises(ValueError, match=r'page.md: needs exactly one line .*benchmark a'):
        put_section(path, 'a', 'two')
    assert path.read_text() == before


def test_a_crash_is_a_row_with_its_last_words(listed, tmp_path):
    recording = read_suite(listed('recordings: {a: {bag: x}}'))[0]
    row = finished_row(recording, recording.variants[0], tmp_path, -11, 'Segmentation fault', None)
    assert (row.status, row.reason) == ('failed', 'exit code -11: Segmentation fault')
    assert '- a, points and lines: exit code -11' in recordings_section([row], 50.0)


def test_a_run_that_hangs_and_one_that_fails_are_rows(listed, tmp_path):
    (tmp_path / 'bag').mkdir()
    path = listed('recordings: {a: {bag: bag, variants: [points only]}}')
    for timeout, status in ((0.01, 'timeout'), (300.0, 'failed')):
        code, *_ = line_slam('benchmark', 'recordings', path, '--output', tmp_path / 'out', '--timeout', timeout)
        row, = rows_of(tmp_path).values()
        assert code == 1 and row['status'] == status
    assert 'is not a bag' in row['reason']


def test_an_asl_folder_becomes_a_bag_with_its_truth(listed, tmp_path):
    if not EUROC.is_dir():
        pytest.skip(f'{EUROC} is missing')
    recording = read_suite(listed(f'recordings: {{a: {{asl: {EUROC}}}}}'))[0]
    bag, truth = prepared(recording, tmp_path, tmp_path, 300.0)
    assert (bag / 'metadata.yaml').is_file() and truth == bag / 'groundtruth.tum' and truth.is_file()


def test_a_folder_that_cannot_be_converted_is_a_failed_row(listed, tmp_path):
    (tmp_path / 'empty').mkdir()
    code, *_ = line_slam('benchmark', 'recordings', listed('recordings: {a: {asl: empty, variants: [points only]}}'),
                         '--output', tmp_path / 'out')
    row, = rows_of(tmp_path).values()
    assert code == 1 and row['status'] == 'failed' and 'is no EuRoC/ASL folder' in row['reason']


def stamped(topic, t_ms):
    """A message with a stamp of that many ms."""
    stamp = SimpleNamespace(sec=0, nanosec=t_ms * 1_000_000)
    return topic, SimpleNamespace(header=SimpleNamespace(stamp=stamp))


@pytest.mark.parametrize('start_s, duration_s, images, samples', [
    (0.0, None, [100, 200, 300, 400], 5), (0.1, None, [200, 300, 400], 5), (0.0, 0.2, [100, 200, 300], 4),
    (0.1, 0.1, [200, 300], 4), (1.0, None, [], 5)])
def test_a_clip_is_cut_by_the_stamps_of_its_images(start_s, duration_s, images, samples):
    messages = [m for t in (100, 200, 300, 400) for m in (stamped('imu', t - 10), stamped('image', t))]
    kept = list(Clip('image', start_s, duration_s).of([*messages, stamped('imu', 410)]))
    assert [m.header.stamp.nanosec // 1_000_000 for topic, m in kept if topic == 'image'] == images
    assert sum(topic == 'imu' for topic, _ in kept) == samples


def test_rows_survive_the_file_and_later_ones_replace_them(tmp_path):
    old = [Row('a', 'x', '', 'ok', 'old', {'frames': 1}), Row('b', '', '', 'missing', 'gone'),
           Row('c', 'x', '', 'ok', '')]
    write_rows(tmp_path / 'r.json', old, math.nan)
    assert read_rows(tmp_path / 'r.json') == old and read_rows(tmp_path / 'none.json') == []
    new = [Row('b', 'x', '', 'ok', ''), Row('a', 'x', '', 'ok', 'new')]
    assert [(row.key, row.reason) for row in merged(old, new)] == [(('a', 'x'), 'new'), (('c', 'x'), ''),
                                                                  (('b', 'x'), '')]


def test_what_is_not_known_is_a_dash():
    assert [number(None), number(math.nan), number(2.0, '.1f')] == ['–', '–', '2.0']
