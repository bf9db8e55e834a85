"""``/diagnostics`` once a second, data or no data."""
from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Protocol

import rclpy
from rclpy.node import Node

from line_slam_ros.nodes.health import Latency, Recent, refinement
from line_slam_ros.nodes.inputs import Inputs
from line_slam_ros.nodes.publishers import NO_EVENTS
from line_slam_ros.shell_config import ShellConfig
from line_slam_ros.types import Estimate, RigCorrection, Status
from msg_adapters import outputs
from msg_adapters.factories import ros_messages

REMEMBER_S = 12.0  # a note stays visible until the inbox may tell it again
LARGE_IMAGE_PIXELS = 512_000 // 3  # in colour, more than the default shared memory segment of Fast DDS holds
PROFILES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
HINT = ('images are lost on the way: the default shared memory of Fast DDS loses messages over 512 KB; set '
        'FASTRTPS_DEFAULT_PROFILES_FILE to config/fastdds_large_images.xml of this package for all nodes, or use '
        'image_transport: compressed')


class Estimator(Protocol):
    """What is read of Slam and LineMapper."""

    status: Status
    waiting_for: str
    resets: int
    timings: dict[str, float]

    def rig(self) -> RigCorrection | None: ...


class Diagnostics:
    """Collects in both threads (plain assignments and counters), publishes in the executor's."""

    def __init__(self, node: Node, inputs: Inputs, shell: ShellConfig) -> None:
        self._node, self._inputs, self._shell = node, inputs, shell
        self._new = ros_messages()
        kind = self._new.type('diagnostic_msgs/msg/DiagnosticArray')
        self._publisher = node.create_publisher(kind, '/diagnostics', 10, event_callbacks=NO_EVENTS)
        self.waiting_for = ''
        self.frames_behind = 0  # processed in a hurry, since the start
        self._status, self._resets, self._poses = Status.INITIALISING, 0, 0
        self._rig: RigCorrection | None = None
        self._latency = Latency()
        self._notes = Recent(REMEMBER_S)
        self._drops: Counter[str] = Counter()
        self._then, self._cpu_then = time.monotonic(), 0.0

    def processed(self, estimator: Estimator, estimate: Estimate | None, seconds: Mapping[str, float]) -> None:
        """The worker is done with a frame; seconds: what is timed outside the estimator."""
        self._status, self.waiting_for, self._resets = estimator.status, estimator.waiting_for, estimator.resets
        self._rig = estimator.rig()
        self._latency.add({**estimator.timings, **seconds})
        self._poses += estimate is not None

    def remember(self, note: str) -> None:
        """Something the human should read; shown for REMEMBER_S seconds."""
        self._notes.add(note)

    def publish(self) -> None:
        """Rates and latencies are those since the last call."""
        now, cpu = time.monotonic(), time.thread_time()
        seconds = now - self._then
        latency, self._latency = self._latency, Latency()
        poses, self._poses = self._poses, 0
        values = {name: f'{stream.measure(seconds):.1f} Hz' for name, stream in self._inputs.streams.items()}
        warnings = list(self._warnings(now))
        values |= {'frames processed': f'{latency.frames / seconds:.1f} Hz', 'poses': f'{poses / seconds:.1f} Hz',
                   'frames waiting': str(self._inputs.inbox.ready), 'frames behind': str(self.frames_behind),
                   'resets': str(self._resets), 'executor CPU': f'{100 * (cpu - self._cpu_then) / seconds:.0f} %',
                   **refinement(self._rig), **latency.summary(),
                   **{f'dropped: {reason}': str(n) for reason, n in self._drops.items()}}
        self._then, self._cpu_then = now, cpu
        stamp = self._node.get_clock().now().nanoseconds
        self._publisher.publish(outputs.diagnostics(self._new, stamp, self._status, self.waiting_for, values,
                                                    self._node.get_name(), warnings))

    def _warnings(self, now: float) -> Iterator[str]:
        yield from filter(None, (self._inputs.problem,))
        yield from self._inputs.silent(now)
        if self._large_images_vanish(now):
            yield HINT
        yield from self._notes.sentences()
        drops, before = Counter(self._inputs.inbox.drops), self._drops
        self._drops = drops
        yield from (f'{n} times in the last second: {reason}' for reason, n in (drops - before).items())

    def _large_images_vanish(self, now: float) -> bool:
        """Whether raw images are published but hardly any arrives, in a set-up known to lose large ones."""
        known = ('fastrtps' in rclpy.get_rmw_implementation_identifier() and self._shell.image_transport != 'compressed'
                 and not any(name in os.environ for name in PROFILES))
        image, info = (self._inputs.streams.get(name) for name in ('image', 'camera_info'))
        if not known or image is None or self._inputs.pixels < LARGE_IMAGE_PIXELS:
            return False
        few = (image.hz < 0.5 * info.hz if info is not None and info.hz >= 2.0 else
               image.total == 0 and now - image.last > self._shell.node.input_timeout)
        return few and self._node.count_publishers(image.topic) > 0
