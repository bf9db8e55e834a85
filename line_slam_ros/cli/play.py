"""``line_slam play``: publish a bag over DDS, and keep what the node makes of it."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        'play', help='publish a bag over DDS', formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        description='Publishes a bag as it was recorded, once somebody subscribes. With --output it listens to the '
                    'node and writes trajectory.tum, lines.csv, lines.ply, output.mcap and figure.png.')
    parser.add_argument('bag', type=Path, help='rosbag2 directory, or a .mcap or .db3 file')
    parser.add_argument('--rate', type=positive, default=1.0, help='speed; 1 is as recorded')
    parser.add_argument('--clock', action='store_true', help='publish /clock too, for nodes with use_sim_time')
    parser.add_argument('--start', type=float, default=0.0, metavar='S', help='skip the first seconds')
    parser.add_argument('--duration', type=positive, default=float('inf'), metavar='S', help='then stop')
    parser.add_argument('--loop', action='store_true', help='again and again, until interrupted')
    parser.add_argument('--output', type=Path, metavar='DIR', help='where to keep what the node publishes')
    parser.add_argument('--node', default='/line_slam', help='full name of the node to listen to')
    parser.add_argument('--wait', type=float, default=300.0, metavar='S',
                        help='for subscribers; a node that starts for the very first time compiles')


def positive(text: str) -> float:
    """A number greater than zero, for argparse."""
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f'must be positive, got {text}')
    return value


def run(args: argparse.Namespace) -> int:
    if args.loop and args.output:
        raise ValueError('--loop never ends, so --output would never be written; leave one of them out')
    try:
        from line_slam_ros.cli.playing import play
    except ImportError as error:
        raise ValueError(f'play needs ROS 2 ({error}); source it, or: pip install "line_slam_ros[ros]"') from None
    return play(args)
