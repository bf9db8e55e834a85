"""The filters of the front end are those of OpenCV."""
import cv2
import numpy as np
import pytest

from line_slam_ros.frontend.smoothing import halve, smooth

SIZES = [(3, 3), (4, 5), (5, 4), (31, 64), (64, 31), (121, 163), (480, 752)]


@pytest.fixture(params=['noise', 'black and white', 'white'])
def image_of(request):
    grey = {'noise': np.arange(256), 'black and white': np.array([0, 255]), 'white': np.array([255])}[request.param]
    return lambda size: np.random.default_rng(1).choice(grey, size).astype(np.uint8)


@pytest.mark.parametrize('size', SIZES)
def test_smooth_is_a_gaussian_blur(image_of, size):
    image, out = image_of(size), np.empty(size, np.uint8)
    smooth(image, np.empty(size[1] + 4, np.uint16), out)
    np.testing.assert_array_equal(out, cv2.GaussianBlur(image, (3, 3), 0))


@pytest.mark.parametrize('size', SIZES)
def test_halve_is_a_step_down_the_pyramid(image_of, size):
    image, out = image_of(size), np.empty(((size[0] + 1) // 2, (size[1] + 1) // 2), np.uint8)
    halve(image, np.empty(size[1] + 4, np.uint16), out)
    np.testing.assert_array_equal(out, cv2.pyrDown(image))
