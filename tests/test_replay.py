"""Replay end to end: the same bytes twice, every kind of bag, both modes, and results that others can read."""
from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import bag_samples as bags
import cv2
import message_samples as samples
import numpy as np
import pytest
from bag_samples import IDENTITY, IMAGE, IMU, START_NS, Stamped, line_slam, still_scene

from line_slam_ros.cli import replaying
from line_slam_ros.cli.bag_reader import open_bag
from line_slam_ros.cli.bag_topics import choose_topics
from line_slam_ros.config import Config
from line_slam_ros.mapping.io import read_csv

NAMED = {'image': '', 'imu': '', 'pose': '', 'camera_info': ''}


@pytest.fixture(scope='module')
def excerpt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """3 s of the shipped recording, in motion; the calibration lies in the bag directory."""
    return bags.office_excerpt(tmp_path_factory.mktemp('excerpt') / 'bag', 3.0, 3.0)


@pytest.fixture(scope='module')
def output(excerpt: Path) -> Path:
    directory = excerpt.parent / 'first'
    code, out, err = line_slam('replay', excerpt, '--output', directory)
    assert code == 0, err
    assert '60 frames' in out and f'written to {directory}/' in out
    return directory


def test_two_runs_give_the_same_bytes(excerpt, output):
    again = excerpt.parent / 'again'
    assert line_slam('replay', excerpt, '--output', again)[0] == 0
    for name in ('trajectory.tum', 'lines.csv', 'lines.ply', 'output.mcap'):
        assert (again / name).read_bytes() == (output / name).read_bytes(), name


def test_trajectory_has_the_stamps_of_the_images(excerpt, output):
    with open_bag(excerpt) as bag:
        stamps = {f'{m.header.stamp.sec}.{m.header.stamp.nanosec:09d}'
                  for _, m in bag.messages(('/cam0/image_raw/compressed',))}
    lines = (output / 'trajectory.tum').read_text().splitlines()
    assert len(lines) > 20 and {line.split()[0] for line in lines} <= stamps
    poses = np.loadtxt(lines)
    assert (np.diff(poses[:, 0]) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(poses[:, 4:], axis=1), 1.0, atol=1e-8)  # nine decimals


def test_metrics(output):
    metrics = json.loads((output / 'metrics.json').read_text())
    assert metrics['frames'] == 60
    assert metrics['estimates'] == len((output / 'trajectory.tum').read_text().splitlines())
    assert metrics['lines'] == len(read_csv(output / 'lines.csv'))
    rig = metrics['rig']
    assert rig.keys() == {'rotation_deg', 'shift_m', 'delay_s'} and 0.0 < rig['rotation_deg'] < 0.5
    assert [change['status'] for change in metrics['status_changes']][:2] == ['initialising', 'tracking']
    total = metrics['stages_ms']['total']
    assert 0 < total['p50'] <= total['p95'] <= total['max'] and total['count'] == 60
    assert metrics['settings']['estimator.window'] == Config().estimator.window
    assert metrics['settings']['odom_frame'] == 'odom'


def test_the_recording_holds_what_the_node_publishes(output):
    with open_bag(output / 'output.mcap') as bag:
        assert bag.types == {
            '/tf': 'tf2_msgs/msg/TFMessage', '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
            '/line_slam/odometry': 'nav_msgs/msg/Odometry', '/line_slam/path': 'nav_msgs/msg/Path',
            '/line_slam/pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
            '/line_slam/lines': 'visualization_msgs/msg/Marker', '/line_slam/points': 'sensor_msgs/msg/PointCloud2'}
        poses = np.loadtxt(output / 'trajectory.tum')
        assert bag.counts['/line_slam/odometry'] == bag.counts['/tf'] == len(poses)
        markers = [m for _, m in bag.messages(('/line_slam/lines',))]
        lines = read_csv(output / 'lines.csv')
        last = [m for m in markers if m.ns == 'map'][-1]
        assert {m.ns for m in markers} == {'map', 'active'} and len(last.points) == 2 * len(lines)
        first = next(iter(bag.messages(('/line_slam/odometry',))))[1]
        np.testing.assert_allclose(first.pose.pose.position.x, poses[0, 1], atol=1e-9)  # nine decimals in the file
        assert first.twist.covariance[35] > 0.0


def test_figure_shows_three_panels_with_content(output):
    figure = cv2.imread(str(output / 'figure.png'))
    assert figure.shape == (600, 1800, 3)
    assert all(panel.std() > 10 for panel in np.split(figure, 3, axis=1))


def test_an_interrupted_run_keeps_what_it_has(excerpt, monkeypatch):
    feed, fed = replaying.Run.feed, Counter()

    def interrupted(self, topic, message):
        fed['messages'] += 1
        if fed['messages'] == 400:
            raise KeyboardInterrupt
        feed(self, topic, message)

    monkeypatch.setattr(replaying.Run, 'feed', interrupted)
    assert line_slam('replay', excerpt, '--output', excerpt.parent / 'cut', '--no-figure')[0] == 130
    metrics = json.loads((excerpt.parent / 'cut' / 'metrics.json').read_text())
    assert 30 < metrics['frames'] < 40
    with open_bag(excerpt.parent / 'cut' / 'output.mcap') as bag:
        assert bag.counts['/line_slam/odometry'] == metrics['estimates']


def test_poses_from_a_topic(excerpt):
    directory = excerpt.parent / 'mapped'
    code, _, err = line_slam('replay', excerpt, '--output', directory, '--no-figure', '--set', 'pose_source=topic')
    assert code == 0, err
    poses = np.loadtxt(directory / 'trajectory.tum')
    truth = np.loadtxt(bags.OFFICE / 'groundtruth.tum')
    near = np.abs(truth[:, None, 0] - poses[None, :, 0]).argmin(axis=0)
    np.testing.assert_allclose(poses[:, 1:4], truth[near, 1:4], atol=5e-3)  # up to 2.5 ms apart, below 1 m/s
    assert len(read_csv(directory / 'lines.csv')) >= 8


def test_time_jumping_back_resets_and_goes_on(tmp_path):
    new = samples.bag_factory()
    later = [shifted(s, 10_000_000_000) for s in still_scene(new, 0.6)]
    bag = bags.write(tmp_path / 'bag', [*later, *still_scene(new, 0.6)])
    _, _, err = line_slam('replay', bag, '--output', tmp_path / 'out', '--no-figure', '--set', IDENTITY)
    metrics = json.loads((tmp_path / 'out' / 'metrics.json').read_text())
    assert 'time jumped back by 10' in err
    assert metrics['resets'] == 1 and metrics['frames'] == 24


def shifted(stamped: Stamped, by_ns: int) -> Stamped:
    stamp = stamped.message.header.stamp
    stamp.sec, stamp.nanosec = divmod(stamped.t_ns + by_ns, 1_000_000_000)
    return stamped._replace(t_ns=stamped.t_ns + by_ns)


def test_ros1_bags_are_read(tmp_path):
    """Through rosbags' own ROS 1 writer: field names of CameraInfo are capitals there."""
    rosbag1 = pytest.importorskip('rosbags.rosbag1')
    stores = pytest.importorskip('rosbags.typesys')
    typestore = stores.get_typestore(stores.Stores.ROS1_NOETIC)
    connections = {}
    with rosbag1.Writer(tmp_path / 'x.bag') as writer:
        for t_ns, topic, message in still_scene(samples.bag_factory()):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=typestore)
            old = as_ros1(typestore, message)
            writer.write(connections[topic], t_ns, typestore.serialize_ros1(old, message.__msgtype__))
    line_slam('replay', tmp_path / 'x.bag', '--output', tmp_path / 'out', '--no-figure', '--set', IDENTITY)
    assert json.loads((tmp_path / 'out' / 'metrics.json').read_text())['frames'] == 10


def as_ros1(typestore, message):
    """The message as a ROS 1 class: its header has a counter, CameraInfo has capital matrices."""
    fields = {}
    kind = typestore.types[message.__msgtype__]
    for name in (n for n in kind.__dataclass_fields__ if not n.startswith('__')):
        if name == 'header':
            header = message.header
            fields[name] = typestore.types['std_msgs/msg/Header'](seq=0, stamp=header.stamp, frame_id=header.frame_id)
        elif hasattr(kind, '__dataclass_fields__') and name in ('D', 'K', 'R', 'P'):
            fields[name] = getattr(message, name.lower())
        elif hasattr(message, name):
            fields[name] = getattr(message, name)
    return kind(**fields)


def test_image_sizes_and_imu_before_the_first_image_are_no_problem(tmp_path):
    new = samples.bag_factory()
    scene = [s for s in still_scene(new, 1.0) if s.topic != IMAGE or s.t_ns > START_NS + 500_000_000]
    bag = bags.write(tmp_path / 'bag', scene)
    line_slam('replay', bag, '--output', tmp_path / 'out', '--no-figure', '--set', IDENTITY)
    metrics = json.loads((tmp_path / 'out' / 'metrics.json').read_text())
    assert (metrics['frames'], metrics['drops']) == (10, {})


@pytest.mark.parametrize(('types', 'named', 'expected', 'notes'), [
    ({'/a': 'sensor_msgs/msg/Image', '/i': 'sensor_msgs/msg/Imu'}, {}, ('/a', '/i', '', False), 0),
    ({'/a': 'sensor_msgs/msg/Image', '/a/compressed': 'sensor_msgs/msg/CompressedImage', '/i': 'sensor_msgs/msg/Imu'},
     {}, ('/a', '/i', '', False), 1),
    ({'/r/image': 'sensor_msgs/msg/Image', '/l/image': 'sensor_msgs/msg/Image', '/i': 'sensor_msgs/msg/Imu',
      '/l/camera_info': 'sensor_msgs/msg/CameraInfo', '/r/camera_info': 'sensor_msgs/msg/CameraInfo'},
     {'image': '/r/image'}, ('/r/image', '/i', '/r/camera_info', False), 0),
    ({'/c/compressed': 'sensor_msgs/msg/CompressedImage', '/i': 'sensor_msgs/msg/Imu', '/j': 'sensor_msgs/msg/Imu'},
     {'imu': '/j'}, ('/c/compressed', '/j', '', True), 0)])
def test_topics_are_chosen_by_type(types, named, expected, notes):
    topics = choose_topics(types, NAMED | named, 'auto', 'imu')
    assert (topics.image, topics.motion, topics.camera_info, topics.compressed) == expected
    assert len(topics.notes) == notes


def test_image_transport_chooses_between_raw_and_compressed():
    types = {'/a': 'sensor_msgs/msg/Image', '/a/compressed': 'sensor_msgs/msg/CompressedImage',
             IMU: 'sensor_msgs/msg/Imu'}
    assert choose_topics(types, NAMED, 'compressed', 'imu').image == '/a/compressed'
    assert choose_topics(types, NAMED, 'raw', 'imu').image == '/a'


def test_help_is_quick_to_load():
    """--help of a command imports nothing heavy."""
    import subprocess
    import sys
    code = ('import sys; from line_slam_ros.cli.main import main\n'
            'try: main(["replay", "--help"])\nexcept SystemExit: pass\n'
            'sys.exit(bool({"numpy", "cv2", "numba", "rosbags", "rclpy"} & set(sys.modules)))')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert '--calibration' in done.stdout
