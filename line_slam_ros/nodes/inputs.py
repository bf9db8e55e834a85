"""What the node hears: sensor messages converted, checked and put into the inbox; the calibration they come with."""
from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu

from line_slam_ros.calibration import checked_rigid, read_imu_noise, read_kalibr
from line_slam_ros.inbox import Inbox, PoseInbox
from line_slam_ros.nodes.health import Stream
from line_slam_ros.nodes.polling import Polled, Poller
from line_slam_ros.shell_config import ShellConfig
from line_slam_ros.types import F64, Calibration, Frame, ImuNoise
from msg_adapters import sensors

NO_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)  # they cost as much as messages; see publishers.py


class Inputs:
    """Subscriptions, served by the executor's thread; the worker takes frames from ``inbox``.

    The calibration comes from a file or from the first usable ``camera_info``; until then the newest images wait.
    """

    def __init__(self, node: Node, shell: ShellConfig, calibrated: Callable[[Calibration], None]) -> None:
        """``calibrated`` is called once, when the calibration is known: at once, or in the executor's thread."""
        self._node, self._shell, self._calibrated = node, shell, calibrated
        self.streams: dict[str, Stream] = {}
        self.problem = ''  # why there cannot be a calibration
        self.pixels = 0  # of an image, as far as known
        self._waits_for_calibration = True
        self._early: deque[Frame] = deque(maxlen=shell.max_frames)
        self._poller: Poller | None = None
        self._rig: tuple[F64, ImuNoise] | None = None  # T_BC and noise, for camera_info
        from_file = self._read_files()
        offset = from_file.time_offset if from_file else shell.time_offset
        self.inbox: Inbox | PoseInbox = (PoseInbox(shell.max_frames, offset) if shell.pose_source == 'topic' else
                                         Inbox(shell.max_frames, offset, accel_scale=shell.accel_scale))
        if from_file:
            self._accept(from_file)

    def subscribe(self) -> None:
        """From now on messages come in."""
        if self._shell.image_transport == 'compressed':  # as image_transport does, follow a remap of image
            image = self._node.resolve_topic_name('image') + '/compressed'
            self._listen('image', image, CompressedImage, 'images', self._on_compressed)
        else:
            self._listen('image', 'image', Image, 'images', self._on_image)
        if self._waits_for_calibration:
            self._listen('camera_info', 'camera_info', CameraInfo, 'camera_info', self._on_camera_info)
        if self._shell.pose_source == 'topic':
            self._listen('pose', 'pose', PoseStamped, 'poses', self._on_pose)
            self._listen('odometry', 'odometry', Odometry, 'poses', self._on_pose)
        else:
            self._listen('imu', 'imu', Imu, 'IMU data', self._on_imu, polled=True)

    def close(self) -> None:
        """No more messages; frames that are ready can still be taken."""
        if self._poller is not None:
            self._poller.stop()
        self.inbox.close()

    def silent(self, now: float) -> list[str]:
        """What is missing and what to do about it, one sentence for each topic; now is time.monotonic()."""
        quiet = {name: s for name, s in self.streams.items() if now - s.last > self._shell.node.input_timeout}
        if {'pose', 'odometry'} & self.streams.keys() - quiet.keys():  # one of them is enough
            quiet = {name: s for name, s in quiet.items() if name not in ('pose', 'odometry')}
        return [s.silence(self._node.count_publishers(s.topic)) for s in quiet.values()]

    @property
    def failed(self) -> bool:
        """Whether the thread that takes IMU data has ended by an exception."""
        return self._poller is not None and self._poller.died

    def _listen(self, name: str, topic: str, kind: type, what: str, callback: Callable[[Any], None],
                polled: bool = False) -> None:
        """A polled topic's messages are handed over serialised, past the executor."""
        reliability = ReliabilityPolicy[self._shell.node.reliability.upper()]
        depth = max(self._shell.max_frames, 10) if name == 'image' else 2000  # that wait while the executor is busy
        qos = QoSProfile(depth=depth, reliability=reliability)
        stream = Stream(what, self._node.resolve_topic_name(topic), name, last=time.monotonic())

        def arrived(msg: Any) -> None:
            stream.arrived(time.monotonic())
            try:
                callback(msg)
            except ValueError as error:
                self.inbox.reject(f'{name} not usable', str(error), 0 if polled else sensors.stamp_ns(msg))

        subscription = self._node.create_subscription(kind, topic, arrived, qos, event_callbacks=NO_EVENTS, raw=polled,
                                                      callback_group=Polled() if polled else None)
        if polled:
            self._poller = Poller.of_messages(subscription)
        self.streams[name] = stream

    def _on_image(self, msg: Image) -> None:
        self._frame(sensors.image_to_frame(msg))

    def _on_compressed(self, msg: CompressedImage) -> None:
        self._frame(sensors.compressed_to_frame(msg))

    def _frame(self, frame: Frame) -> None:
        if not self._waits_for_calibration:
            self.inbox.frame(frame)
            return
        if len(self._early) == self._early.maxlen:
            self.inbox.drops['image before calibration'] += 1
        self._early.append(frame)

    def _on_imu(self, msg: bytes) -> None:
        self.inbox.imu(*sensors.imu_of_cdr(msg))

    def _on_pose(self, msg: PoseStamped | Odometry) -> None:
        self.inbox.pose(*sensors.pose_from_msg(msg))

    def _on_camera_info(self, msg: CameraInfo) -> None:
        if self._waits_for_calibration and self._rig:
            T_BC, noise = self._rig
            self._accept(sensors.camera_info_to_calibration(msg, T_BC, self._shell.time_offset, noise))

    def _accept(self, calibration: Calibration) -> None:
        self._waits_for_calibration = False
        self.inbox.expect_size((calibration.width, calibration.height))
        self.pixels = calibration.width * calibration.height
        self._calibrated(calibration)
        while self._early:
            self.inbox.frame(self._early.popleft())

    def _read_files(self) -> Calibration | None:
        """The whole calibration if a file holds it; else what ``camera_info`` does not tell is kept."""
        shell = self._shell
        try:
            if shell.calibration_file:
                return read_kalibr(shell.calibration_file, shell.imu_calibration_file, shell.camera_name)
            if not shell.T_body_camera:
                raise ValueError('where the camera sits on the body is unknown: set calibration_file (Kalibr '
                                 'camchain-imucam.yaml) or T_body_camera (16 numbers) and start again')
            noise = read_imu_noise(shell.imu_calibration_file) if shell.imu_calibration_file else ImuNoise()
            self._rig = checked_rigid(shell.T_body_camera, 'T_body_camera'), noise
        except (OSError, ValueError) as error:
            self.problem = f'no calibration: {error}'
            self._node.get_logger().error(self.problem)
        return None
