"""`line_slam play`: a bag over DDS, and with the live node at the other end the whole way from images to files."""
from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

import bag_samples
import numpy as np
import pytest

pytest.importorskip('rclpy')
import message_samples
import rclpy
from ros_harness import (
    LOSSLESS,
    OFFICE_ARGS,
    OFFICE_BAG,
    OFFICE_CALIBRATION,
    START_S,
    Peer,
    Process,
    running,
    slam_node,
)

from line_slam_ros.cli import playing
from line_slam_ros.cli.bag_reader import open_bag
from line_slam_ros.cli.bag_writer import BagWriter
from line_slam_ros.mapping.io import read_csv
from msg_adapters.sensors import stamp_ns

SECONDS = 8.0


def play(log: Path, *arguments: object) -> AbstractContextManager[Process]:
    return running(log, '-m', 'line_slam_ros.cli.main', 'play', *map(str, arguments))


@pytest.fixture(scope='module')
def still_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second: 10 images and camera_infos, 101 inertial samples."""
    directory = tmp_path_factory.mktemp('bag') / 'still'
    with BagWriter(directory) as writer:
        for t_ns, topic, message in bag_samples.still_scene(message_samples.bag_factory()):
            writer.write(topic, t_ns, message)
    return directory


@pytest.fixture
def peer(ros: None) -> Iterator[Peer]:
    peer = Peer()
    yield peer
    peer.close()


def test_messages_arrive_in_order_as_they_were_recorded(peer: Peer, still_bag: Path, tmp_path: Path) -> None:
    kinds = {bag_samples.IMAGE: 'sensor_msgs/msg/Image', bag_samples.IMU: 'sensor_msgs/msg/Imu',
             '/clock': 'rosgraph_msgs/msg/Clock'}
    for topic, kind in kinds.items():
        peer.hear(topic, kind, 500)
    with play(tmp_path / 'log', still_bag, '--clock') as process:
        assert peer.spin_until(lambda: not process.is_running, 60.0)
    peer.spin(0.5)
    assert process.wait() == 0, process.text
    with open_bag(still_bag) as bag:
        recorded = list(bag.messages([bag_samples.IMAGE, bag_samples.IMU]))
    for topic in (bag_samples.IMAGE, bag_samples.IMU):
        expected = [m for t, m in recorded if t == topic]
        heard = peer.heard[topic]
        assert [stamp_ns(m) for m in heard] == [stamp_ns(m) for m in expected]
    assert np.array_equal(peer.heard[bag_samples.IMAGE][3].data, bag_samples.texture().ravel())
    assert peer.heard['/clock'][0].clock.sec == bag_samples.START_NS // 10**9


def test_part_of_a_bag(peer: Peer, tmp_path: Path) -> None:
    peer.hear('/imu0', 'sensor_msgs/msg/Imu', 1000)
    with play(tmp_path / 'log', OFFICE_BAG, '--start', 3.0, '--duration', 0.5, '--rate', 2.0) as process:
        assert peer.spin_until(lambda: not process.is_running, 60.0)
    peer.spin(0.5)
    assert process.wait() == 0, process.text
    first, *_, last = [stamp_ns(m) - 1_701_010_000_000_000_000 for m in peer.heard['/imu0']]
    assert (first, last) == (3_000_000_000, 3_500_000_000)


def test_loop_ends_with_a_signal(peer: Peer, still_bag: Path, tmp_path: Path) -> None:
    peer.hear(bag_samples.IMU, 'sensor_msgs/msg/Imu', 1000)
    with play(tmp_path / 'log', still_bag, '--loop') as process:
        assert peer.spin_until(lambda: len(peer.heard[bag_samples.IMU]) > 250, 60.0), process.text
        assert process.stop(signal.SIGINT) == 130, process.text
    assert 'Traceback' not in process.text


def test_nobody_listens(ros_domain: int, still_bag: Path, tmp_path: Path) -> None:
    with play(tmp_path / 'log', still_bag, '--wait', 0.5) as process:
        assert process.wait() == 1
    assert 'nobody subscribes to ' in process.text and 'start line_slam_node' in process.text


def test_a_player_that_was_held_up_makes_no_burst(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = 100.0
    monkeypatch.setattr(playing.time, 'monotonic', lambda: clock)
    log = [('image', 50_000_000 * k, b'') for k in range(60)]
    dues = []
    for due, _, t_ns, _ in playing.schedule(log, 0.5, 2.0, 2.0):
        dues.append(due)
        clock = max(clock, due) + (3.0 if t_ns == 1_000_000_000 else 0.0)  # held up once, when the first 11 are out
    assert len(dues) == 41
    np.testing.assert_allclose(dues[:11], 100.0 + 0.025 * np.arange(11))
    np.testing.assert_allclose(dues[11:], 103.25 - 0.1 + 0.025 * np.arange(30))


@pytest.mark.parametrize('arguments,complaint', [
    (['/nowhere/bag'], '/nowhere/bag does not exist'),
    ([OFFICE_BAG, '--loop', '--output', 'out'], 'leave one of them out'),
])
def test_unusable_arguments(tmp_path: Path, arguments: list[object], complaint: str) -> None:
    code, _, errors = bag_samples.line_slam('play', *arguments)
    assert code == 2 and complaint in errors


def test_node_that_publishes_no_pose_is_an_error_with_its_reason(ros_domain: int, still_bag: Path,
                                                                 tmp_path: Path) -> None:
    """Nothing moves in this bag, and the node is told to listen for another IMU."""
    names = ('-r', f'image:={bag_samples.IMAGE}', '-r', f'camera_info:={bag_samples.INFO}')
    identity = bag_samples.IDENTITY.replace('=', ':=')
    with (slam_node(tmp_path / 'node', '-p', identity, '-p', 'node.input_timeout:=0.5', *names),
          play(tmp_path / 'log', still_bag, '--rate', 0.2, '--output', tmp_path / 'out') as process):
        assert process.wait(START_S + 60.0) == 1
    assert '/line_slam published no pose: ' in process.text and 'IMU' in process.text


class Live(NamedTuple):
    """A bag, and what `play --output` and the node made of it."""

    bag: Path
    play: str
    node: str
    directory: Path


@pytest.fixture(scope='module')
def live(ros_domain: int, tmp_path_factory: pytest.TempPathFactory) -> Live:
    """The begin of the shipped recording through the live node; however busy the machine, no frame is dropped."""
    folder = tmp_path_factory.mktemp('live')
    bag = office(folder / 'bag')
    with (slam_node(folder / 'node', *OFFICE_ARGS, *LOSSLESS, '-p', 'use_sim_time:=true') as node,
          play(folder / 'play', bag, '--clock', '--output', folder / 'out') as process):
        assert process.wait(START_S + 160.0) == 0, process.text + node.text
        assert node.stop() == 0, node.text
    return Live(bag, process.text, node.text, folder / 'out')


def office(directory: Path) -> Path:
    """The first SECONDS of the shipped recording, message by message as they are."""
    with open_bag(OFFICE_BAG) as whole, BagWriter(directory) as writer:
        first_ns = None
        for topic, t_ns, data in whole.log():
            first_ns = t_ns if first_ns is None else first_ns
            if t_ns - first_ns <= SECONDS * 1e9:
                writer.write_serialised(topic, t_ns, whole.types[topic], data)
    (directory / 'calibration.yaml').write_text(OFFICE_CALIBRATION.read_text())
    return directory


def test_files_are_left_behind(live: Live) -> None:
    names = {path.name for path in live.directory.iterdir()}
    assert names == {'trajectory.tum', 'lines.csv', 'lines.ply', 'output.mcap', 'figure.png'}
    assert len(read_csv(live.directory / 'lines.csv')) > 0
    assert 'poses' in live.play and 'lines written to' in live.play
    assert 'Traceback' not in live.play + live.node


def test_recording_holds_every_output(live: Live) -> None:
    with open_bag(live.directory / 'output.mcap') as bag:
        assert {topic for topic, count in bag.counts.items() if count} == {
            '/diagnostics', *(f'/line_slam/{name}' for name in ('odometry', 'pose', 'path', 'lines', 'points'))}
        odometry = [m for _, m in bag.messages(['/line_slam/odometry'])]
        diagnostics = [m for _, m in bag.messages(['/diagnostics'])]
    trajectory = np.loadtxt(live.directory / 'trajectory.tum')
    assert len(odometry) == len(trajectory)
    covariance = odometry[-1].pose.covariance.reshape(6, 6)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    assert stamp_ns(diagnostics[-1]) == pytest.approx(stamp_ns(odometry[-1]), abs=5e9)  # sim time, not wall time


def test_live_poses_are_those_of_the_offline_replay(live: Live, tmp_path: Path) -> None:
    code, out, errors = bag_samples.line_slam('replay', live.bag, '--output', tmp_path / 'replay')
    assert code == 0, out + errors
    offline, online = (np.loadtxt(d / 'trajectory.tum') for d in (tmp_path / 'replay', live.directory))
    common, i, j = np.intersect1d(offline[:, 0], online[:, 0], return_indices=True)
    assert 0.9 * len(offline) <= len(common) and len(online) > 20, live.node
    assert np.linalg.norm(offline[i, 1:4] - online[j, 1:4], axis=1).mean() < 0.02  # m, as the issue demands


def test_rclpy_is_not_left_running() -> None:
    assert not rclpy.ok()
