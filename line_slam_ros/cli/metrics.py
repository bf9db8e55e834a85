"""How a run went: counts, times per stage, status changes."""
from __future__ import annotations

import time
from collections import Counter
from dataclasses import asdict
from typing import Any

import numpy as np

from line_slam_ros.types import Estimate


class Metrics:
    """Counts frame by frame; ``report`` is what metrics.json holds."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self.frames = self.estimates = self.keyframes = 0
        self.last_ns = 0  # of the newest frame
        self._settings = settings
        self._sensor_ns = 0  # time covered, without jumps back
        self._first_estimate_after: float | None = None  # s
        self._status_changes: list[dict[str, Any]] = []
        self._stages: dict[str, list[float]] = {}  # s
        self._began = self._ended = time.perf_counter()

    def add(self, t_ns: int, estimate: Estimate | None, slam: Any) -> None:
        """One processed frame and the SLAM (or LineMapper) as it left it."""
        self._sensor_ns += max(t_ns - self.last_ns, 0) if self.frames else 0
        self.last_ns = t_ns
        self.frames += 1
        self._ended = time.perf_counter()
        for stage, seconds in slam.timings.items():
            self._stages.setdefault(stage, []).append(seconds)
        if estimate is not None:
            self.estimates += 1
            self.keyframes += estimate.is_keyframe
            if self.estimates == 1:
                self._first_estimate_after = self._sensor_ns * 1e-9
        if not self._status_changes or self._status_changes[-1]['status'] != slam.status.value:
            self._status_changes.append({'t_ns': t_ns, 'status': slam.status.value, 'waiting_for': slam.waiting_for})

    def counts(self, drops: Counter[str]) -> dict[str, int]:
        """Everything countable so far, without wall-clock times."""
        return {'frames': self.frames, 'estimates': self.estimates, 'keyframes': self.keyframes,
                **{f'dropped: {reason}': n for reason, n in sorted(drops.items())}}

    def report(self, lines: int, drops: Counter[str], notes: list[str], slam: Any) -> dict[str, Any]:
        """All of it, ready for JSON; times in ms unless the name says otherwise."""
        wall, sensor = self._durations()
        rig = slam.rig()
        return {
            'frames': self.frames, 'estimates': self.estimates, 'keyframes': self.keyframes, 'lines': lines,
            'resets': slam.resets, 'status': slam.status.value, 'waiting_for': slam.waiting_for,
            'duration_s': sensor, 'first_estimate_after_s': self._first_estimate_after,
            'rig': rig and asdict(rig), 'wall_s': wall, 'times_real_time': sensor / wall if wall > 0.0 else None,
            'stages_ms': {stage: _percentiles(values) for stage, values in self._stages.items()},
            'drops': dict(sorted(drops.items())), 'status_changes': self._status_changes, 'notes': notes,
            'settings': self._settings}

    def summary(self, lines: int, drops: Counter[str]) -> str:
        """Two or three lines for the human."""
        wall, sensor = self._durations()
        text = f'{self.frames} frames, {self.estimates} poses, {lines} lines; {sensor:.1f} s of data in {wall:.1f} s'
        if 'total' in self._stages:
            total = _percentiles(self._stages['total'])
            text += f'; per frame {total["p50"]:.1f} ms (median), {total["p95"]:.1f} ms (95 %)'
        if drops:
            text += '\ndropped: ' + ', '.join(f'{n} x {reason}' for reason, n in sorted(drops.items()))
        return text

    def _durations(self) -> tuple[float, float]:
        """Seconds on the wall until the last frame, and of sensor time."""
        return self._ended - self._began, self._sensor_ns * 1e-9


def _percentiles(seconds: list[float]) -> dict[str, float]:
    p50, p95, top = np.percentile(seconds, [50, 95, 100]) * 1e3
    return {'p50': round(p50, 3), 'p95': round(p95, 3), 'max': round(top, 3), 'count': len(seconds)}
