"""Whatever is wrong with a bag: replay says what to do, goes on if it can, fails only if it could do nothing."""
from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path

import bag_samples as bags
import message_samples as samples
import numpy as np
import pytest
from bag_samples import IDENTITY, IMAGE, IMU, INFO, Stamped, line_slam, still_scene

from line_slam_ros.cli import replaying
from msg_adapters.factories import MessageFactory


@pytest.fixture
def new() -> MessageFactory:
    return samples.bag_factory()


def replay(bag: Path, *options: object) -> tuple[int, str, dict]:
    """Exit code, standard error and metrics ({} if none were written) of a replay."""
    output = bag.parent / 'output'
    code, _, err = line_slam('replay', bag, '--output', output, '--no-figure', *options)
    metrics = output / 'metrics.json'
    return code, err, json.loads(metrics.read_text()) if metrics.exists() else {}


def refused(bag: Path, *options: object) -> str:
    """Standard error of a replay that could not even begin: one line, exit code 2."""
    code, err, metrics = replay(bag, *options)
    assert (code, metrics) == (2, {})
    assert err.startswith('line_slam replay: ') and err.count('\n') == 1
    return err


def without(topic: str) -> Callable[[Iterable[Stamped]], list[Stamped]]:
    return lambda scene: [s for s in scene if s.topic != topic]


# What makes a run impossible: exit code 2, one line.

def test_no_camera_info_and_no_calibration(tmp_path, new):
    bag = bags.write(tmp_path / 'bag', without(INFO)(still_scene(new)))
    assert 'give a Kalibr camchain-imucam.yaml with --calibration' in refused(bag, '--set', IDENTITY)


def test_no_extrinsics(tmp_path, new):
    bag = bags.write(tmp_path / 'bag', still_scene(new))
    assert 'where the camera sits on the body is unknown; give a Kalibr' in refused(bag)


@pytest.mark.parametrize(('changes', 'says'), [
    ({'k': (0.0,) * 9}, 'the camera is not calibrated; run a camera calibration'),
    ({'model': 'mirror_ball'}, "unknown distortion model 'mirror_ball'; use plumb_bob")])
def test_unusable_camera_info(tmp_path, new, changes, says):
    info = samples.camera_info(new, size=bags.SIZE, **changes)
    scene = [s._replace(message=info) if s.topic == INFO else s for s in still_scene(new)]
    assert says in refused(bags.write(tmp_path / 'bag', scene), '--set', IDENTITY)


@pytest.mark.parametrize(('missing', 'says'), [
    (IMAGE, 'no topic of type sensor_msgs/msg/Image or sensor_msgs/msg/CompressedImage; it has /camera/camera_info'),
    (IMU, 'no topic of type sensor_msgs/msg/Imu; it has /camera/camera_info')])
def test_a_bag_without_the_topics(tmp_path, new, missing, says):
    assert says in refused(bags.write(tmp_path / 'bag', without(missing)(still_scene(new))), '--set', IDENTITY)


def test_a_named_topic_that_is_not_there(tmp_path, new):
    err = refused(bags.write(tmp_path / 'bag', still_scene(new)), '--image-topic', '/left', '--set', IDENTITY)
    assert '--image-topic /left: the bag has no such topic' in err and IMAGE in err


def test_poses_wanted_but_not_there(tmp_path, new):
    bag = bags.write(tmp_path / 'bag', still_scene(new))
    assert 'no topic of type nav_msgs/msg/Odometry or' in refused(bag, '--set', IDENTITY, '--set', 'pose_source=topic')


@pytest.mark.parametrize(('name', 'content', 'says'), [
    ('x.mcap', b'', 'is not a readable bag'), ('x.mcap', b'no bag at all', 'is not a readable bag'),
    ('x.bag', b'no bag at all', 'is not a readable bag'), ('x.txt', b'no bag at all', 'is not a readable bag'),
    ('x.mcap', None, 'does not exist')])
def test_not_a_bag(tmp_path, name, content, says):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert says in refused(tmp_path / name)


def test_an_empty_directory_is_not_a_bag(tmp_path):
    (tmp_path / 'bag').mkdir()
    assert 'holds neither metadata.yaml nor .mcap or .db3 files' in refused(tmp_path / 'bag')


@pytest.mark.parametrize(('content', 'says'), [
    ('estimator: {windw: 3}', "did you mean 'estimator.window'"), ('a: [', 'not readable as YAML'),
    (None, 'No such file')])
def test_unreadable_config(tmp_path, content, says):
    config = tmp_path / 'config.yaml'
    if content is not None:
        config.write_text(content)
    assert says in refused(tmp_path / 'bag', '--config', config)


def test_unreadable_calibration(tmp_path, new):
    bag = bags.write(tmp_path / 'bag', still_scene(new))
    (tmp_path / 'c.yaml').write_text('cam0: {intrinsics: [1, 2]}')
    assert 'c.yaml: cam0.camera_model is missing' in refused(bag, '--calibration', tmp_path / 'c.yaml')


def test_a_calibration_of_another_camera_is_told(tmp_path):
    bag = bags.office_excerpt(tmp_path / 'bag', 3.0, 0.2)
    other = (bag / 'calibration.yaml').read_text().replace('457.91', '600.0')
    (tmp_path / 'other.yaml').write_text(other)
    _, err, _ = replay(bag, '--calibration', tmp_path / 'other.yaml')
    assert 'using the file; check that it belongs to this camera' in err
    assert 'check that it belongs' not in replay(bag)[1]


# What is wrong with single messages: dropped, counted, told; the rest goes on.

def strange_encoding(new, scene):
    for s in scene:
        if s.topic == IMAGE:
            s.message.encoding = 'bayer_grbg16'


def truncated_image(new, scene):
    pictures = [s.message for s in scene if s.topic == IMAGE]
    pictures[1].data = pictures[1].data[:100]


def image_of_another_size(new, scene):
    pictures = [s.message for s in scene if s.topic == IMAGE]
    pictures[1].height //= 2


def repeated_image_stamp(new, scene):
    pictures = [s.message for s in scene if s.topic == IMAGE]
    pictures[2].header.stamp = pictures[1].header.stamp


def decreasing_imu_stamp(new, scene):
    readings = [s.message for s in scene if s.topic == IMU]
    readings[20].header.stamp = readings[15].header.stamp


def nan_in_imu(new, scene):
    readings = [s.message for s in scene if s.topic == IMU]
    readings[20].linear_acceleration.y = float('nan')


def gap_in_imu(new, scene):
    missing = [s for s in scene if s.topic == IMU][40:60]
    for s in missing:
        scene.remove(s)


def imu_in_g(new, scene):
    for s in scene:
        if s.topic == IMU:
            s.message.linear_acceleration.z /= 9.81


def no_imu_data_at_the_time_of_images(new, scene):
    for s in [s for s in scene if s.topic == IMU and s.t_ns > bags.START_NS + 10_000_000]:
        scene.remove(s)


@pytest.mark.parametrize(('spoil', 'drops', 'says', 'frames'), [
    (strange_encoding, {'image not usable': 22}, "'bayer_grbg16' is not supported; publish mono8", 0),
    (truncated_image, {'image not usable': 1}, 'image data is truncated: 100 bytes', 21),
    (image_of_another_size, {'image size differs from the calibration': 1}, 'image is 320x120, the', 21),
    (repeated_image_stamp, {'image stamp not increasing': 1}, 'image stamps must increase', 21),
    (decreasing_imu_stamp, {'IMU stamp not increasing': 1}, 'IMU stamps must increase', 22),
    (nan_in_imu, {'IMU not finite': 1}, 'IMU sample holds NaN', 22),
    (gap_in_imu, {'IMU gap': 1}, 'IMU data missing for 0.105 s', 22),
    (imu_in_g, {}, 'fix the driver or set accel_scale: 9.80665', 22),
    (no_imu_data_at_the_time_of_images, {'image without IMU': 22}, 'its IMU messages end', 0)])
def test_bad_messages_are_counted_and_told(tmp_path, new, spoil, drops, says, frames):
    scene = still_scene(new, 1.1)
    spoil(new, scene)
    code, err, metrics = replay(bags.write(tmp_path / 'bag', scene), '--set', IDENTITY)
    assert says in err and any(says in note for note in metrics['notes'])
    assert (metrics['drops'], metrics['frames']) == (drops, frames)
    assert code == (0 if metrics['estimates'] else 1)
    if frames == 0:
        assert 'no pose was estimated' in err


def test_a_frame_that_the_slam_refuses_does_not_end_the_run(tmp_path, new, monkeypatch):
    process, calls = replaying.Slam.process, []

    def refusing(self, frame, imu):
        calls.append(frame.t_ns)
        if len(calls) == 5:
            raise ValueError('this frame is not to my taste')
        return process(self, frame, imu)

    monkeypatch.setattr(replaying.Slam, 'process', refusing)
    _, err, metrics = replay(bags.write(tmp_path / 'bag', still_scene(new)), '--set', IDENTITY)
    assert 'not to my taste' in err
    assert metrics['drops'] == {'image not usable': 1} and metrics['frames'] == 9 and len(calls) == 10


def test_a_truncated_mcap_is_used_up_to_the_break(tmp_path, new):
    bag = bags.write(tmp_path / 'bag', still_scene(new, 1.0))
    whole = bags.mcap_of(bag).read_bytes()
    file = tmp_path / 'cut.mcap'
    file.write_bytes(whole[: len(whole) * 2 // 3])
    _, err, metrics = replay(file, '--set', IDENTITY)
    assert 'cut.mcap is truncated: using the' in err
    assert 5 < metrics['frames'] < 20


def test_a_file_without_metadata_is_read(tmp_path, new):
    bag = bags.write(tmp_path / 'bag', still_scene(new))
    (bag / 'metadata.yaml').unlink()
    for path in (bag, bags.mcap_of(bag)):
        assert replay(path, '--set', IDENTITY)[2]['frames'] == 10


def test_an_undecodable_message_is_left_out(tmp_path, new):
    from line_slam_ros.cli.bag_writer import BagWriter
    with BagWriter(tmp_path / 'bag') as writer:
        for i, (_, topic, message) in enumerate(still_scene(new)):
            writer.write(topic, i, message)
            if i == 50:
                writer.write_serialised(IMAGE, i, message_type(IMAGE), b'\0\1\0\0 too short')
    _, _, metrics = replay(tmp_path / 'bag', '--set', IDENTITY)
    assert metrics['drops'] == {f'{IMAGE} not decodable': 1} and metrics['frames'] == 10


def message_type(topic: str) -> str:
    return {IMAGE: 'sensor_msgs/msg/Image'}[topic]


def test_a_run_with_many_faults_still_gives_a_trajectory(tmp_path):
    """The shipped recording with a repeated image, NaN, a lost IMU sample and a broken image now and then."""
    count = 0

    def spoil(s: Stamped) -> Iterable[Stamped]:
        nonlocal count
        count += 1
        if s.topic.endswith('compressed'):
            if count % 9 == 0:
                s.message.data = s.message.data[:500]
            yield s
            yield s
        elif not (s.topic == '/imu0' and count % 50 == 0):
            if s.topic == '/imu0' and count % 77 == 0:
                s.message.angular_velocity.x = float('nan')
            yield s

    bag = bags.office_excerpt(tmp_path / 'bag', 3.0, 3.0, spoil)
    code, err, metrics = replay(bag)
    assert code == 0, err
    assert metrics['estimates'] > 10
    assert {'image not usable', 'image stamp not increasing', 'IMU not finite'} <= metrics['drops'].keys()
    poses = np.loadtxt(tmp_path / 'output' / 'trajectory.tum')
    assert len(poses) == metrics['estimates'] and np.isfinite(poses).all()
