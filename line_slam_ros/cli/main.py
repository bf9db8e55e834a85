"""``line_slam``: the one command line of the package."""
from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from types import ModuleType

# modules of this room, light to import
COMMANDS = ('replay', 'play', 'convert', 'evaluate', 'simulate', 'optimize-lines', 'benchmark')


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a subcommand; its exit code, or 2 with one line on standard error if the input is bad."""
    argv = sys.argv[1:] if argv is None else argv
    wanted = argv[:1] if argv and argv[0] in COMMANDS else COMMANDS  # load all of them only for --help
    parser = argparse.ArgumentParser(prog='line_slam', description='Point-line visual-inertial SLAM for ROS 2.')
    subparsers = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    for name in wanted:
        _module_of(name).add_parser(subparsers)
    args = parser.parse_args(argv)
    try:
        return _module_of(args.command).run(args)
    except (ValueError, OSError) as error:
        print(f'line_slam {args.command}: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


def _module_of(command: str) -> ModuleType:
    return import_module(f'line_slam_ros.cli.{command.replace("-", "_")}')


if __name__ == '__main__':
    sys.exit(main())
