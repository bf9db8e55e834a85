"""Every encoding, padding, binning and broken message, for rclpy's messages and for those of bags."""
from __future__ import annotations

import cv2
import message_samples as samples
import numpy as np
import pytest

from msg_adapters import outputs, sensors
from msg_adapters.factories import MessageFactory

HEIGHT, WIDTH = 6, 5
T_NS = 1_500_000_002


@pytest.fixture(params=['bag', 'ros'])
def new(request: pytest.FixtureRequest) -> MessageFactory:
    return samples.factory(request.param)


def colour_pixels(channels: int) -> np.ndarray:
    return np.random.default_rng(channels).integers(0, 256, (HEIGHT, WIDTH, channels), dtype=np.uint8)


def padded(pixels: np.ndarray, padding: int) -> bytes:
    rows = pixels.reshape(HEIGHT, -1)
    return np.hstack([rows, np.full((HEIGHT, padding), 99, np.uint8)]).tobytes()


@pytest.mark.parametrize('padding', [0, 3])
@pytest.mark.parametrize(('encoding', 'weights'), [
    ('mono8', [1.0]), ('8UC1', [1.0]), ('rgb8', [0.299, 0.587, 0.114]), ('bgr8', [0.114, 0.587, 0.299]),
    ('rgba8', [0.299, 0.587, 0.114, 0.0]), ('bgra8', [0.114, 0.587, 0.299, 0.0]),
    ('yuv422', [0.0, 1.0]), ('uyvy', [0.0, 1.0]), ('yuv422_yuy2', [1.0, 0.0]), ('yuyv', [1.0, 0.0])])
def test_every_8_bit_encoding_becomes_grey(new, encoding, weights, padding):
    pixels = colour_pixels(len(weights))
    step = WIDTH * len(weights) + padding
    frame = sensors.image_to_frame(samples.image(new, encoding, HEIGHT, WIDTH, step, padded(pixels, padding), T_NS))
    assert frame.t_ns == T_NS
    assert frame.image.shape == (HEIGHT, WIDTH) and frame.image.dtype == np.uint8
    np.testing.assert_allclose(frame.image, pixels @ np.array(weights), atol=0.51)  # rounding to whole grey levels


@pytest.mark.parametrize('big_endian', [0, 1])
def test_mono16_keeps_the_high_byte(new, big_endian):
    values = np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 2000
    data = values.astype('>u2' if big_endian else '<u2').tobytes()
    message = samples.image(new, 'mono16', HEIGHT, WIDTH, WIDTH * 2, data, is_bigendian=big_endian)
    frame = sensors.image_to_frame(message)
    np.testing.assert_array_equal(frame.image, values >> 8)


def test_mono8_is_a_view_of_a_bag_message():
    new = samples.factory('bag')
    message = samples.image(new, 'mono8', HEIGHT, WIDTH, WIDTH, bytes(HEIGHT * WIDTH))
    assert np.shares_memory(sensors.image_to_frame(message).image, message.data)


def test_padding_missing_after_the_last_row_is_accepted(new):
    pixels = colour_pixels(1)
    data = padded(pixels, 3)[:-3]
    frame = sensors.image_to_frame(samples.image(new, 'mono8', HEIGHT, WIDTH, WIDTH + 3, data))
    np.testing.assert_array_equal(frame.image, pixels[..., 0])


@pytest.mark.parametrize(('encoding', 'step', 'size', 'says'), [
    ('bayer_rggb8', WIDTH, HEIGHT * WIDTH, "'bayer_rggb8' is not supported; publish mono8"),
    ('mono8', WIDTH, HEIGHT * WIDTH - 1, 'truncated: 29 bytes'),
    ('mono8', WIDTH, 0, 'truncated: 0 bytes'),
    ('bgr8', WIDTH, HEIGHT * WIDTH * 3, 'cannot have step 5')])
def test_unusable_images_say_what_to_do(new, encoding, step, size, says):
    with pytest.raises(ValueError, match=says):
        sensors.image_to_frame(samples.image(new, encoding, HEIGHT, WIDTH, step, bytes(size)))


@pytest.mark.parametrize('extension', ['.png', '.jpg'])
def test_compressed_images_are_decoded(new, extension):
    pixels = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8), (0, 0), 3)
    data = cv2.imencode(extension, pixels)[1].tobytes()
    frame = sensors.compressed_to_frame(samples.compressed(new, data, T_NS))
    assert frame.t_ns == T_NS
    np.testing.assert_allclose(frame.image, pixels, atol=0 if extension == '.png' else 6)  # JPEG is lossy


@pytest.mark.parametrize('extension', ['.png', '.jpg'])
def test_truncated_compressed_images_are_refused(new, extension):
    data = cv2.imencode(extension, np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8))[1].tobytes()
    with pytest.raises(ValueError, match='truncated'):
        sensors.compressed_to_frame(samples.compressed(new, data[: len(data) // 2]))


@pytest.mark.parametrize('data', [b'', b'neither jpeg nor png'])
def test_undecodable_compressed_images_are_refused(new, data):
    with pytest.raises(ValueError, match='cannot be decoded; publish JPEG or PNG'):
        sensors.compressed_to_frame(samples.compressed(new, data))


def test_imu_fields(new):
    message = samples.imu(new, T_NS, (0.1, 0.2, 0.3), (1.0, 2.0, 9.8))
    assert sensors.imu_fields(message) == (T_NS, (0.1, 0.2, 0.3), (1.0, 2.0, 9.8))


def test_camera_info_to_calibration(new):
    T_BC = np.eye(4)
    T_BC[:3, 3] = [0.1, 0.2, 0.3]
    calibration = sensors.camera_info_to_calibration(samples.camera_info(new), T_BC, time_offset=0.01)
    assert (calibration.model, calibration.width, calibration.height) == ('radtan', 640, 480)
    assert calibration.intrinsics == (400.0, 410.0, 320.0, 240.0)
    assert calibration.distortion == (-0.3, 0.1, 0.0, 0.0)
    assert calibration.time_offset == 0.01
    np.testing.assert_array_equal(calibration.T_BC, T_BC)


def test_camera_info_binning_and_region_of_interest(new):
    message = samples.camera_info(new, binning=(2, 2), roi=(100, 40, 400, 300))
    calibration = sensors.camera_info_to_calibration(message, np.eye(4))
    assert (calibration.width, calibration.height) == (200, 150)
    assert calibration.intrinsics == (200.0, 205.0, 110.0, 100.0)


@pytest.mark.parametrize(('changes', 'says'), [
    ({'k': (0.0,) * 9}, 'not calibrated; run a camera calibration'),
    ({'model': 'wide'}, "unknown distortion model 'wide'; use plumb_bob"),
    ({'d': (0.1, 0.2)}, '2 distortion coefficients'),
    ({'model': 'equidistant', 'd': (0.1,) * 5}, '5 distortion coefficients'),
    ({'size': (0, 480)}, 'image size is 0x480'),
    ({'d': (float('nan'), 0.0, 0.0, 0.0)}, 'NaN')])
def test_bad_camera_info_says_what_to_do(new, changes, says):
    with pytest.raises(ValueError, match=f"camera_info of 'cam0'.*{says}"):
        sensors.camera_info_to_calibration(samples.camera_info(new, **changes), np.eye(4))


@pytest.mark.parametrize(('model', 'd', 'ours'), [
    ('plumb_bob', (), ('radtan', (0.0,) * 4)), ('', (0.0,) * 5, ('radtan', (0.0,) * 4)),
    ('plumb_bob', (0.1, 0.2, 0.0, 0.0, 0.3), ('radtan', (0.1, 0.2, 0.0, 0.0, 0.3))),
    ('rational_polynomial', (0.1,) * 8 + (0.0,) * 6, ('radtan', (0.1,) * 8)),
    ('fisheye', (0.1,) * 4, ('equidistant', (0.1,) * 4))])
def test_distortion_models_of_ros(new, model, d, ours):
    calibration = sensors.camera_info_to_calibration(samples.camera_info(new, model=model, d=d), np.eye(4))
    assert (calibration.model, calibration.distortion) == ours


def test_poses_of_odometry_and_of_stamped_poses_are_read_alike(new):
    estimate = samples.estimate()
    for message in (outputs.odometry(new, estimate, 'odom', 'imu'), outputs.pose(new, estimate, 'odom'),
                    outputs.pose_stamped(new, estimate.t_ns, estimate.T_WB, 'odom')):
        t_ns, T_WB = sensors.pose_from_msg(message)
        assert t_ns == estimate.t_ns
        np.testing.assert_allclose(T_WB, estimate.T_WB, atol=1e-12)


def test_a_pose_without_orientation_is_refused(new):
    message = outputs.pose_stamped(new, 0, np.eye(4), 'odom')
    message.pose.orientation.w = 0.0
    with pytest.raises(ValueError, match='quaternion'):
        sensors.pose_from_msg(message)


@pytest.mark.parametrize('frame', ['', 'imu', 'imu0', 'imu_link', 'a_frame'])
@pytest.mark.parametrize('little_endian', [True, False])
def test_a_serialised_imu_message_is_read_without_making_it(frame, little_endian):
    from rosbags.typesys import Stores, get_typestore
    new, store = samples.factory('bag'), get_typestore(Stores.ROS2_JAZZY)
    message = outputs.imu(new, 1_234_567_890_987_654_321, np.array([0.1, -0.2, 0.3]), np.array([1.0, 2.0, -9.8]), frame)
    data = bytes(store.serialize_cdr(message, message.__msgtype__, little_endian=little_endian))
    assert sensors.imu_of_cdr(data) == sensors.imu_fields(message)
    for broken in (data[:-4], data[:12], b'', b'\0\3' + data[2:], data + bytes(8)):
        with pytest.raises(ValueError, match='IMU message of'):
            sensors.imu_of_cdr(broken)


def test_an_imu_message_serialised_by_rclpy_is_read_the_same_way():
    new = samples.factory('ros')
    from rclpy.serialization import serialize_message
    message = samples.imu(new, T_NS, (0.1, -0.2, 0.3), (1.0, 2.0, -9.8))
    assert sensors.imu_of_cdr(serialize_message(message)) == sensors.imu_fields(message)
