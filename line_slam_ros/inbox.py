"""Pairs each frame with the inertial samples (or the pose) that reach past it; the same for the node and for replay.

Threads: any may put messages in, one takes pairs out. Bad input never raises: it is dropped, counted by reason and told
to the human. Frame stamps are moved into the clock of the IMU on entry (``time_offset``), so everything behind the
inbox lives in one clock.
"""
from __future__ import annotations

import math
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import replace
from typing import Generic, TypeVar

from line_slam_ros.imu_buffer import GapDetector, ImuBuffer, UnitCheck, Vector
from line_slam_ros.notes import Notes
from line_slam_ros.pose_buffer import PoseBuffer
from line_slam_ros.types import F64, Frame, ImuBatch

Companion = TypeVar('Companion')
_JUMP_NS = 1_000_000_000  # stamps going back by more are a restarted source, by less a late message


class FrameInbox(ABC, Generic[Companion]):
    """Frames waiting for their companion: what Inbox and PoseInbox share."""

    _companion_name: str

    def __init__(self, max_frames: int, time_offset: float = 0.0, size: tuple[int, int] | None = None) -> None:
        """max_frames wait at most; time_offset = t_imu - t_camera in s; size (width, height) if it is to be checked."""
        self.drops: Counter[str] = Counter()  # reason -> messages dropped or missing
        self.jumped = False  # whether the pair handed out last is the first since time jumped back
        self.waited = 0.0  # s, since the frame handed out last came in
        self._max_frames, self._offset_ns, self._size = max_frames, round(time_offset * 1e9), size
        self._frames: deque[Frame] = deque()
        self._arrivals: deque[float] = deque()  # of these frames, s
        self._newest_frame = -1
        self._jump_pending = self._closed = False
        self._notes = Notes()
        self._changed = threading.Condition()

    def frame(self, frame: Frame) -> None:
        """A frame came in."""
        with self._changed:
            t_ns = frame.t_ns + self._offset_ns
            if self._has_wrong_size(frame) or not self._in_order(t_ns, self._newest_frame, 'image'):
                return
            self._newest_frame = t_ns
            if len(self._frames) == self._max_frames:
                self._drop_oldest()
            self._frames.append(replace(frame, t_ns=t_ns))
            self._arrivals.append(time.monotonic())
            self._wake_if_ready()

    @property
    def ready(self) -> int:
        """Frames that wait though they could be taken: more than none, and the taker is late."""
        with self._changed:
            newest = self._newest_companion()
            return sum(frame.t_ns <= newest for frame in self._frames)

    def expect_size(self, size: tuple[int, int]) -> None:
        """Check (width, height) from now on; a live calibration may come after the first messages."""
        with self._changed:
            self._size = size

    def take(self) -> tuple[Frame, Companion] | None:
        """The oldest frame with its companion, or None if none is ready; does not block."""
        with self._changed:
            return self._next_pair()

    def __iter__(self) -> Iterator[tuple[Frame, Companion]]:
        """Pairs as they become ready; blocks in between, ends after close()."""
        while True:
            with self._changed:
                while (pair := self._next_pair()) is None and not self._closed:
                    self._changed.wait()
            if pair is None:
                return
            yield pair

    def close(self) -> None:
        """No more messages come: frames that are ready can still be taken, the others are counted as dropped."""
        with self._changed:
            newest = self._newest_companion()
            while self._frames and self._frames[-1].t_ns > newest:
                self._arrivals.pop()
                self._explain_missing(self._frames.pop().t_ns)
            self._closed = True
            self._changed.notify_all()

    def reject(self, reason: str, sentence: str, t_ns: int) -> None:
        """Count a message that the shell could not use, and tell the human why."""
        with self._changed:
            self._reject(reason, sentence, t_ns)

    def notes(self) -> list[str]:
        """New sentences for the human."""
        with self._changed:
            return self._notes.take()

    @abstractmethod
    def _newest_companion(self) -> int:
        """Stamp of the newest companion message, -1 if there is none."""

    @abstractmethod
    def _companion(self, t_ns: int) -> Companion | None:
        """The companion of a frame that the newest message has reached."""

    @abstractmethod
    def _clear_companions(self) -> None: ...

    def _next_pair(self) -> tuple[Frame, Companion] | None:
        while self._frames and self._frames[0].t_ns <= self._newest_companion():
            frame, arrival = self._frames.popleft(), self._arrivals.popleft()
            companion = self._companion(frame.t_ns)
            if companion is not None:
                self.jumped, self._jump_pending = self._jump_pending, False
                self.waited = time.monotonic() - arrival
                return frame, companion
            self._reject(f'image without {self._companion_name}',
                         f'no {self._companion_name} data for an image: it came before the first message or in a gap',
                         frame.t_ns)
        return None

    def _in_order(self, t_ns: int, newest: int, what: str) -> bool:
        """Whether to take the message: later than the newest, or so much earlier that the source has started again."""
        if t_ns > newest:
            return True
        if newest - t_ns > _JUMP_NS:
            self._jump_back((newest - t_ns) * 1e-9, what, t_ns)
            return True
        self._reject(f'{what} stamp not increasing',
                     f'{what} stamps must increase: {t_ns} came after {newest} (ns); dropped. Check the driver, or '
                     'whether two publishers share the topic', t_ns)
        return False

    def _jump_back(self, seconds: float, what: str, t_ns: int) -> None:
        self.drops['image waiting when time jumped back'] += len(self._frames)
        self._frames.clear()
        self._arrivals.clear()
        self._clear_companions()
        self._newest_frame, self._jump_pending = -1, True
        self._notes.tell('jump', f'{what} time jumped back by {seconds:.1f} s: starting again', t_ns)

    def _has_wrong_size(self, frame: Frame) -> bool:
        height, width = frame.image.shape
        if self._size is None or (width, height) == self._size:
            return False
        self._reject('image size differs from the calibration',
                     f'image is {width}x{height}, the calibration is for {self._size[0]}x{self._size[1]}: calibrate at '
                     'the size that is published', frame.t_ns)
        return True

    def _drop_oldest(self) -> None:
        self._arrivals.popleft()
        t_ns = self._frames.popleft().t_ns
        if t_ns > self._newest_companion():
            self._explain_missing(t_ns)
        else:
            self._reject('image too many', 'images come faster than they are processed: the oldest one waiting is '
                         'dropped. Lower the camera rate, points.max_count or lines.max_count', t_ns)

    def _explain_missing(self, t_ns: int) -> None:
        name, newest = self._companion_name, self._newest_companion()
        cause = (f'no {name} message has come: check the topic name and that it is published' if newest < 0 else
                 f'its {name} messages end {(t_ns - newest) * 1e-9:.2f} s before it')
        self._reject(f'image without {name}', f'image dropped: {cause}', t_ns)

    def _wake_if_ready(self) -> None:
        if self._frames and self._frames[0].t_ns <= self._newest_companion():
            self._changed.notify()

    def _reject(self, reason: str, sentence: str, t_ns: int) -> None:
        self.drops[reason] += 1
        self._notes.tell(reason, sentence, t_ns)


class Inbox(FrameInbox[ImuBatch]):
    """Frames and inertial samples in, (frame, ImuBatch) out."""

    _companion_name = 'IMU'

    def __init__(self, max_frames: int, time_offset: float = 0.0, size: tuple[int, int] | None = None,
                 accel_scale: float = 1.0, imu_capacity: int = 8192) -> None:
        """imu_capacity samples are kept at most; accel_scale turns the accelerometer's unit into m/s^2."""
        super().__init__(max_frames, time_offset, size)
        self._buffer, self._gaps, self._units = ImuBuffer(imu_capacity), GapDetector(), UnitCheck()
        self._accel_scale, self._taken_until = accel_scale, -1

    def imu(self, t_ns: int, gyro_B: Vector, accel_B: Vector) -> None:
        """An inertial sample came in: rad/s and m/s^2 (times accel_scale)."""
        with self._changed:
            if not math.isfinite(sum(gyro_B) + sum(accel_B)):
                self._reject('IMU not finite', f'IMU sample holds NaN or infinity ({gyro_B}, {accel_B}); dropped. '
                             'Check the driver', t_ns)
                return
            newest = self._buffer.newest
            if not self._in_order(t_ns, newest, 'IMU'):
                return
            self._watch_gap(t_ns, newest)
            accel_B = tuple(self._accel_scale * a for a in accel_B)
            if complaint := self._units.complaint(gyro_B, accel_B):
                self._notes.tell('IMU units', complaint, t_ns)
            self._buffer.push(t_ns, gyro_B, accel_B)
            self._wake_if_ready()

    def _watch_gap(self, t_ns: int, newest: int) -> None:
        if 0 <= newest < t_ns and self._gaps.is_gap(t_ns - newest):
            self._reject('IMU gap', f'IMU data missing for {(t_ns - newest) * 1e-9:.3f} s: the estimate is uncertain '
                         'there. Check the driver, the load, or use reliable QoS', t_ns)

    def _newest_companion(self) -> int:
        return self._buffer.newest

    def _companion(self, t_ns: int) -> ImuBatch | None:
        batch = self._buffer.take_until(t_ns)
        if batch is not None:
            if 0 <= self._taken_until < batch.t_ns[0]:
                self._reject('IMU forgotten', 'no image for so long that IMU data was forgotten: check the camera',
                             t_ns)
            self._taken_until = t_ns
        return batch

    def _clear_companions(self) -> None:
        self._buffer.clear()
        self._taken_until = -1


class PoseInbox(FrameInbox[F64]):
    """Frames and poses in, (frame, T_WB at its time) out: for ``pose_source: topic``."""

    _companion_name = 'pose'

    def __init__(self, max_frames: int, time_offset: float = 0.0, size: tuple[int, int] | None = None,
                 pose_capacity: int = 8192) -> None:
        super().__init__(max_frames, time_offset, size)
        self._buffer = PoseBuffer(pose_capacity)

    def pose(self, t_ns: int, T_WB: F64) -> None:
        """A pose of the body came in."""
        with self._changed:
            if self._in_order(t_ns, self._buffer.newest, 'pose'):
                self._buffer.push(t_ns, T_WB)
                self._wake_if_ready()

    def _newest_companion(self) -> int:
        return self._buffer.newest

    def _companion(self, t_ns: int) -> F64 | None:
        return self._buffer.at(t_ns)

    def _clear_companions(self) -> None:
        self._buffer.clear()
