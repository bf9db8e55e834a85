"""Every tunable once: name, unit, default, range, meaning. YAML files and ROS parameters are views of this."""
from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import Field, dataclass, field, fields, is_dataclass, replace
from typing import Any

from line_slam_ros.types import LINE_FORMS


def param(default: Any, description: str, low: float | None = None, high: float | None = None,
          choices: tuple[str, ...] = ()) -> Any:
    """A dataclass field that carries its own documentation and range (inclusive)."""
    return field(default=default, metadata={'description': description, 'low': low, 'high': high, 'choices': choices})


class Checked:
    """Dataclasses whose leaves are checked against their type, range and choices on construction."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            if not is_dataclass(getattr(self, f.name)):
                check(f, getattr(self, f.name), type(self).__name__)


def check(f: Field, value: Any, where: str) -> None:
    """Raise ValueError that names the parameter, the offending value and what is allowed."""
    name, default, meta = f'{where}.{f.name}'.lower(), f.default, f.metadata
    if isinstance(default, float) and not isinstance(default, bool):
        ok = isinstance(value, (int, float)) and not isinstance(value, bool)
    else:
        ok = type(value) is type(default)
    if not ok:
        raise ValueError(f'{name} must be {type(default).__name__}, got {value!r}')
    low, high = meta['low'], meta['high']
    if (low is not None and not value >= low) or (high is not None and not value <= high):
        raise ValueError(f'{name} must lie in [{low}, {high}], got {value!r}')
    if meta['choices'] and value not in meta['choices']:
        raise ValueError(f'{name} must be one of {", ".join(meta["choices"])}, got {value!r}')


@dataclass(frozen=True)
class Points(Checked):
    """Corner tracking."""

    max_count: int = param(200, 'corners tracked at a time', 0, 2000)
    min_distance_px: float = param(22.0, 'smallest distance between two corners, px', 3.0, 200.0)
    min_contrast: float = param(2.0, 'smallest gradient of a corner along its weaker direction, grey/px', 0.1, 100.0)
    round_trip_px: float = param(0.7, 'largest error of a track followed forth and back, px', 0.05, 10.0)
    epipolar_px: float = param(1.0, 'largest distance of a track to its epipolar line, px', 0.1, 20.0)


@dataclass(frozen=True)
class Lines(Checked):
    """Line segment detection and tracking."""

    max_count: int = param(80, 'line segments tracked at a time', 0, 1000)
    min_length_px: float = param(40.0, 'shorter segments are not used, px', 10.0, 1000.0)
    min_contrast: float = param(3.0, 'weaker edges are not used: gradient across the edge, grey/px', 0.5, 100.0)


@dataclass(frozen=True)
class Estimator(Checked):
    """Sliding window optimisation."""

    window: int = param(13, 'states in the sliding window, keyframes and newest frame', 4, 40)
    max_iterations: int = param(8, 'optimiser iterations per frame, at most', 1, 50)
    point_sigma_px: float = param(0.3, 'standard deviation of a tracked corner until it is learned, px', 0.05, 20.0)
    line_representation: str = param('orthonormal', 'numbers that a line is estimated in; see docs/line-geometry.md',
                                     choices=LINE_FORMS)
    line_min_views: int = param(3, 'states that must see a line before it gets a 3D estimate', 2, 20)
    line_min_parallax_deg: float = param(2.0, 'angle between observation planes that starts a line, deg', 0.1, 45.0)
    loss_scale: float = param(2.5, 'Cauchy loss scale, standard deviations', 0.1, 100.0)
    gate_chi2: float = param(20.0, 'squared whitened residual over which an observation is an outlier', 3.0, 1000.0)
    gravity: float = param(9.81, 'magnitude of gravity, m/s^2', 9.0, 10.0)
    gyro_bias_sigma: float = param(0.05, 'uncertainty of the initial gyro bias, rad/s', 1e-5, 1.0)
    accel_bias_sigma: float = param(0.1, 'uncertainty of the initial accelerometer bias (mean 0), m/s^2', 1e-4, 5.0)
    extrinsic_sigma_deg: float = param(0.5, 'how well the rotation between camera and IMU is calibrated (standard '
                                       'deviation); it is refined, but with 0, deg', 0.0, 10.0)
    extrinsic_sigma_m: float = param(0.005, 'the same of the position of the camera in the body, m', 0.0, 0.5)
    time_offset_sigma_s: float = param(0.003, 'the same of the time offset of the images, s', 0.0, 0.1)
    upright_spread_deg: float = param(0.5, 'by how much upright lines of a building differ from each other (standard '
                                      'deviation), which tell roll and pitch; 0: they are not believed to be '
                                      'upright, deg', 0.0, 10.0)
    lean_sigma_deg: float = param(0.2, 'by how much all of them together are off the vertical (standard deviation), '
                                  'deg', 0.0, 10.0)
    init_window_s: float = param(2.0, 'longest stretch of images that a start from motion uses, s', 0.5, 10.0)
    init_max_scale_sigma: float = param(0.05, 'relative uncertainty of scale at which a start is accepted', 0.001, 1.0)
    keyframe_max_s: float = param(1.0, 'longest time between keyframes while moving, s', 0.1, 10.0)
    max_blind_m: float = param(1.0, 'time without features times standard deviation of the velocity at which the '
                               'estimate counts as lost, m', 0.01, 1000.0)
    keyframe_parallax_px: float = param(20.0, 'mean parallax to the last keyframe that makes a new one, px', 0.5, 200.0)


@dataclass(frozen=True)
class Mapping(Checked):
    """What enters the line map."""

    min_views: int = param(4, 'keyframes that must have seen a line', 2, 1000)
    max_sigma_m: float = param(0.015, 'largest standard deviation across the line at its ends, m', 1e-4, 10.0)
    min_parallax_deg: float = param(1.0, 'smallest angle about the line between its extreme views, deg', 0.0, 90.0)
    min_length_m: float = param(0.05, 'shorter lines are not kept, m', 0.0, 10.0)
    max_range_m: float = param(50.0, 'ends further from the camera than this are not used, m', 0.5, 1e4)
    end_share: float = param(0.05, 'share of the views that must confirm an end (two at least)', 0.0, 0.5)
    end_sigma_mrad: float = param(3.0, 'standard deviation of an observed end along its line, mrad', 0.01, 100.0)
    merge_angle_deg: float = param(5.0, 'lines whose directions differ by more are never merged, deg', 0.0, 45.0)
    merge_distance_m: float = param(0.03, 'lines closer than this are merged; twice this at most, if uncertain, m',
                                    0.0, 10.0)
    merge_gap_m: float = param(0.1, 'collinear pieces closer than this are merged, m', 0.0, 10.0)


@dataclass(frozen=True)
class Config(Checked):
    """The whole method."""

    use_points: bool = param(True, 'use corners in the estimate')
    use_lines: bool = param(True, 'use line segments in the estimate and map them')
    points: Points = field(default_factory=Points)
    lines: Lines = field(default_factory=Lines)
    estimator: Estimator = field(default_factory=Estimator)
    mapping: Mapping = field(default_factory=Mapping)


def leaves(config: Any, prefix: str = '') -> Iterator[tuple[str, Field, Any]]:
    """(dotted name, dataclass field, value) of every tunable, in declaration order."""
    for f in fields(config):
        value = getattr(config, f.name)
        if is_dataclass(value):
            yield from leaves(value, f'{prefix}{f.name}.')
        else:
            yield prefix + f.name, f, value


def override(config: Any, get: Callable[[str, Any], Any], prefix: str = '') -> Any:
    """config with each leaf replaced by get('dotted.name', current value)."""
    new = {}
    for f in fields(config):
        value = getattr(config, f.name)
        name = prefix + f.name
        new[f.name] = override(value, get, name + '.') if is_dataclass(value) else get(name, value)
    return replace(config, **new)
