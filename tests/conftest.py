"""Fixtures shared by the tests: a ROS domain of our own, and rclpy switched on and off again."""
from __future__ import annotations

import os
import socket
from collections.abc import Iterator

import pytest

DOMAINS = range(1, 102)  # above 101 the ports run into the ephemeral range


def lock_domain() -> tuple[int, socket.socket]:
    """A ROS domain nobody else on this machine tests in; held until the socket (or the process) goes."""
    for domain in DOMAINS:
        lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            lock.bind(f'\0line_slam_ros_test_domain_{domain}')
        except OSError:
            lock.close()
        else:
            return domain, lock
    raise RuntimeError(f'all {len(DOMAINS)} ROS domains are in use by other tests')


@pytest.fixture(scope='session', autouse=True)
def ros_domain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Isolates this test process and its children: own domain, this machine only, field types checked."""
    domain, lock = lock_domain()
    os.environ.update(ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST',
                      ROS_PYTHON_CHECK_FIELDS='1', ROS_LOG_DIR=str(tmp_path_factory.mktemp('ros_log')))
    yield domain
    lock.close()


@pytest.fixture
def ros() -> Iterator[None]:
    """rclpy initialised for one test; skipped where ROS is not installed."""
    rclpy = pytest.importorskip('rclpy')
    rclpy.init()
    yield
    rclpy.try_shutdown()
