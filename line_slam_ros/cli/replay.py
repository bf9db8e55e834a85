"""``line_slam replay``: a recorded bag through the same code as the live node, faster than real time."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        'replay', help='run the SLAM on a recorded bag', formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        description='Runs the SLAM on a bag and writes trajectory.tum, lines.csv, lines.ply, output.mcap, metrics.json '
                    'and figure.png. Two runs give the same trajectory, lines and output.mcap, byte by byte.')
    parser.add_argument('bag', type=Path, help='rosbag2 directory, or a .mcap, .db3 or ROS 1 .bag file')
    parser.add_argument('--output', type=Path, default=Path('line_slam_output'), metavar='DIR', help='where results go')
    parser.add_argument('--config', type=Path, action='append', default=[], metavar='FILE.yaml',
                        help='parameter file, the same as for the node; may be given several times')
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE', help='one parameter')
    parser.add_argument('--calibration', type=Path, metavar='KALIBR.yaml',
                        help='camchain-imucam.yaml; default: calibration_file of the parameters, calibration.yaml in '
                             'the bag directory or beside it, camera_info with T_body_camera')
    parser.add_argument('--threads', type=int, default=1, help='threads that OpenCV may use')
    parser.add_argument('--start', type=float, default=0.0, metavar='S', help='skip this much after the first image, s')
    parser.add_argument('--duration', type=float, metavar='S', help='use no more than this much; default: all of it, s')
    parser.add_argument('--degrade', action='append', default=[], metavar='NAME=VALUE',
                        help='make the recording worse, to see what it takes: every_nth=2, imu_noise=3, ... '
                             '(line_slam benchmark recordings --help has all of them)')
    parser.add_argument('--no-figure', dest='figure', action='store_false', help='do not draw figure.png')
    for name, what in (('image', 'raw or compressed images'), ('imu', 'sensor_msgs/Imu'),
                       ('camera-info', 'sensor_msgs/CameraInfo'), ('pose', 'poses, with pose_source: topic')):
        parser.add_argument(f'--{name}-topic', default='', metavar='TOPIC', help=f'{what}; default: found by type')


def run(args: argparse.Namespace) -> int:
    from line_slam_ros.cli.replaying import replay
    return replay(args)
