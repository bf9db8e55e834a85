"""The node's two threads together."""
from __future__ import annotations

import pytest

pytest.importorskip('rclpy')
from line_slam_ros.nodes import line_slam_node
from line_slam_ros.nodes.inputs import Inputs


@pytest.mark.filterwarnings('ignore::pytest.PytestUnhandledThreadExceptionWarning')
def test_a_dead_worker_takes_the_node_down(ros: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node that looks alive but computes nothing would be worse."""
    def die(_: object) -> None:
        raise RuntimeError('a bug')

    monkeypatch.setattr(line_slam_node.LineSlamNode, '_warm_up', die)
    monkeypatch.setattr(Inputs, '_read_files', lambda _: None)  # no complaint about the missing calibration
    node = line_slam_node.LineSlamNode()
    line_slam_node.spin(node)
    assert node.worker_failed
