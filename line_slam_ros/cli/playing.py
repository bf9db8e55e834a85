"""The run behind ``line_slam play``: one thread that publishes on time and hears the node in between."""
from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Iterator

import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from tqdm import tqdm

from line_slam_ros.cli.bag_reader import Bag, open_bag
from line_slam_ros.cli.listener import Listener
from msg_adapters import outputs
from msg_adapters.factories import ros_messages

_CLOCK_PERIOD_NS = 10_000_000
_LATE_S = 0.1  # that a message may be behind the schedule
_QUEUE = 1000  # messages that a reliable reader may lag behind
_DELIVERY = Duration(seconds=2)
_SENSORS = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage', 'sensor_msgs/msg/Imu')


def play(args: argparse.Namespace) -> int:
    """0 if all went well; 1 if nobody subscribed, or the node that was listened to published no pose."""
    with open_bag(args.bag) as bag:
        rclpy.init(args=[])
        session = Session(args, bag)
        try:
            return session.run()
        except ExternalShutdownException:
            return 130
        finally:
            session.node.destroy_node()
            rclpy.try_shutdown()


class Session:
    """Player and listener on one ROS node and one executor."""

    def __init__(self, args: argparse.Namespace, bag: Bag) -> None:
        self._args, self._bag = args, bag
        self.node = rclpy.create_node('line_slam_play')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._player = Player(self.node, bag, args.clock)

    def run(self) -> int:
        """Wait for subscribers, play, wait for what is still to come, keep it."""
        with Listener(self.node, self._args.node, self._args.output) as listener:
            if not self._is_awaited():
                _tell(f'nobody subscribes to {", ".join(self._bag.types)}: start line_slam_node with topics remapped')
                return 1
            self._play_once(listener)
            while self._args.loop:
                self._play_once(listener)
            self._hear_the_rest(listener)
            if not listener.poses and (listener.is_connected or self._args.output):
                _tell(f'{self._args.node} published no pose: {listener.diagnosis or "no diagnostics came either"}')
                return 1
            if self._args.output:
                print(f'{len(listener.poses)} poses; {listener.save_map(self._executor)}')
        return 0

    def _play_once(self, listener: Listener) -> None:
        whole = self._args.start == 0.0 and self._args.duration == float('inf')
        total = self._bag.counts.total() if whole else None
        with tqdm(total=total, unit='msg', desc='play', dynamic_ncols=True, mininterval=0.5) as progress:
            args = self._args
            for due, topic, t_ns, data in schedule(self._bag.log(), args.start, args.duration, args.rate):
                self._spin_until(due)
                listener.now_ns = t_ns
                self._player.publish(topic, t_ns, data)
                progress.set_postfix(poses=len(listener.poses), lines=listener.lines, refresh=False)
                progress.update()

    def _is_awaited(self) -> bool:
        """Whether somebody subscribed in time; the other topics of that node get half a second more to be found."""
        deadline = time.monotonic() + self._args.wait
        while not self._player.is_heard():
            if time.monotonic() > deadline:
                return False
            self._spin_until(time.monotonic() + 0.1)
        self._spin_until(time.monotonic() + 0.5)
        return True

    def _hear_the_rest(self, listener: Listener) -> None:
        """Until everything has been delivered, no pose has come for two seconds and no image waits in the node."""
        self._player.finish()
        before = -1
        while listener.is_connected and (len(listener.poses) > before or listener.frames_waiting):
            before = len(listener.poses)
            self._spin_until(time.monotonic() + 2.0)

    def _spin_until(self, due: float) -> None:
        while (remaining := due - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=remaining)


def schedule(log: Iterable[tuple[str, int, bytes]], start: float, duration: float,
             rate: float) -> Iterator[tuple[float, str, int, bytes]]:
    """(when on the monotonic clock, topic, log time, CDR) of those messages of log, (topic, log time in ns, CDR), that
    begin start (s) after the first and last for duration (s), rate times as fast as recorded.

    What comes late, for instance on a busy machine, is not made up for at once: a burst overflows the readers' queues.
    """
    first_ns = began = None
    for topic, t_ns, data in log:
        first_ns = t_ns if first_ns is None else first_ns
        seconds = (t_ns - first_ns) * 1e-9 - start
        if seconds > duration:
            return
        if seconds >= 0:
            now = time.monotonic() - seconds / rate
            began = now if began is None else max(began, now - _LATE_S)
            yield began + seconds / rate, topic, t_ns, data


class Player:
    """Publishes messages of a bag as the bytes they are."""

    def __init__(self, node: Node, bag: Bag, with_clock: bool) -> None:
        self._node, self._types, self._new = node, bag.types, ros_messages()
        self._publishers = {topic: publisher for topic, kind in bag.types.items()
                            if (publisher := self._advertise(topic, kind)) is not None}
        self._clock = self._advertise('/clock', 'rosgraph_msgs/msg/Clock') if with_clock else None
        self._clock_due = -_CLOCK_PERIOD_NS

    def is_heard(self) -> bool:
        """Whether somebody subscribes to a sensor's topic, or to any if the bag has no sensor."""
        sensors = [p for topic, p in self._publishers.items() if self._types[topic] in _SENSORS]
        return any(p.get_subscription_count() for p in sensors or self._publishers.values())

    def publish(self, topic: str, t_ns: int, data: bytes) -> None:
        """The message, and before it the time if that is due."""
        if self._clock is not None and not 0 <= self._clock_due - t_ns <= _CLOCK_PERIOD_NS:
            self._clock.publish(outputs.clock(self._new, t_ns))
            self._clock_due = t_ns + _CLOCK_PERIOD_NS
        if topic in self._publishers:
            self._publishers[topic].publish(data)

    def finish(self) -> None:
        """Waits until reliable readers have what was sent; leaving earlier would take it from them."""
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(_DELIVERY)

    def _advertise(self, topic: str, kind: str) -> Publisher | None:
        try:
            return self._node.create_publisher(self._new.type(kind), topic, _QUEUE)
        except ImportError as error:
            _tell(f'{topic} is not played: {error}')
            return None


def _tell(sentence: str) -> None:
    tqdm.write(f'line_slam play: {sentence}', file=sys.stderr)
