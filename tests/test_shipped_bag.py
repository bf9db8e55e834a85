"""The bag in bags/: what its README says, complete, readable, and remade from its source byte for byte."""
from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
BAGS = ROOT / 'bags'
SOURCE = ROOT.parent / 'shared' / 'data' / 'office_gentle'
CHECKSUMS = {name: checksum for checksum, name
             in re.findall(r'^ +([0-9a-f]{64})  (\S+)$', (BAGS / 'README.md').read_text(), re.MULTILINE)}


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_readme_gives_the_checksum_of_every_file() -> None:
    shipped = {str(p.relative_to(BAGS)): sha256(p) for p in BAGS.rglob('*')
               if p.is_file() and p.name not in ('README.md', 'metadata.yaml')}
    assert shipped == CHECKSUMS


def test_bag_holds_the_sensors_and_the_truth() -> None:
    rosbag2 = pytest.importorskip('rosbags.rosbag2')
    with rosbag2.Reader(BAGS / 'office' / 'bag') as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        read = {topic: 0 for topic in counts}
        for connection, _, _ in reader.messages():
            read[connection.topic] += 1
        duration = reader.duration
    assert counts == read == {'/cam0/image_raw/compressed': 401, '/cam0/camera_info': 401, '/imu0': 4001,
                              '/ground_truth/pose': 4001}
    assert 20_000_000_000 <= duration <= 20_000_000_001
    assert sum(p.stat().st_size for p in BAGS.rglob('*')) < 25_000_000


def test_truth_starts_at_rest_and_covers_the_bag() -> None:
    trajectory = np.loadtxt(BAGS / 'office' / 'groundtruth.tum')
    t, p_W, q_xyzw = trajectory[:, 0] - trajectory[0, 0], trajectory[:, 1:4], trajectory[:, 4:]
    step = np.linalg.norm(np.diff(p_W, axis=0), axis=1)
    assert t[-1] == pytest.approx(20.0, abs=1e-6)
    assert step[t[1:] < 2.0].sum() < 0.02  # m
    assert 5.0 < step.sum() < 10.0
    np.testing.assert_allclose(np.linalg.norm(q_xyzw, axis=1), 1.0, atol=1e-8)


@pytest.mark.skipif(not SOURCE.is_dir(), reason=f'needs the full recording in {SOURCE.name}')
def test_cut_bag_makes_the_shipped_files_again(tmp_path: Path) -> None:
    subprocess.run([sys.executable, str(ROOT / 'scripts' / 'cut_bag.py'), str(SOURCE), str(tmp_path / 'office'),
                    '--seconds', '20'], check=True)
    made = {str(p.relative_to(tmp_path)): sha256(p) for p in (tmp_path / 'office').rglob('*')
            if p.is_file() and p.name != 'metadata.yaml'}
    assert made == CHECKSUMS
