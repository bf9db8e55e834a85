#!/usr/bin/env python3
"""Write the tables of docs/line-geometry.md: which test covers which row, trap and source error.

Reads the marks of the tests from their syntax trees and the lists in tests/rows.py.
"""
from __future__ import annotations

import ast
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / 'docs' / 'line-geometry.md'
TESTS = ROOT / 'tests'
sys.path.insert(0, str(TESTS))

from rows import ROWS, SOURCE_ERRORS, TRAPS  # noqa: E402

LISTED = {'row': tuple(ROWS), 'trap': TRAPS, 'source_error': tuple(SOURCE_ERRORS)}
BEGIN, END = '<!-- {}: written by scripts/write_rows.py -->', '<!-- end of {} -->'

Key = int | str
Covering = dict[tuple[str, Key], list[tuple[str, str]]]  # (kind of mark, its argument) -> (file, test)


def marks_of(source: str, file: str) -> Iterator[tuple[str, Key, str]]:
    """(kind, argument, test) of every mark of ours in a test module.

    ValueError for one that does not decorate a test, and for an argument that is not a literal.
    """
    tree = ast.parse(source)
    decorating = {mark.func if isinstance(mark, ast.Call) else mark: (mark, test.name) for test in ast.walk(tree)
                  if isinstance(test, ast.FunctionDef) and test.name.startswith('test_')
                  for mark in test.decorator_list}
    for node in filter(is_ours, ast.walk(tree)):
        if node not in decorating:
            raise ValueError(f'{file}:{node.lineno}: mark {node.attr} must be a decorator of a function test_*')
        mark, test = decorating[node]
        arguments = mark.args if isinstance(mark, ast.Call) else []
        if not arguments or not all(isinstance(a, ast.Constant) for a in arguments):
            raise ValueError(f'{file}:{mark.lineno}: mark {node.attr} of {test} needs literal arguments')
        yield from ((node.attr, argument.value, test) for argument in arguments)


def is_ours(node: ast.AST) -> bool:
    """Whether it reads pytest.mark.row or another kind of LISTED, however pytest was imported."""
    return isinstance(node, ast.Attribute) and node.attr in LISTED and ast.unparse(node.value).endswith('mark')


def covering(folder: Path = TESTS) -> Covering:
    """What every mark in the test modules of a folder stands on, by file."""
    found: Covering = defaultdict(list)
    for path in sorted(folder.glob('test_*.py')):
        for kind, key, test in marks_of(path.read_text(encoding='utf-8'), path.name):
            found[kind, key].append((path.name, test))
    return dict(found)


def cell(text: str) -> str:
    """Text in a table: the bars of |d| are not the table's."""
    return text.replace('|', '\\|')


def tests_cell(found: Covering, kind: str, key: Key) -> str:
    return '<br>'.join(f'[{file}](../tests/{file})::{test}' for file, test in found.get((kind, key), []))


def tables() -> dict[str, str]:
    """The generated tables by name."""
    found = covering()
    rows = ''.join(f'| {key} | {cell(title)} | {tests_cell(found, "row", key)} |\n' for key, title in ROWS.items())
    traps = ''.join(f'| {trap} | {tests_cell(found, "trap", trap)} |\n' for trap in TRAPS)
    errors = ''.join(f'| {item} | {cell(error.says)} | {cell(error.right)} | {cell(error.counter_example())} '
                     f'| {tests_cell(found, "source_error", item)} |\n' for item, error in SOURCE_ERRORS.items())
    return {
        'source errors': '| item | the source | right | counter-example | test |\n|---|---|---|---|---|\n' + errors,
        'rows': '| row | what | tests |\n|---|---|---|\n' + rows,
        'traps': '| trap | tests |\n|---|---|\n' + traps,
    }


def page_text(text: str) -> str:
    """The page with its tables up to date. ValueError when a marker is missing."""
    for name, table in tables().items():
        begin, end = BEGIN.format(name), END.format(name)
        head, found_begin, rest = text.partition(begin)
        _, found_end, tail = rest.partition(end)
        if not (found_begin and found_end):
            raise ValueError(f'{PAGE.name} needs the lines {begin!r} and {end!r} around its table')
        text = f'{head}{begin}\n\n{table}\n{end}{tail}'
    return text


def main() -> None:
    PAGE.write_text(page_text(PAGE.read_text(encoding='utf-8')), encoding='utf-8')


if __name__ == '__main__':
    main()
