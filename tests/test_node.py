"""The live node over DDS, mapping lines along given poses of the shipped recording."""
from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')
from ros_harness import LATCHED, LOSSLESS, OFFICE_ARGS, START_S, Peer, Process, slam_node

from line_slam_ros.mapping.io import read_csv
from msg_adapters.sensors import pose_from_msg, stamp_ns

TOPICS = {'odometry': 'nav_msgs/msg/Odometry', 'pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
          'path': 'nav_msgs/msg/Path', 'points': 'sensor_msgs/msg/PointCloud2', 'image_lines': 'sensor_msgs/msg/Image'}
POSES_GIVEN = (*OFFICE_ARGS, *LOSSLESS, '-p', 'pose_source:=topic', '-p', 'node.path_rate:=10.0')
SECONDS = 8.0


@pytest.fixture(scope='module')
def peer() -> Iterator[Peer]:
    import rclpy
    rclpy.init()
    peer = Peer()
    for name, kind in TOPICS.items():
        peer.hear(f'/line_slam/{name}', kind, 100)
    peer.hear('/line_slam/lines', 'visualization_msgs/msg/Marker', LATCHED)
    yield peer
    peer.close()
    rclpy.try_shutdown()


@pytest.fixture(scope='module')
def node(peer: Peer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    """The node after it has heard some seconds of the recording."""
    folder = tmp_path_factory.mktemp('node')
    with slam_node(folder / 'log', *POSES_GIVEN, '-p', f'node.map_path:={folder / "map"}') as process:
        peer.play_office(SECONDS)
        assert peer.diagnosed('frames waiting = 0', 60.0), process.text
        yield process


def map_lines(peer: Peer) -> int:
    return max((len(m.points) // 2 for m in peer.heard['/line_slam/lines'] if m.ns == 'map'), default=0)


@pytest.mark.parametrize('name', TOPICS)
def test_every_topic_arrives_with_sensor_stamps_in_the_world_frame(node: Process, peer: Peer, name: str) -> None:
    messages = peer.heard[f'/line_slam/{name}']
    assert messages, node.text
    stamps = [stamp_ns(m) for m in messages]
    assert stamps == sorted(stamps) and 0 <= stamps[0] - 1_701_010_000_000_000_000 <= SECONDS * 1e9
    if name != 'image_lines':
        assert {m.header.frame_id for m in messages} == {'odom'}


def test_given_poses_come_back_at_image_time(node: Process, peer: Peer) -> None:
    truth = np.loadtxt(Path(__file__).parents[1] / 'bags' / 'office' / 'groundtruth.tum')
    poses = [pose_from_msg(m) for m in peer.heard['/line_slam/odometry']]
    assert len(poses) > 0.9 * 20 * SECONDS, node.text + peer.last_diagnosis()
    for t_ns, T_WB in poses:
        expected = [np.interp(t_ns * 1e-9, truth[:, 0], truth[:, k]) for k in (1, 2, 3)]
        np.testing.assert_allclose(T_WB[:3, 3], expected, atol=2e-3)


def test_map_and_active_lines_are_told_apart(node: Process, peer: Peer) -> None:
    markers = peer.heard['/line_slam/lines']
    assert {m.ns for m in markers} == {'map', 'active'} and map_lines(peer) > 0, node.text
    colours = {m.ns: (m.color.r, m.color.g, m.color.b) for m in markers}
    assert colours['map'] != colours['active']


def test_path_leads_along_the_odometry(node: Process, peer: Peer) -> None:
    path = peer.heard['/line_slam/path'][-1]
    assert len(path.poses) > 10
    assert stamp_ns(path.poses[0]) == stamp_ns(peer.heard['/line_slam/odometry'][0])


def test_diagnostics_tell_status_rates_and_latency(node: Process, peer: Peer) -> None:
    texts = '\n'.join(str([(v.key, v.value) for v in a.status[0].values]) for a in peer.heard['/diagnostics'])
    for key in ('image', 'pose', 'frames processed', 'executor CPU', 'latency total', 'latency publish'):
        assert f"('{key}'" in texts


def test_late_joiner_gets_the_whole_map(node: Process, peer: Peer) -> None:
    late = Peer('late')
    late.hear('/line_slam/lines', 'visualization_msgs/msg/Marker', LATCHED)
    assert late.spin_until(lambda: {m.ns for m in late.heard['/line_slam/lines']} >= {'map', 'active'}, 10.0)
    newest = [m for m in late.heard['/line_slam/lines'] if m.ns == 'map'][-1]
    assert newest.points and peer.spin_until(lambda: map_lines_now(peer) == len(newest.points) // 2, 10.0)
    late.close()


def test_map_is_saved_and_then_reset(node: Process, peer: Peer, tmp_path_factory: pytest.TempPathFactory) -> None:
    reply = peer.call('/line_slam/save_map')
    assert reply.success, reply.message
    csv = Path(reply.message.split(' and ')[-1])
    assert len(read_csv(csv)) == map_lines_now(peer) and csv.with_suffix('.ply').stat().st_size > 100

    assert peer.call('/line_slam/reset').success
    assert peer.spin_until(lambda: map_lines_now(peer) == 0, 10.0)
    assert 'reset' in node.text


def map_lines_now(peer: Peer) -> int:
    return len([m for m in peer.heard['/line_slam/lines'] if m.ns == 'map'][-1].points) // 2


def test_saving_where_nobody_can_write_is_refused_with_a_reason(node: Process, peer: Peer) -> None:
    from rclpy.parameter import Parameter
    from rclpy.parameter_client import AsyncParameterClient
    client = AsyncParameterClient(peer.node, '/line_slam')
    for path, reason in (('/proc/nowhere/map', '/proc/nowhere/map'), ('~nosuchuser/map', 'home')):
        future = client.set_parameters([Parameter('node.map_path', value=path)])
        assert peer.spin_until(future.done, 10.0) and future.result().results[0].successful
        reply = peer.call('/line_slam/save_map')
        assert not reply.success and reason in reply.message


@pytest.mark.parametrize('when', ['loading compiled code', 'ready for data'])
@pytest.mark.parametrize('how', [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_node_with_success(how: int, when: str, peer: Peer, tmp_path: Path) -> None:
    with slam_node(tmp_path / 'log', *OFFICE_ARGS, '-r', '__node:=ending') as process:
        assert peer.spin_until(lambda: when in process.text, START_S)
        assert process.stop(how) == 0, process.text
    assert 'Traceback' not in process.text
