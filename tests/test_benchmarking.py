"""What ``line_slam benchmark`` checks before it measures anything."""
import pytest
from bag_samples import line_slam


@pytest.mark.parametrize('kind', [('recordings', 'suite.yaml'), ('consistency',), ('lines',), ('speed',)])
def test_a_markdown_file_without_a_directory_is_refused_before_the_measurement(tmp_path, kind, monkeypatch):
    for name in ('machine_ms', 'simulate_all', 'line_speed', 'Parts'):
        monkeypatch.setattr(f'line_slam_ros.cli.benchmarking.{name}', None)  # what measures
    (tmp_path / 'suite.yaml').write_text('recordings: {office: {bag: office}}\n')
    words = [tmp_path / word if word.endswith('.yaml') else word for word in kind]
    page = tmp_path / 'missing' / 'page.md'
    code, out, err = line_slam('benchmark', *words, '--output', tmp_path / 'out', '--markdown', page)
    assert (code, out) == (2, '') and err == (f'line_slam benchmark: {page}: its directory {page.parent} is missing; '
                                              'make it first\n')


def test_the_markdown_file_may_go_where_the_results_go(tmp_path, monkeypatch):
    monkeypatch.setattr('line_slam_ros.cli.benchmarking.machine_ms', lambda: 1.0)
    (tmp_path / 'suite.yaml').write_text('recordings: {office: {bag: office}}\n')
    page = tmp_path / 'out' / 'page.md'
    line_slam('benchmark', 'recordings', tmp_path / 'suite.yaml', '--output', tmp_path / 'out', '--markdown', page)
    assert 'office' in page.read_text()


def test_a_reference_without_a_directory_is_refused_before_the_measurement(tmp_path, monkeypatch):
    monkeypatch.setattr('line_slam_ros.cli.benchmarking.Parts', None)
    reference = tmp_path / 'missing' / 'reference.json'
    code, _, err = line_slam('benchmark', 'speed', '--output', tmp_path, '--reference', reference, '--update-reference')
    assert code == 2 and f'its directory {reference.parent} is missing' in err
