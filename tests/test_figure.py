"""The picture of a run, also of runs that have little to show."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from line_slam_ros.cli import figure
from line_slam_ros.types import LineSegments


def segments(count: int) -> LineSegments:
    ends = np.random.default_rng(0).normal(size=(count, 2, 3))
    along = ends[:, 1] - ends[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return LineSegments(np.arange(count), np.hstack([np.cross(ends[:, 0], along), along]), ends, np.full(count, 5),
                        np.full(count, 0.01))


def drawn(path: Path, *arguments: object) -> list[np.ndarray]:
    """The three panels."""
    figure.save(path, *arguments)
    return np.split(cv2.imread(str(path)), 3, axis=1)


def test_three_panels(tmp_path):
    image = np.zeros((48, 64, 3), np.uint8)
    image[..., 2] = 255  # red in BGR
    camera, above, wireframe = drawn(tmp_path / 'f.png', image, list(np.random.default_rng(1).normal(size=(9, 3))),
                                     segments(5))
    assert np.median(camera[camera[..., 1] < 128], axis=0).tolist() == [0, 0, 255]
    assert above.std() > 10 and wireframe.std() > 10


@pytest.mark.parametrize('count', [0, 1])
def test_little_to_show(tmp_path, count):
    _, above, _ = drawn(tmp_path / 'f.png', None, [np.zeros(3)], segments(count))
    assert above.std() > 5


def test_a_far_outlier_does_not_shrink_the_view():
    few = segments(100).ends
    few[0] *= 1000
    low, high = figure._limits(np.zeros((1, 3)), few)
    assert np.abs([low, high]).max() < 10
