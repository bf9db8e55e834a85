import cv2
import numpy as np
import pytest

from line_slam_ros.frontend.line_detector import detect
from line_slam_ros.frontend.segment_kernels import buffers


def drawn(*boxes, dark=60, bright=180):
    """Image 400x300 of bright boxes (u0, v0, u1, v1), sub-pixel blurred edges at half-integer coordinates."""
    image = np.full((300, 400), dark, np.uint8)
    for u0, v0, u1, v1 in boxes:
        image[v0:v1, u0:u1] = bright
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def found_at_half_size(image, min_length_px):
    """Segments in px of image, found as the tracker does."""
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return 2.0 * detect(half, 0.5 * min_length_px, buffers(*half.shape)) + 0.5


def test_the_four_edges_of_a_box():
    found = found_at_half_size(drawn((100, 80, 300, 200)), 40.0)
    assert len(found) == 4
    centre = found.mean(axis=1)
    for expected in ([199.5, 79.5], [199.5, 199.5], [99.5, 139.5], [299.5, 139.5]):
        assert np.min(np.linalg.norm(centre - expected, axis=1)) < 2.0  # px, half-size detection


def test_the_brighter_side_lies_along_the_normal():
    image = drawn((100, 80, 300, 200))
    for ends in found_at_half_size(image, 40.0):
        t = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        side = ends.mean(axis=0) + 4.0 * np.array([-t[1], t[0]])
        assert image[round(side[1]), round(side[0])] > 150


@pytest.mark.parametrize('angle', np.linspace(0.1, 6.0, 8))
def test_an_edge_of_any_direction_is_found_where_it_is(angle):
    v, u = np.mgrid[:300, :400]
    t, normal = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    distance = (u - 200.0) * normal[0] + (v - 150.0) * normal[1]
    found = detect(np.rint(120.0 + 60.0 * np.tanh(0.9 * distance)).astype(np.uint8), 40.0, buffers(300, 400))
    assert len(found) == 1
    ends = found[0] - [200.0, 150.0]
    assert np.abs(ends @ normal).max() < 0.3 and (ends[1] - ends[0]) @ t > 280.0  # px


def test_broken_pieces_become_one():
    image = drawn((50, 150, 190, 250), (196, 150, 350, 250))
    top = [e for e in found_at_half_size(image, 40.0) if np.abs(e[:, 1] - 149.5).max() < 2.0]
    assert len(top) == 1
    assert np.abs(top[0][1, 0] - top[0][0, 0]) > 280.0


def test_short_edges_are_left_out():
    assert not len(found_at_half_size(drawn((100, 80, 120, 100)), 40.0))


@pytest.mark.parametrize('grey', [0, 128, 255])
def test_constant_image(grey):
    assert found_at_half_size(np.full((300, 400), grey, np.uint8), 40.0).shape == (0, 2, 2)
