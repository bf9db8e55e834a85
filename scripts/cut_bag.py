#!/usr/bin/env python3
"""Cut the first seconds out of a recording and its ground truth, message by message, as recorded."""
from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from rosbags.rosbag2 import Reader, StoragePlugin, Writer


def cut_messages(source: Path, target: Path, duration_ns: int) -> int:
    """Copy the messages of the first duration_ns into a new MCAP bag, undecoded; the time of the last one."""
    with Reader(source) as reader, Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        end_ns = reader.start_time + duration_ns
        copies = {c.id: writer.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data,
                                              rihs01=c.digest, offered_qos_profiles=c.ext.offered_qos_profiles)
                  for c in reader.connections}
        for connection, t_ns, raw in reader.messages(stop=end_ns + 1):
            writer.write(copies[connection.id], t_ns, raw)
    return end_ns


def cut_trajectory(source: Path, target: Path, end_ns: int) -> None:
    """Copy the rows of a TUM trajectory up to end_ns."""
    def in_time(row: str) -> bool:
        seconds, nanoseconds = row.split()[0].split('.')
        return int(seconds + nanoseconds) <= end_ns

    rows = source.read_text().splitlines(keepends=True)
    target.write_text(''.join(row for row in rows if row.startswith('#') or in_time(row)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('source', type=Path, help='folder with bag/, groundtruth.tum, calibration.yaml, gt_lines.csv')
    parser.add_argument('target', type=Path, help='new folder')
    parser.add_argument('--seconds', type=float, default=20.0, help='length (default: 20)')
    args = parser.parse_args()
    args.target.mkdir(parents=True)
    end_ns = cut_messages(args.source / 'bag', args.target / 'bag', round(args.seconds * 1e9))
    cut_trajectory(args.source / 'groundtruth.tum', args.target / 'groundtruth.tum', end_ns)
    for name in ('calibration.yaml', 'gt_lines.csv'):
        shutil.copyfile(args.source / name, args.target / name)


if __name__ == '__main__':
    main()
