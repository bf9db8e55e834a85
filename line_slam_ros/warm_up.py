"""Runs every compiled kernel once, so that the first real frame does not wait for a compiler."""
from __future__ import annotations

import atexit
import gc
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from multiprocessing import get_context

import cv2
import numpy as np

from line_slam_ros.config import Config
from line_slam_ros.config import Estimator as EstimatorOptions
from line_slam_ros.estimation.bootstrap import drive
from line_slam_ros.estimation.estimator import Estimator
from line_slam_ros.frontend.front_end import FrontEnd
from line_slam_ros.geometry.camera import Camera, warm_up_lenses
from line_slam_ros.geometry.imu import turned
from line_slam_ros.geometry.lie_kernels import retract_rotation
from line_slam_ros.kernel_cache import cache_is_empty, fill
from line_slam_ros.mapping.line_map import LineMap
from line_slam_ros.simulation.features import Room, Sequence, Trajectory, calibration
from line_slam_ros.types import Calibration, Frame

RUN = """import sys
sys.path[:] = {path!r}
from line_slam_ros import warm_up
warm_up.{work}()"""


def warm_up(front_end: FrontEnd, calibration: Calibration, config: Config, tell: Callable[[str], None]) -> None:
    """Everything. With nothing in the cache this is told, and other processes compile first: kernels that were compiled
    where they run may differ by a rounding from those loaded, and the first run shall give the bytes of all others."""
    if cache_is_empty(tell):
        elsewhere(compile_all).wait()  # what it could not compile is compiled here, and its error comes up again
    warm_up_shared()
    LineMap.warm_up(config.mapping)
    warm_up_front_end(front_end, calibration)
    warm_up_estimator()
    fill()


def compile_all() -> None:
    """Every kernel, by as many processes as there are cores; each takes the next part when it is done with one."""
    gc.set_threshold(100_000, 50, 50)  # the compiler makes millions of objects, and hardly any garbage in circles
    warm_up_shared()  # first, and once: numba's cache is made for one writer
    parts, end = os.pipe()
    os.write(end, bytes(range(len(PARTS))))
    os.close(end)
    cores = min(len(os.sched_getaffinity(0)), len(PARTS))
    others = [get_context('fork').Process(target=compile_parts, args=(parts,)) for _ in range(cores - 1)]
    for process in others:
        process.start()
    compile_parts(parts)
    for process in others:
        process.join()
    if any(process.exitcode for process in others):
        raise RuntimeError('a process that compiles kernels failed, see above')


def compile_parts(parts: int) -> None:
    """Those whose numbers this process is the first to read from a pipe."""
    while part := os.read(parts, 1):
        PARTS[part[0]]()


def elsewhere(work: Callable[[], None]) -> subprocess.Popen:
    """A function of this module at work in a process of its own, which ends with this one, and all that it forked."""
    process = subprocess.Popen([sys.executable, '-c', RUN.format(path=sys.path, work=work.__name__)],
                               start_new_session=True)
    atexit.register(lambda: process.poll() is None and os.killpg(process.pid, signal.SIGKILL))
    return process


def warm_up_shared() -> None:
    """What several parts need."""
    warm_up_lenses()
    turned(np.array([0.0, 0.1]), np.zeros((2, 3)), np.zeros(3))
    retract_rotation(np.eye(3), np.zeros(3), np.eye(3))


def warm_up_estimator() -> None:
    """A few simulated seconds: start from motion, optimise, marginalise. To the kernels all options are but numbers."""
    sequence = Sequence(Trajectory.random(1), Room.random(1, points=300, lines=60), calibration(), 2.5, frame_rate=10.0)
    estimator = Estimator(EstimatorOptions(), sequence.calibration, 450.0, 300, 60)
    for _ in drive(estimator, sequence.calibration, sequence.steps()):
        estimator.covariance()
        estimator.lines()


def warm_up_points() -> None:
    """The half of the front end that follows corners."""
    warm_up_front_end(FrontEnd(Camera(calibration()), replace(Config(), use_lines=False)), calibration())


def warm_up_lines() -> None:
    """The half of the front end that follows segments."""
    warm_up_front_end(FrontEnd(Camera(calibration()), replace(Config(), use_points=False)), calibration())


def warm_up_map() -> None:
    """The line map."""
    LineMap.warm_up(Config().mapping)


def warm_up_front_end(front_end: FrontEnd, calibration: Calibration) -> None:
    """Three shifted views of a random mosaic of rectangles."""
    rng = np.random.default_rng(0)
    canvas = np.full((calibration.height + 16, calibration.width + 16), 128, np.uint8)
    for _ in range(60):
        x, y = rng.integers(0, canvas.shape[1]), rng.integers(0, canvas.shape[0])
        cv2.rectangle(canvas, (int(x), int(y)), (int(x + 150), int(y + 90)), int(rng.integers(0, 255)), -1)
    for k in range(3):
        view = np.ascontiguousarray(canvas[k:k + calibration.height, k:k + calibration.width])
        front_end.track(Frame(k + 1, view), None if k == 1 else np.eye(3))


# without a kernel in common, those that take longest first
PARTS = warm_up_estimator, warm_up_points, warm_up_lines, warm_up_map
