"""A trajectory and a line map against the truth. Trajectory figures are evo's (M. Grupp), only put together here."""
from __future__ import annotations

import copy
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from evo.core import metrics, sync
from evo.core.filters import FilterException
from evo.core.geometry import GeometryException
from evo.core.metrics import PoseRelation
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface

from line_slam_ros.geometry.lie import rigid, transform_points
from line_slam_ros.mapping.io import read_csv
from line_slam_ros.mapping.metrics import LineScore, score
from line_slam_ros.types import F64

MATCH = 0.01  # s, largest difference between matched stamps
STILL_SPEED = 0.02  # m/s over STILL_SPAN
STILL_SPAN = 0.5  # s
STILL_SHORTEST = 2.0  # s


@dataclass(frozen=True, slots=True)
class Drift:
    """How far the estimate wandered while the body stood still."""

    start_s: float  # of the longest still interval, since the first matched pose
    duration_s: float
    drift_m: float  # largest change of the position error since the interval's start


@dataclass(frozen=True, slots=True)
class TrajectoryScore:
    """Errors after the SE(3) alignment (Umeyama without scale) of all matched poses."""

    poses: int  # in the estimate
    matched: int  # with a true pose within MATCH
    duration_s: float
    length_m: float  # of the true path
    ate_rmse_m: float
    ate_mean_m: float
    ate_max_m: float
    rotation_rmse_deg: float
    rotation_max_deg: float
    rpe_1s_translation_rmse_m: float  # NaN when shorter than a second
    rpe_1s_rotation_rmse_deg: float
    rpe_10pct_translation_rmse_m: float  # over a tenth of the true path; NaN without such a pair
    rpe_10pct_rotation_rmse_deg: float
    scale: float  # factor on the estimate that fits the truth best (Sim(3) alignment)
    still: Drift | None


def read_trajectory(path: str | Path) -> PoseTrajectory3D:
    """A TUM file. ValueError names the file and what is wrong with it."""
    if not Path(path).is_file():
        raise ValueError(f'{path}: no such file')
    try:
        trajectory = file_interface.read_tum_trajectory_file(str(path))
    except file_interface.FileInterfaceException as error:
        raise ValueError(f'{path}: {error}') from None
    if trajectory.num_poses < 3:
        raise ValueError(f'{path}: {trajectory.num_poses} poses, at least 3 are needed')
    return trajectory


def trajectory(stamps: F64, T_WB: F64) -> PoseTrajectory3D:
    """Poses (N, 4, 4) at stamps (N,) s as evo wants them."""
    return PoseTrajectory3D(timestamps=stamps, poses_se3=list(T_WB))


def score_trajectory(estimate: PoseTrajectory3D, truth: PoseTrajectory3D) -> tuple[TrajectoryScore, F64]:
    """The score and T_TE (4, 4), which takes the estimate's world to the truth's. ValueError without overlap."""
    true, aligned, T_TE, scale = _align(estimate, truth)
    position = _statistics(metrics.APE(PoseRelation.translation_part), true, aligned)
    rotation = _statistics(metrics.APE(PoseRelation.rotation_angle_deg), true, aligned)
    stamps = true.timestamps
    result = TrajectoryScore(
        estimate.num_poses, true.num_poses, float(stamps[-1] - stamps[0]), float(true.path_length), position['rmse'],
        position['mean'], position['max'], rotation['rmse'], rotation['max'],
        relative_error(true, aligned, PoseRelation.translation_part),
        relative_error(true, aligned, PoseRelation.rotation_angle_deg),
        relative_error_over_path(true, aligned, PoseRelation.translation_part),
        relative_error_over_path(true, aligned, PoseRelation.rotation_angle_deg),
        scale, still_drift(stamps, true.positions_xyz, aligned.positions_xyz))
    return result, T_TE


def ate_rmse_m(estimate: PoseTrajectory3D, truth: PoseTrajectory3D) -> float:
    """TrajectoryScore.ate_rmse_m alone, without the pairs of poses that take long. ValueError without overlap."""
    true, aligned, _, _ = _align(estimate, truth)
    return _statistics(metrics.APE(PoseRelation.translation_part), true, aligned)['rmse']


def _align(estimate: PoseTrajectory3D,
           truth: PoseTrajectory3D) -> tuple[PoseTrajectory3D, PoseTrajectory3D, F64, float]:
    """Matched true poses, the estimated ones aligned with them, T_TE (4, 4) of this, and the scale that would fit."""
    try:
        true, matched = sync.associate_trajectories(truth, estimate, max_diff=MATCH)
        aligned, scaled = copy.deepcopy(matched), copy.deepcopy(matched)
        R_TE, p_TE, _ = aligned.align(true)
        scale = scaled.align(true, correct_scale=True)[2]
    except (sync.SyncException, GeometryException) as error:
        raise ValueError(f'the trajectories cannot be compared: {error}') from None
    return true, aligned, rigid(R_TE, p_TE), float(scale)


def relative_error(true: PoseTrajectory3D, aligned: PoseTrajectory3D, relation: PoseRelation) -> float:
    """RMSE of evo's relative pose error over all pairs one second apart; NaN without such a pair."""
    stamps = true.timestamps
    delta = max(round(1.0 / float(np.median(np.diff(stamps)))), 1)
    if delta >= len(stamps):
        return float('nan')
    rpe = metrics.RPE(relation, float(delta), metrics.Unit.frames, all_pairs=True)
    rpe.process_data((true, aligned))
    last = np.array(rpe.delta_ids)
    whole = np.abs(stamps[last] - stamps[last - delta] - 1.0) < 0.1  # not across a gap
    return float(np.sqrt(np.mean(rpe.error[whole] ** 2))) if np.any(whole) else float('nan')


def relative_error_over_path(true: PoseTrajectory3D, aligned: PoseTrajectory3D, relation: PoseRelation,
                             share: float = 0.1) -> float:
    """RMSE of evo's relative pose error over all pairs that share of the true path apart (within a tenth of it)."""
    delta = share * float(true.path_length)
    rpe = metrics.RPE(relation, delta, metrics.Unit.meters, all_pairs=True, pairs_from_reference=True)
    try:
        rpe.process_data((true, aligned))
    except FilterException:  # no such pair
        return float('nan')
    return float(rpe.get_statistic(metrics.StatisticsType.rmse))


def still_drift(stamps: F64, true: F64, aligned: F64) -> Drift | None:
    """Drift over the longest interval in which the true positions (N, 3) stand still; stamps (N,) s."""
    ahead = np.minimum(np.searchsorted(stamps, stamps + STILL_SPAN), len(stamps) - 1)
    still = np.linalg.norm(true[ahead] - true, axis=1) < STILL_SPEED * STILL_SPAN
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    first, last = edges[::2], edges[1::2] - 1
    if not len(first) or np.max(stamps[last] - stamps[first]) < STILL_SHORTEST:
        return None
    k = int(np.argmax(stamps[last] - stamps[first]))
    a, b = first[k], last[k]
    error = (aligned - true)[a: b + 1]
    return Drift(float(stamps[a] - stamps[0]), float(stamps[b] - stamps[a]),
                 float(np.linalg.norm(error - error[0], axis=1).max()))


def read_true_lines(paths: list[str] | list[Path]) -> F64:
    """Segments (G, 2, 3) of all files: rows x1, y1, z1, x2, y2, z2 in metres, comments with #."""
    segments = []
    for path in paths:
        try:
            segments.append(np.loadtxt(path, delimiter=',', comments='#', ndmin=2).reshape(-1, 2, 3))
        except (OSError, ValueError) as error:
            raise ValueError(f'{path}: rows of x1,y1,z1,x2,y2,z2 are needed: {error}') from None
    return np.concatenate(segments)


def score_lines(path: str | Path, true_lines: F64, T_TE: F64) -> LineScore:
    """The map in a CSV, moved by T_TE (4, 4), against true segments (G, 2, 3)."""
    try:
        lines = read_csv(path)
    except OSError as error:
        raise ValueError(f'{path}: {error.strerror}') from None
    return score(transform_points(T_TE, lines.ends), true_lines)


def json_text(value: Any) -> str:
    """JSON, with null for NaN, which JSON does not have."""
    return json.dumps(_without_nan(value), indent=2) + '\n'


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _without_nan(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _statistics(metric: metrics.APE, true: PoseTrajectory3D, aligned: PoseTrajectory3D) -> dict[str, float]:
    metric.process_data((true, aligned))
    return {name: float(value) for name, value in metric.get_all_statistics().items()}
