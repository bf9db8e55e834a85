"""Records by stable id in a structure of arrays: compact rows, growth by doubling, nothing allocated per record."""
from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import DTypeLike, NDArray

from line_slam_ros.types import I64

SMALLEST = 64  # rows allocated to begin with


class IdTable:
    """Columns of equal length whose rows are found by id.

    table['name'] is a view (N, ...) of the rows in use; it is stale after the next put() or remove().
    """

    def __init__(self, **columns: tuple[tuple[int, ...], DTypeLike]) -> None:
        """columns: name -> (shape of one record, type)."""
        self._columns = {name: np.zeros((SMALLEST, *shape), dtype) for name, (shape, dtype) in columns.items()}
        self._ids = np.zeros(SMALLEST, np.int64)
        self._row_of: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._row_of)

    def __contains__(self, record_id: int) -> bool:
        return int(record_id) in self._row_of

    def __getitem__(self, name: str) -> NDArray:
        return self._columns[name][: len(self)]

    @property
    def ids(self) -> I64:
        """(N,) ids in row order."""
        return self._ids[: len(self)]

    def rows(self, ids: Iterable[int]) -> I64:
        """Row of each id, -1 where it is unknown."""
        return np.array([self._row_of.get(int(i), -1) for i in ids], np.int64)

    def put(self, record_id: int) -> int:
        """Row of the id; a new one is appended with zeros."""
        row = self._row_of.get(int(record_id))
        if row is not None:
            return row
        row = len(self)
        if row == len(self._ids):
            self._grow()
        self._ids[row] = record_id
        for column in self._columns.values():
            column[row] = 0
        self._row_of[int(record_id)] = row
        return row

    def remove(self, record_id: int) -> None:
        """Forget the id; the last row takes its place. KeyError when unknown."""
        row, last = self._row_of.pop(int(record_id)), len(self)
        if row == last:
            return
        for column in (self._ids, *self._columns.values()):
            column[row] = column[last]
        self._row_of[int(self._ids[row])] = row

    def clear(self) -> None:
        self._row_of.clear()

    def _grow(self) -> None:
        self._ids = np.concatenate([self._ids, np.zeros_like(self._ids)])
        self._columns = {n: np.concatenate([c, np.zeros_like(c)]) for n, c in self._columns.items()}
