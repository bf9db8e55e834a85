"""How far estimated lines are from the true ones."""
from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from line_slam_ros.geometry.lines import line_angle, line_from_points, point_distance
from line_slam_ros.types import F64


@dataclass(frozen=True, slots=True)
class Errors:
    """Of each line (L,); NaN where there is no estimate."""

    angle_deg: F64  # between the directions, whatever their signs
    perpendicular_m: F64  # distance of the true end points from the estimated line, mean of both
    endpoint_m: F64  # between true and estimated end points, mean of both, in the better of the two orders

    def summary(self) -> dict[str, float]:
        """Mean and maximum of each over the estimated lines: angle_deg_mean, angle_deg_max, ...; NaN without any."""
        figures = {}
        for name, values in asdict(self).items():
            known = values[np.isfinite(values)]
            figures[f'{name}_mean'] = float(known.mean()) if len(known) else np.nan
            figures[f'{name}_max'] = float(known.max()) if len(known) else np.nan
        return figures


def score(segments: F64, pluecker: F64, ends: F64) -> Errors:
    """Of lines (L, 6) with end points (L, 2, 3) against true segments (L, 2, 3)."""
    true = line_from_points(segments[:, 0], segments[:, 1])
    straight, swapped = (np.linalg.norm(e - segments, axis=-1).mean(axis=-1) for e in (ends, ends[:, ::-1]))
    return Errors(np.degrees(line_angle(pluecker, true)), point_distance(pluecker[:, None], segments).mean(axis=-1),
                  np.minimum(straight, swapped))
