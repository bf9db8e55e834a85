"""What the node knows about itself: arrivals, recent problems, latencies. No ROS here."""
from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from line_slam_ros.types import RigCorrection

Clock = Callable[[], float]


@dataclass
class Stream:
    """Arrivals of one subscribed topic."""

    what: str  # for people: 'images'
    topic: str  # resolved
    remap: str  # the name to remap
    total: int = 0
    last: float = 0.0  # s, when it last arrived or was first waited for
    hz: float = 0.0  # as last measured
    _recent: int = 0  # arrivals since

    def arrived(self, now: float) -> None:
        self.total, self._recent, self.last = self.total + 1, self._recent + 1, now

    def measure(self, seconds: float) -> float:
        """Sets and returns ``hz``, the rate since the last call, which was ``seconds`` ago."""
        self.hz, self._recent = self._recent / seconds, 0
        return self.hz

    def silence(self, publishers: int) -> str:
        """Why nothing arrives, as far as can be told, and what to do."""
        if not publishers:
            return f'no {self.what}: nobody publishes {self.topic}; remap with --ros-args -r {self.remap}:=/your/topic'
        if not self.total:
            return (f'no {self.what}: {self.topic} has a publisher but nothing arrives; '
                    'compare its QoS with the parameter node.reliability')
        return f'{self.what} on {self.topic} stopped'


@dataclass
class Latency:
    """Wall times of the processed frames by stage, s."""

    frames: int = 0
    total: Counter[str] = field(default_factory=Counter)
    worst: dict[str, float] = field(default_factory=dict)

    def add(self, stages: Mapping[str, float]) -> None:
        """One frame."""
        self.frames += 1
        for stage, seconds in stages.items():
            self.total[stage] += seconds
            self.worst[stage] = max(self.worst.get(stage, 0.0), seconds)

    def summary(self) -> dict[str, str]:
        """'latency <stage>' -> mean and worst, for people."""
        return {f'latency {stage}': f'{1e3 * total / self.frames:.1f} ms, worst {1e3 * self.worst[stage]:.1f} ms'
                for stage, total in self.total.items()}


def refinement(rig: RigCorrection | None) -> dict[str, str]:
    """What was refined of the calibration, for people; nothing where none is."""
    return {} if rig is None else {
        'camera to IMU': f'refined by {rig.rotation_deg:.2f} deg, {1e3 * rig.shift_m:.1f} mm',
        'time offset': f'refined by {1e3 * rig.delay_s:.2f} ms'}


class Recent:
    """Sentences that stay in the diagnostics for a while after they were told."""

    def __init__(self, seconds: float, clock: Clock = time.monotonic) -> None:
        self._seconds, self._clock = seconds, clock
        self._told: dict[str, float] = {}  # sentence -> when

    def add(self, sentence: str) -> None:
        self._told[sentence] = self._clock()

    def sentences(self) -> list[str]:
        """Those still to be shown; the others are forgotten."""
        oldest = self._clock() - self._seconds
        self._told = {sentence: t for sentence, t in self._told.items() if t >= oldest}
        return list(self._told)
