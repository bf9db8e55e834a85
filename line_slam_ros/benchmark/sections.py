"""Generated sections of a Markdown file that is otherwise written by hand."""
from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path


def put_section(path: Path, name: str, text: str) -> None:
    """Replace what stands between the file's two markers of that name, or append both; makes the file if need be."""
    old = path.read_text(encoding='utf-8') if path.exists() else ''
    try:
        path.write_text(with_section(old, name, text), encoding='utf-8')
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None


def with_section(document: str, name: str, text: str) -> str:
    """The document with ``text`` as its section of that name; ValueError if its markers are not one pair."""
    first, last = f'<!-- benchmark {name}: generated, do not edit -->', f'<!-- end of benchmark {name} -->'
    section = f'{first}\n{text.strip()}\n{last}'
    if first not in document and last not in document:
        head = f'{document.rstrip()}\n\n' if document.strip() else ''
        return f'{head}{section}\n'
    before, _, rest = document.partition(first)
    _, _, after = rest.partition(last)
    if document.count(first) != 1 or document.count(last) != 1 or last in before:
        raise ValueError(f'needs exactly one line {first!r} and after it one line {last!r}')
    return before + section + after


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ['---'] * len(header), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)


def number(value: float | None, form: str = '.3f') -> str:
    """Formatted, or a dash for None and NaN."""
    return '–' if value is None or math.isnan(value) else format(value, form)
