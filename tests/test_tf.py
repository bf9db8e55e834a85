"""/tf, with a tf2_msgs built on the spot where the installation has none."""
from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')
import interface_package
from ros_harness import OFFICE_ARGS, Peer, slam_node

from msg_adapters.sensors import pose_from_msg, stamp_ns

DEPENDENCIES = ('geometry_msgs', 'std_msgs', 'builtin_interfaces')


@pytest.fixture(scope='module')
def tf2_msgs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """The environment of a process that can import tf2_msgs; this one can, too."""
    if interface_package.is_importable('tf2_msgs'):
        yield {}
        return
    if missing := interface_package.missing_tools():
        pytest.skip(f'tf2_msgs is neither installed nor can it be built without {", ".join(missing)}')
    package = interface_package.InterfacePackage(
        'tf2_msgs', {'TFMessage': 'geometry_msgs/TransformStamped[] transforms\n'}, DEPENDENCIES,
        tmp_path_factory.mktemp('tf2_msgs'))
    site = str(package.build())
    sys.path.insert(0, site)
    yield {'PYTHONPATH': f'{Path(__file__).parents[1]}:{site}'}
    sys.path.remove(site)


def test_transform_goes_with_the_odometry(tf2_msgs: dict[str, str], ros: None, tmp_path: Path) -> None:
    peer = Peer()
    peer.hear('/tf', 'tf2_msgs/msg/TFMessage', 100)
    peer.hear('/line_slam/odometry', 'nav_msgs/msg/Odometry', 100)
    with slam_node(tmp_path / 'log', *OFFICE_ARGS, '-p', 'pose_source:=topic', '-p', 'body_frame:=base_link',
                   env=tf2_msgs) as node:
        peer.play_office(1.5)
        assert 'tf2_msgs is not installed' not in node.text
    transforms = {stamp_ns(t): t for m in peer.heard['/tf'] for t in m.transforms}
    odometry = {stamp_ns(m): pose_from_msg(m)[1] for m in peer.heard['/line_slam/odometry']}
    common = transforms.keys() & odometry.keys()
    peer.close()
    assert len(common) > 5, node.text
    for t_ns in common:
        moved = transforms[t_ns].transform
        assert (transforms[t_ns].header.frame_id, transforms[t_ns].child_frame_id) == ('odom', 'base_link')
        np.testing.assert_allclose([moved.translation.x, moved.translation.y, moved.translation.z],
                                   odometry[t_ns][:3, 3], atol=1e-12)


def test_without_tf2_msgs_the_node_says_so_and_works(ros: None, tmp_path: Path) -> None:
    """tf2_msgs is hidden by a module of that name without messages."""
    (tmp_path / 'tf2_msgs').mkdir()
    (tmp_path / 'tf2_msgs' / '__init__.py').write_text('')
    script = ('import rclpy; rclpy.init(); from line_slam_ros.nodes.line_slam_node import LineSlamNode; '
              'node = LineSlamNode(); print([t for t, _ in node.get_topic_names_and_types()])')
    path = f'{tmp_path}:{Path(__file__).parents[1]}'
    done = subprocess.run([sys.executable, '-c', script], check=False, env={**os.environ, 'PYTHONPATH': path},
                          capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert '/tf is not published' in done.stderr
    assert "'/line_slam/odometry'" in done.stdout and "'/tf'" not in done.stdout
