"""``line_slam benchmark``: accuracy on recordings, honesty of the covariance, speed."""
from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

_RECORDINGS = """\
Runs replay over every recording that the YAML file names, in every variant, each run in a process of its own with one
thread, and compares the results with the truth (evo for trajectories). Writes results.json and, per run, a directory
with what replay writes and log.txt. Recordings that are not there are listed as missing; a run that crashes, hangs or
never starts is a row of the table, not the end.

The file (see benchmarks/recordings.yaml; paths are relative to it):

    variants:                     # default: points and lines, points only, lines only, 2-parameter lines
      points only: {use_lines: false}
    recordings:
      office:
        bag: ../bags/office/bag   # rosbag2 directory, .mcap, .db3, .bag; or asl: FOLDER (EuRoC layout; camera: cam0)
        truth: truth.tum          # or truth_topic: /ground_truth/pose
        lines: [gt_lines.csv]     # true segments x1,y1,z1,x2,y2,z2
        calibration: kalibr.yaml  # default: found as in replay
        start: 0                  # s
        duration: 20              # s
        settings: {}              # parameters for all variants
        variants: [points only]   # default: all
        degrade:                  # copies made worse, each run with the first variant
          every second image: {every_nth: 2}

What degrade knows (replay --degrade NAME=VALUE, too); only resize changes the calibration along:

    every_nth: 2                  only every second image
    imu_noise: 3                  three times the calibrated white noise of gyro and accelerometer
    brightness: 0.3               factor on the grey values
    ramp: 0.5, ramp_period_s: 10  brightness rises and falls by half, linearly
    jump: 0.3, jump_period_s: 1.5 exposure jumps up and down by 30 %
    blur_px: 2                    standard deviation of a Gaussian blur
    resize: 0.75                  images and calibration a quarter smaller
    time_offset_ms: 5             the IMU's stamps run late; images and truth keep theirs
    extrinsic_rotation_deg: 1     the camera is calibrated wrong by this angle about a random axis
    seed: 0                       of noise and axis
"""
_CONSISTENCY = """\
Monte Carlo on simulated features (random rooms and motions by seed, IMU noise as EuRoC's, no images, start included):
accuracy against pixel noise, with and without lines, and the normalised estimation error squared (NEES) of position,
orientation, pose, velocity and lines against their covariance, with chi-square bounds. Writes consistency.json,
consistency.md and consistency.png.
"""
_LINES = """\
Times ten joint Levenberg-Marquardt iterations over all lines of a line experiment, in 4 and in 2 parameters, in turns
with a fixed calibration kernel, and prints medians and the ratio to the kernel, which changes little with the machine
and what else it does. DIR holds cam_pose_tum.txt, house.txt and observations.txt; default: a simulated house with about
30 000 observations. Writes lines.json and lines.md.
"""
_SPEED = """\
Times a recording, each part in processes of its own, and compares with a reference. Parts:

    frames    wall and CPU time by stage with one thread and with two, and of the whole command line_slam replay
    startup   of line_slam replay, with an empty and with a filled cache of compiled code
    memory    resident memory while the recording is shown forwards and backwards, again and again
    growth    of the stages with points, lines, window, image size and lines in the map; a plot
    live      line_slam_node over DDS (needs ROS 2), as recorded and three times as fast: age of its poses, drops,
              CPU time by thread, cost of messages

Each writes PART.json and PART.md. The reference holds the figures in units of a fixed calibration kernel that was timed
in the same run, so that they can be compared with those of another machine or hour; what takes more than 1.3 times the
reference is marked.
"""
PARTS = 'frames', 'startup', 'memory', 'growth', 'live'
_CHECKOUT = Path(__file__).resolve().parents[2]


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser('benchmark', help='measure accuracy, consistency and speed',
                                   description='Measures accuracy on recordings, consistency of the covariance on '
                                               'simulated features, and speed.')
    kinds = parser.add_subparsers(dest='kind', required=True, metavar='KIND')
    _add_recordings(kinds)
    _add_consistency(kinds)
    _add_lines(kinds)
    _add_speed(kinds)


def _add_recordings(kinds: Any) -> None:
    parser = kinds.add_parser('recordings', help='replay over a list of recordings, in variants, against the truth',
                              description=_RECORDINGS,
                              formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('file', type=Path, metavar='FILE.yaml', help='the recordings')
    _add_outputs(parser)
    parser.add_argument('--only', nargs='+', action='extend', default=[], metavar='NAME',
                        help="recordings to run, by name or pattern ('office*'); default: all and their worse copies")
    parser.add_argument('--variants', nargs='+', action='extend', default=[], metavar='NAME',
                        help='variants to run; default: all')
    parser.add_argument('--keep', action='store_true',
                        help='keep the rows of an earlier results.json that are not measured again')
    parser.add_argument('--timeout', type=float, default=3600.0, metavar='S', help='of one run, default 3600 s')


def _add_consistency(kinds: Any) -> None:
    parser = kinds.add_parser('consistency', help='Monte Carlo on simulated features: NEES, ATE against noise',
                              description=_CONSISTENCY, formatter_class=argparse.RawDescriptionHelpFormatter)
    _add_outputs(parser)
    parser.add_argument('--runs', type=_positive, default=50, metavar='N', help='of each kind, default 50')
    parser.add_argument('--seconds', type=float, default=60.0, metavar='S', help='of each run, default 60')
    parser.add_argument('--first-seed', type=int, default=0, metavar='N', help='seeds N, N + 1, ...; default 0')
    parser.add_argument('--pixel-sigma', type=float, nargs='+', default=[0.3], metavar='PX',
                        help='noise of the observations, px; several: ATE against noise; default 0.3')
    parser.add_argument('--place', choices=('room', 'corridor'), default='room',
                        help='a room with a random motion in it, or a walk along a corridor; default room')
    parser.add_argument('--points', type=_positive, default=600, metavar='N',
                        help='in that place, of which a sixth is in view at a time; default 600')
    parser.add_argument('--points-in-view', type=_positive, default=700, metavar='N',
                        help='points used at a time, at most: fewer to see what lines can do alone; default 700')
    parser.add_argument('--lines', action=argparse.BooleanOptionalAction, default=None,
                        help='with or without lines only; default: both')
    parser.add_argument('--jobs', type=_positive, default=1, metavar='N', help='processes at a time, default 1')


def _add_lines(kinds: Any) -> None:
    parser = kinds.add_parser('lines', help='speed of the line solver against a calibration kernel',
                              description=_LINES, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('directory', type=Path, nargs='?', metavar='DIR', help='a line experiment')
    _add_outputs(parser)
    parser.add_argument('--repeats', type=_positive, default=7, metavar='N', help='turns that count, default 7')


def _add_speed(kinds: Any) -> None:
    parser = kinds.add_parser('speed', help='times by stage, start, memory, growth, live node, against a reference',
                              description=_SPEED, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('bag', type=Path, nargs='?', default=_CHECKOUT / 'bags' / 'office' / 'bag', metavar='BAG',
                        help='rosbag2 directory, or a .mcap, .db3 or ROS 1 .bag file; default: the shipped recording')
    _add_outputs(parser)
    parser.add_argument('--figures', type=Path, metavar='DIR', help='where plots go; default: with the results')
    parser.add_argument('--parts', nargs='+', choices=PARTS, default=PARTS, metavar='PART',
                        help=f'of {", ".join(PARTS)}; default: all')
    parser.add_argument('--calibration', type=Path, metavar='KALIBR.yaml', help='default: found as in replay')
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE', help='one parameter')
    parser.add_argument('--duration', type=float, metavar='S', help='use no more than this much; default: all of it, s')
    parser.add_argument('--minutes', type=float, default=30.0, metavar='MIN',
                        help='of data, for the memory; default 30')
    parser.add_argument('--reference', type=Path, metavar='FILE.json', help='default: that of the repository',
                        default=_CHECKOUT / 'benchmarks' / 'speed_reference.json')
    parser.add_argument('--update-reference', action='store_true', help='write the figures there')


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--output', type=Path, required=True, metavar='DIR', help='where results go')
    parser.add_argument('--markdown', type=Path, metavar='FILE.md',
                        help='also put the tables into this file, between two comment lines; the rest of it stays')


def _positive(text: str) -> int:
    if (value := int(text)) < 1:
        raise argparse.ArgumentTypeError(f'must be at least 1, got {value}')
    return value


def run(args: argparse.Namespace) -> int:
    """0, or 1 after a message on stderr."""
    try:
        from line_slam_ros.cli import benchmarking
    except ModuleNotFoundError as error:
        print(f'line_slam benchmark needs the package {error.name}: pip install evo', file=sys.stderr)
        return 1
    return getattr(benchmarking, args.kind)(args)
