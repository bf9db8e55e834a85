"""Starting without compiled kernels: it is told, and half of the work is done beside."""
import os
import subprocess
import sys

from line_slam_ros.kernel_cache import COMPILING
from line_slam_ros.warm_up import BESIDE

ASK = 'from line_slam_ros.kernel_cache import cache_is_empty; print([cache_is_empty(print), cache_is_empty(print)])'


def run(code, **environment):
    paths = os.pathsep.join(filter(None, sys.path))
    return subprocess.run([sys.executable, '-c', code], env={**os.environ, 'PYTHONPATH': paths, **environment},
                          capture_output=True, text=True, check=False)


def test_an_empty_cache_is_told_once(tmp_path):
    first, second = (run(ASK, NUMBA_CACHE_DIR=str(tmp_path)).stdout for _ in range(2))
    assert first.splitlines() == [COMPILING, '[True, False]']
    assert second.splitlines() == ['[False, False]']


def test_the_process_beside_does_its_work_wherever_this_one_found_the_package():
    done = run(BESIDE.format(path=sys.path), PYTHONPATH='')
    assert done.returncode == 0, done.stderr
