"""``line_slam simulate``: recordings of worlds that are known exactly."""
from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from line_slam_ros.simulation.house import Pinhole

SETTINGS = 'simulation.json'


def add_parser(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        'simulate', help='make a recording of a world that is known exactly',
        description='Makes a random world and a recording in it. The same settings give the same bytes.')
    worlds = parser.add_subparsers(dest='world', required=True, metavar='WORLD')
    _add_house(worlds)
    _add_corridor(worlds)


def run(args: argparse.Namespace) -> int:
    """0; ValueError or OSError when a setting or a file cannot be used."""
    if args.world == 'house':
        return _house(args)
    from line_slam_ros.cli.simulating import record_corridor
    return record_corridor(args.directory, args.seed, args.speed, args.sway, args.seconds, args.light, args.texture)


def _add_house(worlds: Any) -> None:
    parser = worlds.add_parser(
        'house', help='camera poses, true lines and observed segments, as text files',
        description='Makes a random house of vertical, horizontal and slanted lines and the views of a camera that '
                    'goes round in it. Writes cam_pose_tum.txt, house.txt and observations.txt, which optimize-lines '
                    f'reads, and {SETTINGS} with every setting. The same settings give the same bytes.')
    _add_common(parser)
    parser.add_argument('--lines', type=int, default=80, help='of the house, at least 22 (default 80)')
    motion = parser.add_mutually_exclusive_group()
    motion.add_argument('--frames', type=int, default=600, help='of one loop in the house (default 600)')
    motion.add_argument('--trajectory', type=Path, metavar='TUM', help='camera poses to use instead, T_WC: x right, '
                        'y down, z forward; the middle of the house is the origin, its floor z = 0')
    _add_camera(parser.add_argument_group('camera', 'without distortion; the principal point is the middle'))
    _add_effects(parser.add_argument_group('effects', 'shares are of all views, from 0 to 1'))


def _add_corridor(worlds: Any) -> None:
    parser = worlds.add_parser(
        'corridor', help='a bag with images and IMU of a walk along a corridor with little texture',
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        description='Renders a walk along a corridor of plain walls with one or two turns, 30 to 60 m long: with '
                    'lens distortion, motion blur, noise and automatic exposure. Writes bag, calibration.yaml (Kalibr '
                    'form), groundtruth.tum and gt_lines.csv. The same settings give the same bytes.')
    _add_common(parser)
    parser.add_argument('--speed', type=float, default=1.2, metavar='M_PER_S', help='of the walk where it is straight')
    parser.add_argument('--sway', type=float, default=1.0, help='strength of the shaking on top, from 0 to 5')
    parser.add_argument('--seconds', type=float, help='cut the recording to; without, it ends with the corridor')
    parser.add_argument('--light', type=float, default=1.0,
                        help='brightness of the world; below 0.3 the images get noisy and blurred by motion')
    parser.add_argument('--texture', type=float, default=1.0, help='strength of the weak pattern of the surfaces')


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('directory', type=Path, metavar='DIR', help='where the files go; made if missing')
    parser.add_argument('--seed', type=int, default=0, help='of world, motion, noise and all else')


def _house(args: argparse.Namespace) -> int:
    from line_slam_ros.experiment import files
    from line_slam_ros.simulation import house
    camera = _camera(args)
    effects = house.Effects(args.noise_px, args.fov_limit, args.partial, args.outliers, args.swapped)
    segments = house.random_house(args.seed, args.lines)
    stamps, T_WC = files.read_poses(args.trajectory) if args.trajectory else house.closed_loop(args.seed, args.frames)
    views = files.LineViews(*house.observe(segments, T_WC, camera, effects, args.seed))
    settings = {'world': args.world, 'seed': args.seed, 'lines': len(segments), 'frames': len(stamps),
                'trajectory': str(args.trajectory) if args.trajectory else None,
                'camera': asdict(camera), 'effects': asdict(effects)}
    args.directory.mkdir(parents=True, exist_ok=True)
    files.write_poses(args.directory / files.POSES, stamps, T_WC)
    files.write_landmarks(args.directory / files.LANDMARKS, segments)
    files.write_observations(args.directory / files.OBSERVATIONS, views)
    text = json.dumps(settings, indent=2, sort_keys=True) + '\n'
    (args.directory / SETTINGS).write_text(text, encoding='utf-8', newline='\n')
    unseen = len(segments) - len(set(views.line.tolist()))
    print(f'{args.directory}: {len(segments)} lines, {len(stamps)} frames, {len(views.line)} observations, '
          f'{unseen} lines never seen')
    return 0


def _add_camera(group: Any) -> None:
    group.add_argument('--width', type=int, help='px (default 640)')
    group.add_argument('--height', type=int, help='px (default 640)')
    group.add_argument('--focal', type=float, help='px (default 460)')
    group.add_argument('--camera', type=Path, metavar='KALIBR_YAML',
                       help='take size and intrinsics from a calibration file instead, without its distortion')


def _add_effects(group: Any) -> None:
    group.add_argument('--noise-px', type=float, default=1.0, metavar='PX',
                       help='standard deviation of every coordinate of every end (default 1)')
    group.add_argument('--fov-limit', action=argparse.BooleanOptionalAction, default=True,
                       help='cut lines at the border of the image; without, all that lie in front are seen whole')
    group.add_argument('--partial', type=float, default=0.0, metavar='SHARE', help='see only a part of the line')
    group.add_argument('--outliers', type=float, default=0.0, metavar='SHARE', help='are a wrong segment')
    group.add_argument('--swapped', type=float, default=0.0, metavar='SHARE', help='have their ends in the other order')


def _camera(args: argparse.Namespace) -> Pinhole:
    from line_slam_ros.simulation.house import Pinhole
    given = {name: value for name in ('width', 'height', 'focal') if (value := getattr(args, name)) is not None}
    if args.camera is None:
        return Pinhole.centred(**given)
    if given:
        raise ValueError(f'--camera already says what --{" and --".join(given)} would; give either')
    from line_slam_ros.calibration import read_kalibr
    calibration = read_kalibr(args.camera)
    return Pinhole(calibration.width, calibration.height, *calibration.intrinsics)
