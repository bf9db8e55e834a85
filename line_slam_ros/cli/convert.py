"""``line_slam convert``: an EuRoC/ASL folder to a ROS 2 bag."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        'convert', help='turn an EuRoC/ASL folder into a bag',
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        description='Turns an EuRoC/ASL folder (mav0/cam0, mav0/imu0, ground truth if there is one) into a rosbag2 '
                    'MCAP bag. calibration.yaml (Kalibr form) and groundtruth.tum go into the bag directory, where '
                    'replay finds them.')
    parser.add_argument('folder', type=Path, help='the folder that holds mav0, or mav0 itself')
    parser.add_argument('bag', type=Path, help='bag directory to make')
    parser.add_argument('--camera', default='cam0', help='camera to convert')
    parser.add_argument('--images', choices=('png', 'jpeg', 'raw'), default='png', help='how images are stored')
    parser.add_argument('--quality', type=int, default=90, help='of JPEG, 1 to 100')


def run(args: argparse.Namespace) -> int:
    from line_slam_ros.cli.converting import convert
    return convert(args.folder, args.bag, args.camera, args.images, args.quality)
