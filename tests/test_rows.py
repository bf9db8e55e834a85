"""All rows, traps and errors of the sources listed in tests/rows.py have tests, and the page says which."""
from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
from rows import ROWS, SOURCE_ERRORS, TRAPS

ROOT = Path(__file__).parents[1]
MARKS = {'row': tuple(ROWS), 'trap': TRAPS, 'source_error': tuple(SOURCE_ERRORS)}


def load_writer() -> ModuleType:
    spec = importlib.util.spec_from_file_location('write_rows', ROOT / 'scripts' / 'write_rows.py')
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


writer = load_writer()


@pytest.fixture(scope='module')
def covering() -> dict[tuple[str, int | str], list[tuple[str, str]]]:
    return writer.covering()


@pytest.mark.parametrize('kind, key', [(kind, key) for kind, keys in MARKS.items() for key in keys])
def test_all_that_is_listed_has_a_test(covering, kind: str, key: int | str) -> None:
    tests = covering.get((kind, key))
    assert tests, f'mark a test with @pytest.mark.{kind}({key!r})'


def test_marks_name_only_what_is_listed(covering) -> None:
    unknown = {f'{file}::{test}: {kind}({key!r})' for (kind, key), tests in covering.items() for file, test in tests
               if key not in MARKS[kind]}
    assert not unknown, 'list it in tests/rows.py or correct the mark'


def test_the_rows_are_numbered_without_gaps() -> None:
    assert list(ROWS) == list(range(1, 42))


def test_the_page_is_up_to_date() -> None:
    text = writer.PAGE.read_text(encoding='utf-8')
    assert writer.page_text(text) == text, 'run scripts/write_rows.py'


def test_a_page_without_markers_is_refused() -> None:
    with pytest.raises(ValueError, match='needs the lines .*source errors'):
        writer.page_text('# Line geometry\n')


def test_marks_are_read_in_every_form_they_take() -> None:
    source = ('@pytest.mark.parametrize("x", [1])\n@pytest.mark.row(3, 6)\n@pytest.mark.trap("near")\n'
              'def test_one(x): ...\n\n\nclass TestMore:\n    @pytest.mark.row(4)\n    def test_two(self): ...\n')
    assert list(writer.marks_of(source, 'f.py')) == [('row', 3, 'test_one'), ('row', 6, 'test_one'),
                                                     ('trap', 'near', 'test_one'), ('row', 4, 'test_two')]


@pytest.mark.parametrize('source', [
    '@pytest.mark.parametrize("x", [pytest.param(1, marks=pytest.mark.row(3))])\ndef test_one(x): ...\n',
    'pytestmark = pytest.mark.row(3)\n\n\ndef test_one(): ...\n',
    'pytestmark = [pytest.mark.trap("near")]\n\n\ndef test_one(): ...\n',
    'covers = pytest.mark.row\n\n\n@covers(3)\ndef test_one(): ...\n',
    '@mark.source_error("D1")\ndef helper(): ...\n',
    '@pytest.mark.row(3)\ndef helper(): ...\n',
    '@pytest.mark.row(3)\nclass TestMore:\n    def test_two(self): ...\n'])
def test_a_mark_that_does_not_decorate_a_test_is_refused(source: str) -> None:
    with pytest.raises(ValueError, match=r'f.py:1: mark (row|trap|source_error) must be a decorator of a function'):
        list(writer.marks_of(source, 'f.py'))


@pytest.mark.parametrize('mark', ['row', 'row()', 'row(N)', 'row(3, N)'])
def test_a_mark_that_cannot_be_read_is_an_error(mark: str) -> None:
    with pytest.raises(ValueError, match='f.py:1: mark row of test_one needs literal arguments'):
        list(writer.marks_of(f'@pytest.mark.{mark}\ndef test_one(): ...\n', 'f.py'))
