"""Thin stripes against their blurred profiles, which are known exactly."""
import numpy as np
import pytest
from scipy.stats import norm

from line_slam_ros.frontend import edge_kernels as edge
from line_slam_ros.frontend import stripes
from line_slam_ros.kernel_cache import kernel

ROWS = np.arange(edge.WIDTH) - edge.HALF
BEFORE = np.sqrt(stripes.BLUR**2 - 1.0 / 3.0)  # px; differences of grey two rows apart add the rest


@kernel
def look(values, seen, slopes, stripe):
    """For Python."""
    return stripes.look(values, seen, slopes, stripe)


def looks(grey):
    """Width, and stripes (1, 2, 2), of an edge of which each sample shows this grey (WIDTH,)."""
    values, stripe = np.repeat(50.0 * grey[:, None], edge.SAMPLES, axis=1).astype(np.float32), np.empty((2, 2))
    width = look(values, np.ones(edge.SAMPLES, np.float32), np.zeros(edge.SAMPLES, np.float32), stripe)
    return width, stripe[None]


def stripe(width, blur, bright, height=1.0):
    """Grey (WIDTH,) across a rising edge, where differences of rows are largest in the middle row, and how far the edge
    is from there: of a bright or dark stripe so many px wide, the other side of so much of its height, seen through a
    blur that is so large with these differences."""
    far, before = width if bright else -width, np.sqrt(blur**2 - 1.0 / 3.0)

    def grey(y):
        return norm.cdf(y / before) - height * norm.cdf((y - far) / before)
    y = np.linspace(-3.0, 3.0, 6001)
    steepest = y[np.argmax(grey(y + 1.0) - grey(y - 1.0))]
    return grey(ROWS + steepest), -steepest


@pytest.mark.parametrize('bright', [False, True])
@pytest.mark.parametrize('width', [0.7, 1.0, 1.5, 2.0, 3.0, 5.0])
@pytest.mark.parametrize('blur', [1.1, 1.4, 1.7])
@pytest.mark.parametrize('wrong', [0.9, 1.0, 1.1])
def test_the_sides_of_a_stripe_are_moved_to_where_they_are(blur, width, bright, wrong):
    grey, off = stripe(width, blur, bright)
    found, sigma = stripes.displacement(looks(grey)[1], wrong * blur)
    assert found[0] * off >= 0.0
    assert abs(found[0] - off) < max(2.2 * sigma[0], 0.1)
    assert abs(found[0] - off) < 0.5 * abs(off) or abs(off) < 0.6 * blur
    assert sigma[0] < 0.45 * wrong * blur


@pytest.mark.parametrize('height', [1.5, 2.0, 4.0])
@pytest.mark.parametrize('width', [1.0, 2.0, 3.0])
def test_a_steeper_side_is_known_to_make_an_edge_uncertain(height, width):
    grey, off = stripe(width, stripes.BLUR, True, height)
    found, sigma = stripes.displacement(looks(grey)[1], stripes.BLUR)
    assert abs(found[0] - off) < 3.0 * sigma[0]


def test_a_weaker_side_moves_an_edge_less():
    (equal, off), (weaker, less) = stripe(1.5, stripes.BLUR, True), stripe(1.5, stripes.BLUR, True, 0.3)
    found = [stripes.displacement(looks(grey)[1], stripes.BLUR)[0][0] for grey in (equal, weaker)]
    assert abs(less) < 0.5 * abs(off)
    assert abs(found[1]) < 0.6 * abs(found[0])


def test_what_is_on_both_sides_moves_an_edge_to_both():
    one, both = (looks(norm.cdf(ROWS / BEFORE) - norm.cdf((ROWS - 3.0) / BEFORE) + k * norm.cdf(-(ROWS + 3.0) / BEFORE))
                 for k in (0.0, 1.0))
    assert stripes.displacement(one[1], stripes.BLUR)[0][0] > 0.1
    assert stripes.displacement(both[1], stripes.BLUR)[0][0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize('grey', [
    pytest.param(norm.cdf(ROWS / BEFORE), id='a step'),
    pytest.param(norm.cdf(ROWS / BEFORE) + norm.cdf((ROWS - 3.0) / BEFORE), id='a second step up'),
    pytest.param(stripe(20.0, stripes.BLUR, False)[0], id='a wide stripe'),
])
def test_an_edge_by_itself_is_where_it_looks_to_be(grey):
    _, stripe = looks(grey)
    assert not stripe.any()
    off, doubt = stripes.displacement(stripe, stripes.BLUR)
    assert off == 0.0 and doubt == 0.0


@pytest.mark.parametrize('blur', [1.0, 1.4, 2.0])
def test_a_step_is_as_wide_as_its_blur(blur):
    assert looks(norm.cdf(ROWS / np.sqrt(blur**2 - 1.0 / 3.0)))[0] == pytest.approx(blur, rel=0.05)


@pytest.mark.parametrize('grey', [0.0, -1.0])
def test_what_does_not_rise_has_no_width(grey):
    width, stripe = looks(grey * norm.cdf(ROWS / BEFORE))
    assert width == stripes.FLAT and not stripe.any()


def test_the_blur_is_that_of_the_sharpest_steps():
    widths, beside = np.array([1.0] * 4 + [3.0] * 6 + [0.1] * 9), np.zeros((19, 2, 2))
    beside[10:, 1] = 3.0, 1.0  # a stripe's edges do not count
    blur = 1.0
    for _ in range(40):
        blur = stripes.blur_of(widths, beside, blur)
    assert blur == pytest.approx(1.0, rel=1e-3)
    assert stripes.blur_of(widths[:stripes.STEPS - 1], beside[:stripes.STEPS - 1], 2.5) == 2.5  # too few


def test_the_first_blur_is_taken_as_it_is_and_no_edges_have_none():
    widths, beside = np.array([1.1, 1.1, 1.1] + [stripes.FLAT] * 12), np.zeros((15, 2, 2))
    assert stripes.blur_of(widths, beside, None) is None
    widths[3:5] = 1.1
    assert stripes.blur_of(widths, beside, None) == pytest.approx(1.1)


def test_without_segments_nothing_moves():
    off, doubt = stripes.displacement(np.empty((0, 2, 2)), stripes.BLUR)
    assert off.shape == doubt.shape == (0,)
    assert stripes.blur_of(np.empty(0), np.empty((0, 2, 2)), 1.7) == 1.7
