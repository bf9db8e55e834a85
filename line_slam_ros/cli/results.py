"""What a run leaves behind: trajectory.tum, lines.csv, lines.ply, output.mcap, metrics.json, figure.png."""
from __future__ import annotations

import json
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

from line_slam_ros.cli.bag_writer import mcap_file
from line_slam_ros.cli.metrics import Metrics
from line_slam_ros.cli.recording import Recording
from line_slam_ros.config import leaves
from line_slam_ros.geometry.lie import quaternion_from_matrix
from line_slam_ros.inbox import FrameInbox
from line_slam_ros.mapping.io import write_csv, write_ply
from line_slam_ros.ros_conventions import gyro_variance
from line_slam_ros.shell_config import ShellConfig
from line_slam_ros.types import F64, U8, Estimate, ImuBatch


class TumWriter(AbstractContextManager['TumWriter']):
    """Poses as lines ``t x y z qx qy qz qw`` (s, m), nanosecond stamps kept exactly."""

    def __init__(self, path: Path) -> None:
        self._file = path.open('w', encoding='ascii')

    def add(self, t_ns: int, T_WB: F64) -> None:
        numbers = ' '.join(f'{v:.9f}' for v in (*T_WB[:3, 3], *quaternion_from_matrix(T_WB[:3, :3])))
        self._file.write(f'{t_ns // 10**9}.{t_ns % 10**9:09d} {numbers}\n')

    def __exit__(self, *_: object) -> None:
        self._file.close()


class Results(AbstractContextManager['Results']):
    """Collects a run frame by frame, in core types, and writes everything into one directory.

    On leaving the context the map, the figure and the metrics are written, also after an interruption.
    """

    def __init__(self, directory: Path, shell: ShellConfig, settings: dict[str, Any], slam: Any,
                 inbox: FrameInbox, with_figure: bool = True) -> None:
        """``slam`` is a Slam or LineMapper; OSError if the directory cannot be made."""
        directory.mkdir(parents=True, exist_ok=True)
        self.notes: list[str] = []
        self._directory, self._slam, self._inbox = directory, slam, inbox
        self._metrics, self._with_figure = Metrics(settings), with_figure
        self._positions: list[F64] = []
        self._best_image: U8 | None = None
        self._most_lines = -1
        self._files = ExitStack()
        self._trajectory = self._files.enter_context(TumWriter(directory / 'trajectory.tum'))
        writer = self._files.enter_context(mcap_file(directory / 'output.mcap'))
        self._recording = Recording(writer, shell.odom_frame, shell.body_frame)

    @property
    def estimates(self) -> int:
        return self._metrics.estimates

    def add(self, t_ns: int, imu: ImuBatch | None, estimate: Estimate | None) -> None:
        """One processed frame."""
        self._metrics.add(t_ns, estimate, self._slam)
        self._recording.state(t_ns, self._slam, self._metrics.counts(self._inbox.drops))
        if estimate is not None:
            self._trajectory.add(estimate.t_ns, estimate.T_WB)
            self._positions.append(estimate.T_WB[:3, 3])
            variance = 0.0 if imu is None else gyro_variance(self._slam.calibration.imu_noise, imu)
            self._recording.estimate(estimate, variance)
            if self._with_figure:
                self._keep_best_image(estimate)

    def summary(self) -> str:
        """A few lines for the human."""
        return self._metrics.summary(len(self._slam.line_map.segments()), self._inbox.drops)

    def reason(self) -> str:
        """Why there is no estimate, in one sentence."""
        if self._metrics.frames == 0:
            return '; '.join(self.notes) or 'no image could be paired with motion data'
        return f'waiting for {self._slam.waiting_for}'

    def __exit__(self, *_: object) -> None:
        segments = self._slam.line_map.segments()
        if self._metrics.frames:
            self._recording.finish(self._metrics.last_ns, self._slam)
        self._files.close()
        write_csv(self._directory / 'lines.csv', segments)
        write_ply(self._directory / 'lines.ply', segments)
        if self._positions and self._with_figure:
            from line_slam_ros.cli import figure  # half a second of Matplotlib
            figure.save(self._directory / 'figure.png', self._best_image, self._positions, segments)
        report = self._metrics.report(len(segments), self._inbox.drops, self.notes, self._slam)
        (self._directory / 'metrics.json').write_text(json.dumps(report, indent=2) + '\n', encoding='utf-8')

    def _keep_best_image(self, estimate: Estimate) -> None:
        """Of all keyframes, the image whose window holds the most lines goes into the figure."""
        count = len(self._slam.active_lines()) if estimate.is_keyframe else -1
        if count > self._most_lines:
            self._most_lines, self._best_image = count, self._slam.front_end.draw()


def settings_of(*parts: Any) -> dict[str, Any]:
    """Flat name -> value of configurations, for the record."""
    return {name: value for part in parts for name, _, value in leaves(part)}
