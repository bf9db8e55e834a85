"""The three text files of the line experiment, and seeded noise on what they hold.

    cam_pose_tum.txt   t x y z qx qy qz qw            T_WC of every frame, t in s
    house.txt          x1 y1 z1 x2 y2 z2              the true segment of every line, m in W; the row is its id
    observations.txt   frame line u1 v1 u2 v2         rows of the other two, and both ends, normalised

The form of the line code base: columns parted by blanks, # opens a comment, blank lines do not count. What cannot be
used raises ValueError('path:line: what is wrong, what is expected').
"""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from line_slam_ros.geometry.lie import matrix_from_quaternion, quaternion_from_matrix, rigid
from line_slam_ros.types import F64, I64

POSES, LANDMARKS, OBSERVATIONS = 'cam_pose_tum.txt', 'house.txt', 'observations.txt'
QUATERNION_LENGTHS = (1e-6, 1e6)  # outside, a quaternion is no rounded unit quaternion but a mistake
MOST_NOISE = 1e3  # normalised; far wider than any image
SHOWN = 80  # characters of a row in a message


@dataclass(frozen=True, slots=True)
class LineViews:
    """What cameras saw of lines; one row per view, in the order of the file."""

    frame: I64  # (M,) row of the poses
    line: I64  # (M,) row of the landmarks
    ends: F64  # (M, 2, 2) normalised


@dataclass(frozen=True, slots=True)
class Experiment:
    """Known camera poses, true segments and the views of them."""

    T_WC: F64  # (F, 4, 4)
    stamps: F64  # (F,) s
    segments: F64  # (L, 2, 3) m in W
    views: LineViews


def read_experiment(directory: str | Path, observations: str | Path | None = None) -> Experiment:
    """The three files of a directory; ``observations`` names another file of views, relative to the directory."""
    directory = Path(directory)
    if not directory.is_dir():
        raise ValueError(f'{directory}: no such directory, expected one with {POSES}, {LANDMARKS} and {OBSERVATIONS}')
    stamps, T_WC = read_poses(directory / POSES)
    segments = read_landmarks(directory / LANDMARKS)
    views = read_observations(directory / (observations or OBSERVATIONS), len(T_WC), len(segments))
    return Experiment(T_WC, stamps, segments, views)


def read_poses(path: str | Path) -> tuple[F64, F64]:
    """Stamps (F,) in s, increasing, and T_WC (F, 4, 4); quaternions of any usable length are normalised."""
    table = _Table(path, 't x y z qx qy qz qw')
    stamps, q_xyzw = table.values[:, 0], table.values[:, 4:]
    table.refuse(np.diff(stamps, prepend=-np.inf) <= 0.0,
                 'time {0} is not after the one before, expected times that grow from row to row')
    size = np.abs(q_xyzw).max(axis=1)
    shortest, longest = QUATERNION_LENGTHS
    table.refuse((size < shortest) | (size > longest),
                 'quaternion {4} {5} {6} {7} is no rotation, expected qx qy qz qw of length 1')
    return stamps.copy(), rigid(matrix_from_quaternion(q_xyzw), table.values[:, 1:4])


def read_landmarks(path: str | Path) -> F64:
    """Segments (L, 2, 3) in W; the id of a line is its row."""
    table = _Table(path, 'x1 y1 z1 x2 y2 z2')
    segments = table.values.reshape(-1, 2, 3)
    table.refuse(_without_length(segments), 'both ends are {0} {1} {2}, expected two different points')
    return segments


def read_observations(path: str | Path, frames: int, lines: int) -> LineViews:
    """Views in the order of the file, of ``frames`` frames and ``lines`` lines, at most one per frame and line."""
    table = _Table(path, 'frame line u1 v1 u2 v2')
    frame, line = table.ids(0, 'frame', frames), table.ids(1, 'line', lines)
    again = np.ones(len(frame), bool)
    again[np.unique(frame * lines + line, return_index=True)[1]] = False
    table.refuse(again, 'a second view of line {1:.0f} in frame {0:.0f}, expected one per line and frame')
    ends = table.values[:, 2:].reshape(-1, 2, 2)
    table.refuse(_without_length(ends), 'both ends are {2} {3}, expected a segment with a length')
    return LineViews(frame, line, ends)


def write_poses(path: str | Path, stamps: F64, T_WC: F64) -> None:
    """Stamps (F,) in s and T_WC (F, 4, 4) as TUM rows."""
    q_xyzw = quaternion_from_matrix(T_WC[:, :3, :3])
    _write(path, np.column_stack([stamps, T_WC[:, :3, 3], q_xyzw]).tolist())


def write_landmarks(path: str | Path, segments: F64) -> None:
    """Segments (L, 2, 3) in W."""
    _write(path, segments.reshape(-1, 6).tolist())


def write_observations(path: str | Path, views: LineViews) -> None:
    """All views, in their order."""
    rows = zip(views.frame.tolist(), views.line.tolist(), views.ends.reshape(-1, 4).tolist(), strict=True)
    _write(path, [[frame, line, *ends] for frame, line, ends in rows])


def add_noise(views: LineViews, sigma: float, seed: int) -> LineViews:
    """The views with Gaussian noise of standard deviation sigma (normalised) on all four coordinates.

    Drawn row by row for all views: same seed, same bytes, and a part of the rows must be taken after the noise.
    ValueError for a sigma not from 0 to MOST_NOISE or a negative seed.
    """
    if not 0.0 <= sigma <= MOST_NOISE:
        raise ValueError(f'noise must be a standard deviation from 0 to {MOST_NOISE:g} (normalised), got {sigma:g}')
    if seed < 0:
        raise ValueError(f'seed must be 0 or more, got {seed}')
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (len(views.line), 4)) * sigma
    return LineViews(views.frame, views.line, views.ends + noise.reshape(-1, 2, 2))


class _Table:
    """The finite numbers of a text file and, when one of them will not do, the line it stands in."""

    def __init__(self, path: str | Path, names: str) -> None:
        self.path, self.names, self.columns = path, names, len(names.split())
        try:  # an odd byte becomes a replacement character, which is no number and so has a line
            self._lines = Path(path).read_text(encoding='utf-8-sig', errors='replace').split('\n')
        except OSError as error:
            raise ValueError(f'{path}: {error.strerror}, expected a text file with rows {names}') from None
        if not any(map(_holds_row, self._lines)):
            raise ValueError(f'{path}:{len(self._lines)}: the file ends without a row, expected rows {names}')
        self.values = self._parsed()
        self.refuse(~np.isfinite(self.values).all(axis=1), f'NaN or infinity, expected finite numbers {names}')

    def refuse(self, bad: NDArray[np.bool_], message: str) -> None:
        """ValueError at the first of the rows (N,) that is bad; {k} in the message is the number in its column k."""
        if bad.any():
            row = int(np.argmax(bad))
            number, _ = self._numbered_rows()[row]
            raise ValueError(f'{self.path}:{number}: {message.format(*self.values[row])}')

    def ids(self, column: int, name: str, count: int) -> I64:
        """A column (N,) as ids of ``count`` things."""
        values = self.values[:, column]
        known = (values >= 0) & (values < count) & (values == np.floor(values))
        self.refuse(~known, f'unknown {name} {{{column}:.12g}}, expected a whole number from 0 to {count - 1}')
        return values.astype(np.int64)

    def _parsed(self) -> F64:
        """(N, columns); np.loadtxt is fast, and only on failure each row is looked at to find the one to blame."""
        try:
            return self._checked(self._lines)
        except ValueError:
            for number, row in self._numbered_rows():
                try:
                    self._checked([row])
                except ValueError:
                    shown = repr(row.strip()[:SHOWN])[1:-1][:SHOWN]  # control characters escaped
                    raise ValueError(f'{self.path}:{number}: "{shown}", '
                                     f'expected {self.columns} numbers {self.names}') from None
            raise

    def _checked(self, lines: list[str]) -> F64:
        values = np.loadtxt(lines, comments='#', ndmin=2)
        if values.shape[1] != self.columns:
            raise ValueError(f'{values.shape[1]} columns')
        return values

    def _numbered_rows(self) -> list[tuple[int, str]]:
        """Line number, from 1, and text of all lines that hold a row."""
        return [(number, line) for number, line in enumerate(self._lines, 1) if _holds_row(line)]


def _without_length(ends: F64) -> NDArray[np.bool_]:
    """(N,): both ends (N, 2, D) are the same point."""
    return (ends[:, 0] == ends[:, 1]).all(axis=1)


def _holds_row(line: str) -> bool:
    return line.partition('#')[0].strip() != ''


def _write(path: str | Path, rows: list[list[float]]) -> None:
    """Numbers with as many digits as reading them back exactly needs."""
    Path(path).write_text(''.join(f'{" ".join(map(repr, row))}\n' for row in rows), encoding='utf-8', newline='\n')
