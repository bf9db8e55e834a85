"""One picture of a run: the camera image with tracked lines, trajectory and line map from above, the map in 3D."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from line_slam_ros.types import F64, U8, LineSegments

_LINES: dict[str, Any] = {'cmap': 'winter', 'linewidths': 0.9}  # coloured by height
_TRAJECTORY = '#e04000'


def save(path: Path, image_bgr: U8 | None, positions_W: Sequence[F64], segments: LineSegments) -> None:
    """Writes a PNG; image (H, W, 3) BGR or None, positions of the body (N, 3) m, the map's segments."""
    positions = np.asarray(positions_W, float).reshape(-1, 3)
    sheet = Figure(figsize=(18, 6))
    sheet.subplots_adjust(left=0.01, right=0.97, bottom=0.09, top=0.93, wspace=0.13)  # measured layouts draw twice
    FigureCanvasAgg(sheet)
    _draw_image(sheet.add_subplot(1, 3, 1), image_bgr)
    low, high = _limits(positions, segments.ends)
    _draw_from_above(sheet.add_subplot(1, 3, 2), positions, segments.ends, low, high)
    _draw_in_3d(sheet.add_subplot(1, 3, 3, projection='3d'), positions, segments.ends, low, high)
    sheet.savefig(path, dpi=100, metadata={'Software': None}, pil_kwargs={'compress_level': 3})


def _draw_image(axes: Any, image_bgr: U8 | None) -> None:
    axes.set_title('camera image, tracked points and lines')
    axes.set_axis_off()
    if image_bgr is not None:
        axes.imshow(image_bgr[..., ::-1])


def _draw_from_above(axes: Any, positions: F64, ends: F64, low: F64, high: F64) -> None:
    axes.set_title(f'from above: {len(ends)} lines, {len(positions)} poses')
    heights = ends[..., 2].mean(axis=1)
    axes.add_collection(LineCollection(ends[..., :2], array=heights, clim=(low[2], high[2]), **_LINES))
    axes.plot(positions[:, 0], positions[:, 1], color=_TRAJECTORY, linewidth=1.6)
    axes.plot(*positions[0, :2], 'o', color=_TRAJECTORY, label='start')
    axes.legend(loc='upper right')
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel='x [m]', ylabel='y [m]', aspect='equal')
    axes.grid(alpha=0.3)


def _draw_in_3d(axes: Any, positions: F64, ends: F64, low: F64, high: F64) -> None:
    axes.set_title('line map in 3D')
    if len(ends):  # Matplotlib refuses an empty collection here
        heights = ends[..., 2].mean(axis=1)
        axes.add_collection3d(Line3DCollection(ends, array=heights, clim=(low[2], high[2]), **_LINES))
    axes.plot(*positions.T, color=_TRAJECTORY, linewidth=1.6)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]),
             xlabel='x [m]', ylabel='y [m]', zlabel='z [m]')
    axes.set_box_aspect(high - low)
    axes.view_init(elev=35, azim=-60)


def _limits(positions: F64, ends: F64) -> tuple[F64, F64]:
    """Corners (3,) of the box shown: all of the trajectory, and the map but for its remotest two percent."""
    vertices = ends.reshape(-1, 3) if len(ends) else positions
    low = np.minimum(positions.min(axis=0), np.percentile(vertices, 2, axis=0))
    high = np.maximum(positions.max(axis=0), np.percentile(vertices, 98, axis=0))
    margin = 0.05 * (high - low).max() + 0.1
    return low - margin, high + margin
