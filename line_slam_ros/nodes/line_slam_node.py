"""The live node: sensor topics in, poses and the line map out. Wiring only, no mathematics.

One executor thread converts, enqueues and sends the map; one worker thread computes and publishes everything else;
one more saves the map, which takes seconds.
"""
from __future__ import annotations

import gc
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from queue import SimpleQueue

import cv2
import numpy as np
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from std_srvs.srv import Trigger

from line_slam_ros.config_file import NODE_NAME
from line_slam_ros.estimation.line_mapper import LineMapper
from line_slam_ros.mapping.io import write_csv, write_ply
from line_slam_ros.nodes.diagnostics import Diagnostics
from line_slam_ros.nodes.inputs import Inputs
from line_slam_ros.nodes.parameters import declare
from line_slam_ros.nodes.polling import Polled, Poller
from line_slam_ros.nodes.publishers import Publishers
from line_slam_ros.ros_conventions import gyro_variance
from line_slam_ros.slam import Slam
from line_slam_ros.types import Calibration, Estimate, ImuBatch, LineSegments

RCLError = rclpy_implementation.RCLError
SWITCH_INTERVAL_S = 5e-4  # how long the worker may keep the executor waiting; Python's 5 ms cost IMU latency
SAVING_PAUSE_S = 4e-3  # between blocks of rows of a map that is saved, for the worker to go on
BEHIND = 2  # frames that wait for the worker before it hurries; one is jitter
WARM_UP_CALIBRATION = Calibration('radtan', 752, 480, (450.0, 450.0, 376.0, 240.0), (0.0, 0.0, 0.0, 0.0), np.eye(4))


class LineSlamNode(Node):
    """Parameters, services, and the worker; inputs, outputs and diagnostics are objects of their own."""

    def __init__(self) -> None:
        """ValueError names a parameter that cannot be used."""
        super().__init__(NODE_NAME, automatically_declare_parameters_from_overrides=True)
        self._config, self._shell = declare(self)
        self._calibrations: SimpleQueue[Calibration | None] = SimpleQueue()
        self._slam: Slam | LineMapper | None = None
        self._in_use = threading.Lock()  # of _slam and its map: the worker for each frame, services now and then
        self._map_version: int | None = None
        self._newest_ns = 0
        self._stopping = False
        self.thread_failed = False
        self._outgoing = Publishers(self, self._shell)
        self._incoming = Inputs(self, self._shell, self._calibrations.put)
        self._diagnostics = Diagnostics(self, self._incoming, self._shell)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self._saving = Poller.of_requests(self.create_service(Trigger, '~/save_map', self._on_save_map,
                                                              callback_group=Polled()))
        self.create_timer(1.0, self._every_second, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._worker = threading.Thread(target=self._work, name='worker', daemon=True)

    def start(self) -> None:
        """Starts the worker; the node must be in an executor, since the worker asks it to subscribe.

        Without a calibration there is nothing to do but to say so, in the diagnostics.
        """
        if not self._incoming.problem:
            self._worker.start()

    def stop(self) -> None:
        """Lets the worker finish its frame and joins it."""
        self._stopping = True
        self._calibrations.put(None)
        self._incoming.close()
        self._saving.stop()
        if self._worker.is_alive():
            self._worker.join(timeout=5.0)  # compiling cannot be interrupted; the thread is a daemon

    def _work(self) -> None:
        """Everything heavy, in one thread. Ends when the inbox is closed; any other end takes the node down."""
        try:
            self._warm_up()
            self.executor.create_task(self._incoming.subscribe)  # a subscriber that can be seen is ready
            calibration = self._calibrations.get()
            if calibration is not None:
                self._process_all(calibration)
        except RCLError:
            if self.context.ok():  # else: shut down in the middle of a publish
                raise
        finally:
            self.thread_failed = not self._stopping and self.context.ok()
            if self.thread_failed:
                self.context.try_shutdown()

    def _warm_up(self) -> None:
        self._diagnostics.waiting_for = 'loading compiled code'
        self.get_logger().info('loading compiled code')
        began = time.monotonic()
        self._new_slam(WARM_UP_CALIBRATION).warm_up(self.get_logger().info)
        gc.freeze()  # what start-up made stays: collecting garbage takes 80 ms less
        self.get_logger().info(f'ready for data after {time.monotonic() - began:.1f} s')
        self._diagnostics.waiting_for = 'calibration'

    def _new_slam(self, calibration: Calibration) -> Slam | LineMapper:
        mode = LineMapper if self._shell.pose_source == 'topic' else Slam
        return mode(self._config, calibration)

    def _process_all(self, calibration: Calibration) -> None:
        slam = self._new_slam(calibration)
        step: Callable[..., Estimate | None] = slam.process_with_pose if isinstance(slam, LineMapper) else slam.process
        self._slam, self._diagnostics.waiting_for = slam, slam.waiting_for
        for frame, companion in self._incoming.inbox:
            if self._stopping:
                return
            taken, behind = time.perf_counter(), self._incoming.inbox.ready >= BEHIND
            noise = gyro_variance(calibration.imu_noise, companion) if isinstance(companion, ImuBatch) else 0.0
            with self._in_use:
                if self._incoming.inbox.jumped:
                    self._reset('time jumped back')
                try:
                    estimate = step(frame, companion, behind)
                except ValueError as error:
                    self._incoming.inbox.reject('image not usable', str(error), frame.t_ns)
                else:
                    self._publish(slam, frame.t_ns, estimate, noise, taken)
                    self._diagnostics.frames_behind += behind

    def _publish(self, slam: Slam | LineMapper, t_ns: int, estimate: Estimate | None, gyro_noise: float,
                 taken: float) -> None:
        """What a frame, taken from the inbox at a time of perf_counter(), gave."""
        began = time.perf_counter()
        self._newest_ns = t_ns
        if estimate is not None:
            self._outgoing.estimate(estimate, gyro_noise)
        age = self._incoming.inbox.waited + time.perf_counter() - taken
        if self._outgoing.map_due(t_ns):
            self._publish_map(slam)
        if self._outgoing.image_wanted(t_ns):
            self._outgoing.image(t_ns, slam.front_end.draw())
        self._diagnostics.processed(slam, estimate, {'publish': time.perf_counter() - began, 'since arrival': age})

    def _publish_map(self, slam: Slam | LineMapper) -> None:
        if slam.line_map.version != self._map_version:
            self._map_version = slam.line_map.version
            self._send_lines(slam.line_map.segments(), slam.active_lines())
        if self._outgoing.points_wanted:
            self._outgoing.points(self._newest_ns, slam.points())

    def _send_lines(self, whole: LineSegments, active: LineSegments) -> None:
        self.executor.create_task(self._outgoing.lines, self._newest_ns, whole, active)

    def _reset(self, reason: str) -> None:
        """Start estimate and map again; call it with ``_in_use`` held."""
        self.get_logger().warning(f'reset: {reason}')
        if self._slam is not None:
            self._slam.reset(reason)
            self._slam.line_map.clear()
            self._map_version = self._slam.line_map.version
            self._outgoing.reset()
            self._send_lines(LineSegments.empty(), LineSegments.empty())

    def _every_second(self) -> None:
        if self._saving.died or self._incoming.failed:  # as with the worker: what cannot go on ends, with a traceback
            self.thread_failed = True
            self.context.try_shutdown()
            return
        for note in self._incoming.inbox.notes():
            self.get_logger().warning(note)
            self._diagnostics.remember(note)
        self._publish_rest()
        self._diagnostics.publish()

    def _publish_rest(self) -> None:
        """What the last frames changed in the map, should no more come."""
        slam = self._slam
        if slam is None or not self._newest_ns or not self._in_use.acquire(blocking=False):
            return
        try:
            if slam.line_map.version != self._map_version:
                self._publish_map(slam)
        finally:
            self._in_use.release()

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self._in_use:
            self._reset('asked for by ~/reset')
        response.success, response.message = True, 'estimate and map start again'
        return response

    def _on_save_map(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            path = Path(self.get_parameter('node.map_path').value).expanduser()
            response.message = self._save_map(path.absolute())
            response.success = True
        except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: the home of nobody
            response.message = f'map not saved: {error}'
        return response

    def _save_map(self, path: Path) -> str:
        if self._slam is None:
            raise ValueError('there is no map yet')
        with self._in_use:
            segments = self._slam.line_map.segments()
        ply, csv = Path(f'{path}.ply'), Path(f'{path}.csv')
        write_ply(ply, segments)
        write_csv(csv, segments, SAVING_PAUSE_S)
        return f'{len(segments)} lines written to {ply} and {csv}'


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; 0 after SIGINT or SIGTERM, 1 when parameters are unusable or the worker died."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    cv2.setNumThreads(1)  # as replay; the other core is for the executor
    signal.signal(signal.SIGINT, lambda *_: None)  # rclpy ends the executor; Python's exception could hit it anywhere
    rclpy.init(args=args)
    try:
        node = LineSlamNode()
    except ValueError as error:
        rclpy.logging.get_logger(NODE_NAME).fatal(str(error))
        rclpy.try_shutdown()
        return 1
    spin(node)
    return int(node.thread_failed)


def spin(node: LineSlamNode) -> None:
    """Serves the node until it is told to stop; every way out leaves ROS cleanly."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    node.start()
    try:
        executor.spin()
    except ExternalShutdownException:
        pass
    except RCLError:  # a signal in the middle of waiting
        if rclpy.ok():
            raise
    finally:
        node.stop()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    raise SystemExit(main())
