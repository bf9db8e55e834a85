"""Starting without compiled kernels: it is told, and other processes compile."""
import os
import subprocess
import sys

import pytest
from numba import njit
from numba.core.event import install_recorder

from line_slam_ros.kernel_cache import COMPILING, inner
from line_slam_ros.warm_up import RUN, compile_all, warm_up_estimator

ASK = 'from line_slam_ros.kernel_cache import *; print(cache_is_empty(print)); fill()'

LEFT = """
from numba.core import event
from numba.core.dispatcher import Dispatcher
import gc, numpy as np
from dataclasses import replace
from line_slam_ros.config import Config
from line_slam_ros.estimation.landmarks import eliminate, line_jacobians, point_jacobians
from line_slam_ros.simulation.features import Room, Sequence, Trajectory, calibration
from line_slam_ros.slam import Slam
from line_slam_ros.types import Frame

def signatures():
    kernels = (d for d in gc.get_objects() if isinstance(d, Dispatcher) and d.__module__.startswith('line_slam_ros'))
    return {f'{d.__module__}.{d.__name__}{s}'.replace(' ', '') for d in kernels for s in d.signatures}

Slam(Config(), calibration()).warm_up()
before = signatures()
rng = np.random.default_rng(0)
image = np.kron(rng.integers(0, 255, (16, 20)), np.ones((30, 32))).astype(np.uint8)  # 640x480
for lens in (calibration(), replace(calibration(), model='equidistant')):
    slam = Slam(Config(), lens)
    for seen, imu in Sequence(Trajectory.random(1), Room.random(1), lens, 4.0):
        frame = Frame(seen.t_ns, np.roll(image, seen.t_ns // 50_000_000, 1))
        slam.front_end.track(frame, np.eye(3))
        track, slam.front_end.track = slam.front_end.track, lambda *_, now=seen, **__: now
        slam.process(frame, imu)
        slam.front_end.track = track
print('left:', *(signatures() - before))
print('versions:', *(len(kernel.signatures) for kernel in (point_jacobians, line_jacobians, eliminate)))
"""


def run(code, **environment):
    paths = os.pathsep.join(filter(None, sys.path))
    return subprocess.run([sys.executable, '-c', code], env={**os.environ, 'PYTHONPATH': paths, **environment},
                          capture_output=True, text=True, check=False)


def test_an_empty_cache_is_told_until_everything_was_compiled(tmp_path):
    interrupted = run(ASK.removesuffix('; fill()'), NUMBA_CACHE_DIR=str(tmp_path)).stdout
    first, second = (run(ASK, NUMBA_CACHE_DIR=str(tmp_path)).stdout for _ in range(2))
    assert interrupted.splitlines() == first.splitlines() == [COMPILING, 'True']
    assert second.splitlines() == ['False']


def test_no_kernel_is_left_for_the_first_frames():
    """Neither of any kind of lens nor of any layout: what runs after the warm-up was compiled in it.

    The costliest are there once, whether the window is full or still grows.
    """
    left, versions = run(LEFT, PYTHONPATH=os.pathsep.join(filter(None, sys.path))).stdout.splitlines()[-2:]
    assert left.split() == ['left:']
    assert versions.split() == ['versions:', '1', '1', '1']


@pytest.mark.parametrize(('decorate', 'versions'), [(inner, 1), (njit, 2)])
def test_an_inner_kernel_is_compiled_once_whatever_constants_it_gets(decorate, versions):
    def scaled(x, by):
        return by * x

    part = decorate(scaled)
    with install_recorder('numba:compile') as compiled:
        assert njit(lambda x: part(x, 2) + part(x, 3))(1.0) == 5.0
    starts = [event.data['dispatcher'].py_func for _, event in compiled.buffer if event.is_start]
    assert starts.count(scaled) == versions


def test_a_process_that_fails_to_compile_its_parts_is_an_error():
    code = """import os, sys
from line_slam_ros import warm_up
own = os.getpid()
warm_up.os.sched_getaffinity, warm_up.warm_up_shared = lambda _: range(2), lambda: None
warm_up.compile_parts = lambda parts: os.getpid() == own or sys.exit('not compiled')
warm_up.compile_all()"""
    done = run(code)
    assert done.returncode != 0 and 'not compiled' in done.stderr


@pytest.mark.parametrize('work', [compile_all, warm_up_estimator])
def test_another_process_does_its_work_wherever_this_one_found_the_package(work):
    done = run(RUN.format(path=sys.path, work=work.__name__), PYTHONPATH='')
    assert done.returncode == 0, done.stderr
