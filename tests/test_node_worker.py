"""The node's two threads together."""
from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')
from line_slam_ros.nodes import line_slam_node
from line_slam_ros.nodes.inputs import Inputs
from line_slam_ros.types import Frame


@pytest.mark.filterwarnings('ignore::pytest.PytestUnhandledThreadExceptionWarning')
def test_a_dead_worker_takes_the_node_down(ros: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node that looks alive but computes nothing would be worse."""
    def die(_: object) -> None:
        raise RuntimeError('a bug')

    monkeypatch.setattr(line_slam_node.LineSlamNode, '_warm_up', die)
    monkeypatch.setattr(Inputs, '_read_files', lambda _: None)  # no complaint about the missing calibration
    node = line_slam_node.LineSlamNode()
    line_slam_node.spin(node)
    assert node.thread_failed


@pytest.mark.filterwarnings('ignore::pytest.PytestUnhandledThreadExceptionWarning')
def test_a_dead_poller_takes_the_node_down(ros: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(line_slam_node.LineSlamNode, '_work', lambda _: None)
    monkeypatch.setattr(Inputs, '_read_files', lambda _: None)
    node = line_slam_node.LineSlamNode()

    def die() -> None:
        raise RuntimeError('a bug')

    node._saving._serve = die
    line_slam_node.spin(node)
    assert node.thread_failed


def test_waiting_frames_hurry_the_worker_before_any_is_dropped(ros: None, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    slam = SimpleNamespace(waiting_for='', process=lambda frame, imu, behind: asked.append(behind))
    monkeypatch.setattr(line_slam_node.LineSlamNode, '_new_slam', lambda *_: slam)
    monkeypatch.setattr(line_slam_node.LineSlamNode, '_publish', lambda *_: None)
    monkeypatch.setattr(Inputs, '_read_files', lambda _: None)
    node = line_slam_node.LineSlamNode()
    inbox = node._incoming.inbox
    for k in range(6):
        inbox.frame(Frame(100 + 10 * k, np.zeros((3, 4), np.uint8)))
        inbox.imu(100 + 10 * k, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
    inbox.close()
    node._process_all(line_slam_node.WARM_UP_CALIBRATION)
    assert asked == [True] * 4 + [False] * 2 and not inbox.drops
    assert node._diagnostics.frames_behind == 4
    node.destroy_node()
