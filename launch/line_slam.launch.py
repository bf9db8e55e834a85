"""Starts line_slam_node, with RViz if asked: ros2 launch line_slam_ros line_slam.launch.py --show-args."""
from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

SHARE = Path(get_package_share_directory('line_slam_ros'))
TOPICS = ('image', 'camera_info', 'imu', 'pose', 'odometry')
ARGUMENTS = {
    'config_file': (str(SHARE / 'config' / 'line_slam.yaml'), 'parameter file'),
    'calibration_file': ('', 'Kalibr camchain-imucam.yaml; empty: as in config_file'),
    'image_transport': ('', 'raw or compressed; empty: as in config_file'),
    'use_sim_time': ('false', 'take the time from /clock, as when playing a bag'),
    'rviz': ('false', 'start RViz too'),
    'large_images': ('false', 'Fast DDS settings for images of more than 512 KB; give them to the camera driver too'),
    **{topic: (topic, f'the topic that {topic} is remapped to') for topic in TOPICS},
}


def slam_node(context: LaunchContext) -> list[Node]:
    """The node; arguments left empty do not override the parameter file."""
    value = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    parameters = {'use_sim_time': value['use_sim_time'].lower() == 'true',
                  **{name: value[name] for name in ('calibration_file', 'image_transport') if value[name]}}
    return [Node(package='line_slam_ros', executable='line_slam_node', name='line_slam', output='screen',
                 parameters=[value['config_file'], parameters], remappings=[(topic, value[topic]) for topic in TOPICS])]


def generate_launch_description() -> LaunchDescription:
    """Arguments, environment, node, RViz."""
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=text)
          for name, (default, text) in ARGUMENTS.items()),
        SetEnvironmentVariable('FASTRTPS_DEFAULT_PROFILES_FILE', str(SHARE / 'config' / 'fastdds_large_images.xml'),
                               condition=IfCondition(LaunchConfiguration('large_images'))),
        OpaqueFunction(function=slam_node),
        Node(package='rviz2', executable='rviz2', arguments=['-d', str(SHARE / 'rviz' / 'line_slam.rviz')],
             condition=IfCondition(LaunchConfiguration('rviz'))),
    ])
