import cv2
import numpy as np
import pytest

from line_slam_ros.frontend.line_detector import LineDetector, orient


@pytest.fixture
def detector():
    return LineDetector()


def drawn(*boxes, dark=60, bright=180):
    """Image 400x300 of bright boxes (u0, v0, u1, v1), sub-pixel blurred edges at half-integer coordinates."""
    image = np.full((300, 400), dark, np.uint8)
    for u0, v0, u1, v1 in boxes:
        image[v0:v1, u0:u1] = bright
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def test_the_four_edges_of_a_box(detector):
    found = detector.detect(drawn((100, 80, 300, 200)), 40.0)
    assert len(found) == 4
    centre = found.mean(axis=1)
    for expected in ([199.5, 79.5], [199.5, 199.5], [99.5, 139.5], [299.5, 139.5]):
        assert np.min(np.linalg.norm(centre - expected, axis=1)) < 2.0  # px, half-size detection


def test_the_brighter_side_lies_along_the_normal(detector):
    image = drawn((100, 80, 300, 200))
    for ends in detector.detect(image, 40.0):
        t = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        side = ends.mean(axis=0) + 4.0 * np.array([-t[1], t[0]])
        assert image[round(side[1]), round(side[0])] > 150


def test_orientation_does_not_depend_on_the_order_given():
    image = drawn((100, 80, 300, 200))
    ends = np.array([[[120.0, 79.5], [280.0, 79.5]], [[280.0, 79.5], [120.0, 79.5]]])
    first, second = orient(image, ends)
    np.testing.assert_array_equal(first, second)


def test_broken_pieces_become_one(detector):
    image = drawn((50, 150, 190, 250), (196, 150, 350, 250))
    top = [e for e in detector.detect(image, 40.0) if np.abs(e[:, 1] - 149.5).max() < 2.0]
    assert len(top) == 1
    assert np.abs(top[0][1, 0] - top[0][0, 0]) > 280.0


def test_short_edges_are_left_out(detector):
    assert not len(detector.detect(drawn((100, 80, 120, 100)), 40.0))


@pytest.mark.parametrize('grey', [0, 128, 255])
def test_constant_image(detector, grey):
    assert detector.detect(np.full((300, 400), grey, np.uint8), 40.0).shape == (0, 2, 2)
