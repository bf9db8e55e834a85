"""Camera models against OpenCV's, against their own inverse, and where they have none."""
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from line_slam_ros.geometry.camera import Camera
from line_slam_ros.types import Calibration

repeatable = settings(deadline=None, derandomize=True)
EUROC = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
K = (458.654, 457.296, 367.215, 248.375)
LENSES = {
    'no distortion': ('radtan', ()),
    'euroc': ('radtan', EUROC),
    'k3': ('radtan', (*EUROC, 0.005)),
    'rational': ('radtan', (0.42, 0.11, 1e-3, -8e-4, 0.02, 0.75, 0.3, 0.05)),
    'pincushion': ('radtan', (0.15, 0.02, -1e-3, 5e-4)),
    'folding': ('radtan', (-0.5, 0.0, 1e-3, -1e-3)),
    'fisheye': ('equidistant', (-0.013, 0.021, -0.012, 0.0022)),
    'ideal fisheye': ('equidistant', (0.0, 0.0, 0.0, 0.0)),
}


def camera(lens='euroc', intrinsics=K, size=(752, 480)):
    model, distortion = LENSES[lens]
    return Camera(Calibration(model, *size, intrinsics, distortion, np.eye(4)))


def matrix(fx, fy, cx, cy):
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def opencv_project(lens, x):
    """The same points through OpenCV."""
    model, distortion = LENSES[lens]
    if model == 'equidistant':
        return cv2.fisheye.distortPoints(x[:, None], matrix(*K), np.array(distortion))[:, 0]
    p = np.column_stack([x, np.ones(len(x))])
    return cv2.projectPoints(p, np.zeros(3), np.zeros(3), matrix(*K), np.array(distortion or (0.0,) * 4))[0][:, 0]


def grid(size=(752, 480), count=31):
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, count), np.linspace(0, size[1] - 1, count))
    return np.column_stack([u.ravel(), v.ravel()])


@pytest.mark.parametrize('lens', LENSES)
def test_projection_agrees_with_opencv(lens):
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2))
    np.testing.assert_allclose(camera(lens).project(x), opencv_project(lens, x), atol=1e-9)


@pytest.mark.parametrize('lens', LENSES)
def test_normalise_is_the_exact_inverse_over_the_whole_image(lens):
    cam, uv = camera(lens), grid()
    x = cam.normalise(uv)
    exists = np.isfinite(x).all(axis=1)
    assert exists.all() or lens == 'folding'
    np.testing.assert_allclose(cam.project(x)[exists], uv[exists], atol=1e-9)


@repeatable
@given(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3),
                 st.floats(-0.05, 0.05)))
def test_inverse_is_exact_or_nan_for_any_radtan_lens(distortion):
    cam = Camera(Calibration('radtan', 752, 480, K, distortion, np.eye(4)))
    uv = grid(count=7)
    x = cam.normalise(uv)
    exists = np.isfinite(x).all(axis=1)
    assert exists.sum() > 20  # the middle of the image, at least
    np.testing.assert_allclose(cam.project(x)[exists], uv[exists], atol=1e-8)


def test_pixels_beyond_the_fold_of_the_distortion_are_nan_and_those_within_are_not():
    cam = camera('folding')  # r (1 - r^2 / 2) grows up to r = sqrt(2/3), where it is 0.544: 250 px
    radius = np.linalg.norm(grid() - K[2:], axis=1)
    exists = np.isfinite(cam.normalise(grid())).all(axis=1)
    assert exists[radius < 240].all()
    assert not exists[radius > 260].any()
    assert np.isfinite(cam.project(np.array([[0.8, 0.0]]))).all()
    assert np.isnan(cam.project(np.array([[0.83, 0.0], [5.0, 5.0]]))).all()


@pytest.mark.parametrize('k4', [0.5, -0.5])  # r / (1 + r^2 / 2) folds, r / (1 - r^2 / 2) has its pole, at sqrt(2)
def test_rational_lens_ends_at_the_fold_or_pole_of_its_fraction(k4):
    cam = Camera(Calibration('radtan', 752, 480, K, (0.0, 0.0, 0.0, 0.0, 0.0, k4, 0.0, 0.0), np.eye(4)))
    assert np.isfinite(cam.project(np.array([[1.41, 0.0]]))).all()
    assert np.isnan(cam.project(np.array([[1.42, 0.0], [-2.0, 3.0]]))).all()


def test_fisheye_has_no_inverse_at_ninety_degrees_and_beyond():
    cam = camera('ideal fisheye')
    ninety = K[2] + K[0] * np.pi / 2
    assert np.isfinite(cam.normalise(np.array([[ninety - 1.0, K[3]]]))).all()
    assert np.isnan(cam.normalise(np.array([[ninety + 1.0, K[3]]]))).all()


@pytest.mark.parametrize('lens', LENSES)
@pytest.mark.parametrize('bad', [(np.nan, 1.0), (1.0, np.nan), (np.inf, 1.0), (-np.inf, np.inf), (1e300, -1e300)])
def test_not_a_number_and_infinity_come_back_as_such_and_leave_the_others_alone(lens, bad):
    cam, good = camera(lens), (380.0, 260.0)
    x = cam.normalise(np.array([good, bad]))
    np.testing.assert_allclose(x[0], cam.normalise(np.array([good]))[0], rtol=1e-14)
    uv = cam.project(np.array([(0.1, 0.2), bad]))
    np.testing.assert_array_equal(uv[0], cam.project(np.array([(0.1, 0.2)]))[0])
    for result in (x[1], uv[1]):  # a lens without distortion passes 1e300 on
        assert np.isnan(result).any() or np.abs(result).max() > 1e290


@pytest.mark.parametrize('lens', LENSES)
def test_centre_and_no_points_at_all(lens):
    cam = camera(lens)
    np.testing.assert_allclose(cam.normalise(np.array([K[2:]])), 0, atol=1e-15)
    np.testing.assert_allclose(cam.project(np.zeros((1, 2))), [K[2:]])
    assert cam.normalise(np.empty((0, 2))).shape == cam.project(np.empty((0, 2))).shape == (0, 2)


@pytest.mark.parametrize('lens', LENSES)
@pytest.mark.parametrize('scale', [1.0, 0.5])
def test_rectified_image_shows_each_pixel_where_the_pinhole_has_it(lens, scale):
    cam = camera(lens)
    v, u = np.mgrid[:480, :752].astype(np.float32)
    canvas = cam.canvas(scale)
    width, height = canvas.size
    assert width <= 1.26 * 752 * scale and height <= 1.26 * 480 * scale
    assert canvas.fx == pytest.approx(K[0] * scale)
    uv = grid(canvas.size, 9).round()
    seen = cam.project(canvas.normalise(uv))
    inside = ((seen > 1) & (seen < (750, 478))).all(axis=1)
    assert inside.sum() > 20
    for axis, source in enumerate((u, v)):  # an image whose grey value is the coordinate itself
        image = cv2.remap(source, *cam.maps(canvas), cv2.INTER_LINEAR)
        found = image[uv[:, 1].astype(int), uv[:, 0].astype(int)]
        np.testing.assert_allclose(found[inside], seen[inside, axis], atol=0.05)  # remap interpolates in 1/32 px
    np.testing.assert_allclose(canvas.project(canvas.normalise(uv)), uv, atol=1e-10)


def test_rectified_canvas_of_a_mild_lens_keeps_the_whole_field_of_view():
    cam = camera('pincushion')
    canvas = cam.canvas()
    corners = canvas.project(cam.normalise(grid(count=2)))
    assert (corners >= -1).all() and (corners <= np.array(canvas.size) + 1).all()


def test_undistorted_camera_is_its_own_rectification():
    cam = camera('no distortion')
    canvas = cam.canvas()
    assert canvas.size == (752, 480)
    assert (canvas.fx, canvas.fy, canvas.cx, canvas.cy) == pytest.approx(K)
    image = np.random.default_rng(0).integers(0, 256, (480, 752), dtype=np.uint8)
    np.testing.assert_array_equal(cv2.remap(image, *cam.maps(canvas), cv2.INTER_LINEAR), image)


def test_focal_is_the_mean_of_both():
    assert camera().focal == pytest.approx((K[0] + K[1]) / 2)


@pytest.mark.parametrize('change, message', [
    ({'model': 'unified'}, "unknown distortion model 'unified'.*radtan"),
    ({'intrinsics': (0.0, 0.0, 0.0, 0.0)}, 'focal lengths must be positive.*calibrate'),
    ({'intrinsics': (400.0, -400.0, 0.0, 0.0)}, 'focal lengths must be positive'),
    ({'intrinsics': (np.nan, 400.0, 0.0, 0.0)}, 'not finite'),
    ({'distortion': (0.1, 0.2)}, 'radtan takes 0 or 4 or 5 or 8 distortion coefficients, got 2'),
    ({'model': 'equidistant', 'distortion': (0.1,) * 5}, 'equidistant takes 4 distortion coefficients, got 5'),
    ({'width': 0}, 'image size must be positive, got 0 x 480'),
])
def test_unusable_calibrations_say_what_is_wrong(change, message):
    good = {'model': 'radtan', 'width': 752, 'height': 480, 'intrinsics': K, 'distortion': EUROC, 'T_BC': np.eye(4)}
    with pytest.raises(ValueError, match=message):
        Camera(Calibration(**{**good, **change}))
