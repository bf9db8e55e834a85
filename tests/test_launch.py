"""Launch file, RViz layout and Fast DDS settings: loadable, and about things that exist."""
from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parents[1]
LAUNCH = ROOT / 'launch' / 'line_slam.launch.py'
PROFILES = ROOT / 'config' / 'fastdds_large_images.xml'

LARGE_IMAGES = '''
import array, sys, time, rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image
rclpy.init()
node = rclpy.create_node(sys.argv[1])
heard = []
if sys.argv[1] == 'hear':
    node.create_subscription(Image, 'image', lambda m: heard.append(m.step), qos_profile_sensor_data)
    deadline = time.monotonic() + 20.0
    while len(heard) < 10 and time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.1)
    print(len(heard))
else:
    publisher = node.create_publisher(Image, 'image', qos_profile_sensor_data)
    image = Image(height=720, width=1280, encoding='rgb8', step=3840, data=array.array('B', bytes(2764800)))
    while True:
        publisher.publish(image)
        time.sleep(0.1)
'''


def test_launch_file_compiles_and_describes_its_arguments() -> None:
    tree = ast.parse(LAUNCH.read_text())
    functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert 'generate_launch_description' in functions
    readme = (ROOT / 'README.md').read_text()
    used = set(re.findall(r'line_slam\.launch\.py (\w+):=', readme + PROFILES.read_text()))
    assert used and all(f"'{name}'" in LAUNCH.read_text() for name in used)


def test_launch_file_loads_where_ros_launch_is_installed() -> None:
    for module in ('launch', 'launch_ros', 'ament_index_python'):
        pytest.importorskip(module, reason=f'{module} is not installed')
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    from launch import LaunchContext
    try:
        description = PythonLaunchDescriptionSource(str(LAUNCH)).get_launch_description(LaunchContext())
    except LookupError:  # ament_index_python: the package is not installed
        pytest.skip('line_slam_ros is not installed as a ROS package')
    assert {'rviz', 'use_sim_time', 'config_file'} <= {a.name for a in description.get_launch_arguments()}


def test_rviz_shows_the_topics_of_the_node_with_their_durability() -> None:
    yaml = pytest.importorskip('yaml')
    manager = yaml.safe_load((ROOT / 'rviz' / 'line_slam.rviz').read_text())['Visualization Manager']
    topics = {display['Topic']['Value']: display['Topic']['Durability Policy']
              for display in manager['Displays'] if 'Topic' in display}
    published = {f'/line_slam/{name}' for name in ('odometry', 'path', 'lines', 'points', 'image_lines')}
    assert topics.keys() == published
    assert topics['/line_slam/lines'] == 'Transient Local'
    assert manager['Global Options']['Fixed Frame'] == 'odom'


def test_fast_dds_settings_make_room_for_large_images() -> None:
    name = '{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}segment_size'
    sizes = [int(e.text or 0) for e in ElementTree.parse(PROFILES).iter(name)]
    assert sizes and min(sizes) >= 32 * 2**20


def test_large_images_arrive_with_the_fast_dds_settings(ros_domain: int) -> None:
    rclpy = pytest.importorskip('rclpy')
    if 'fastrtps' not in rclpy.get_rmw_implementation_identifier():
        pytest.skip('the middleware is not Fast DDS')
    env = {**os.environ, 'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROFILES)}
    with subprocess.Popen([sys.executable, '-c', LARGE_IMAGES, 'send'], env=env) as sender:
        try:
            hearer = subprocess.run([sys.executable, '-c', LARGE_IMAGES, 'hear'], env=env, capture_output=True,
                                    text=True, check=True, timeout=60)
        finally:
            sender.kill()
    assert int(hearer.stdout) == 10
