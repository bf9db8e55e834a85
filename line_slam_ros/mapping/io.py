"""Line maps on disk: CSV that reads back exactly, PLY wireframes for viewers."""
from __future__ import annotations

import csv
import time
from pathlib import Path

import numpy as np

from line_slam_ros.types import LineSegments

HEADER = ['id', 'x1_m', 'y1_m', 'z1_m', 'x2_m', 'y2_m', 'z2_m', 'views', 'sigma_m',
          'nx_m', 'ny_m', 'nz_m', 'dx', 'dy', 'dz']
BLOCK = 16  # rows


def write_csv(path: str | Path, lines: LineSegments, pause_s: float = 0.0) -> None:
    """One row per line under a header: end points, number of views, sigma, Pluecker moment and direction (world).

    Between blocks of rows it sleeps for pause_s, so that other threads hardly wait for the interpreter.
    """
    columns = lines.ids, lines.ends.reshape(-1, 6), lines.views, lines.sigma, lines.pluecker
    with open(path, 'w', newline='', encoding='utf-8') as file:
        file.write(','.join(HEADER) + '\n')
        for begin in range(0, len(lines), BLOCK):
            rows = zip(*(column[begin: begin + BLOCK].tolist() for column in columns), strict=True)
            file.writelines(','.join(map(repr, (line_id, *ends, views, sigma, *pluecker))) + '\n'
                            for line_id, ends, views, sigma, pluecker in rows)
            time.sleep(pause_s)


def read_csv(path: str | Path) -> LineSegments:
    """What write_csv wrote, exactly. ValueError names the file, the row and what is wrong with it."""
    with open(path, newline='', encoding='utf-8') as file:
        rows = list(csv.reader(file))
    if not rows or rows[0] != HEADER:
        raise ValueError(f'{path}: not a line map, the first row must be {",".join(HEADER)}')
    if len(rows) == 1:
        return LineSegments.empty()
    values = np.array([_numbers(path, k + 2, row) for k, row in enumerate(rows[1:])])
    ids, views = (np.array([int(row[c]) for row in rows[1:]], np.int64) for c in (0, 7))
    return LineSegments(ids, values[:, 9:].copy(), values[:, 1:7].reshape(-1, 2, 3).copy(), views, values[:, 8].copy())


def _numbers(path: str | Path, line: int, row: list[str]) -> list[float]:
    if len(row) != len(HEADER):
        raise ValueError(f'{path}, line {line}: {len(HEADER)} fields expected, got {len(row)}')
    try:
        int(row[0]), int(row[7])
        return [float(field) for field in row]
    except ValueError as error:
        raise ValueError(f'{path}, line {line}: {error}') from None


def write_ply(path: str | Path, lines: LineSegments) -> None:
    """A wireframe of vertices and edges (binary, little endian), as MeshLab, CloudCompare and Open3D read it."""
    header = '\n'.join(['ply', 'format binary_little_endian 1.0', 'comment line map, world frame, metres',
                        f'element vertex {2 * len(lines)}', 'property double x', 'property double y',
                        'property double z', f'element edge {len(lines)}', 'property int vertex1',
                        'property int vertex2', 'end_header', ''])
    with open(path, 'wb') as file:
        file.write(header.encode('ascii'))
        file.write(lines.ends.astype('<f8').tobytes())
        file.write(np.arange(2 * len(lines), dtype='<i4').tobytes())
