"""How good a line map is against the true segments: precision, recall, duplicates (after LIMAP's definitions).

Precision P(t): share of the mapped length, sampled each centimetre, that lies within t of a true segment whose
direction differs by at most 10 degrees. Recall R(t): length of the true segments within t of a mapped one, likewise.
Duplicates: mapped segments that overlap an earlier one within 3 cm and 5 degrees.

Source: Liu, Yu, Pautrat, Pollefeys, Larsson, "3D Line Mapping Revisited", CVPR 2023.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from line_slam_ros.types import F64

STEP = 0.01  # m between samples
ANGLE = np.radians(10.0)
DUPLICATE_DISTANCE, DUPLICATE_ANGLE = 0.03, np.radians(5.0)


@dataclass(frozen=True, slots=True)
class LineScore:
    """A mapped set of segments against the true one, at each threshold."""

    thresholds: tuple[float, ...]  # m
    precision: tuple[float, ...]  # share of the mapped length; NaN for an empty map
    recall_m: tuple[float, ...]  # true length found, m
    recall: tuple[float, ...]  # share of the true length
    count: int  # mapped segments
    length: float  # m, of all mapped segments
    mean_length: float  # m
    duplicates: int  # mapped segments that repeat another one


def score(mapped: F64, truth: F64, thresholds: tuple[float, ...] = (0.01, 0.02, 0.05, 0.10)) -> LineScore:
    """Score mapped segments (L, 2, 3) against true ones (G, 2, 3), both in the same frame, m."""
    length = np.linalg.norm(mapped[:, 1] - mapped[:, 0], axis=1)
    precision, _ = covered(mapped, truth, thresholds)
    recall, recall_m = covered(truth, mapped, thresholds)
    return LineScore(tuple(thresholds), tuple(precision.tolist()), tuple(recall_m.tolist()), tuple(recall.tolist()),
                     len(mapped), float(length.sum()), float(length.mean()) if len(mapped) else float('nan'),
                     int(np.count_nonzero(repeats(mapped))))


def covered(segments: F64, others: F64, thresholds: tuple[float, ...]) -> tuple[F64, F64]:
    """Share of the length of segments (L, 2, 3) within each threshold (m) of another segment (G, 2, 3) of about the
    same direction, and that length in m."""
    samples, owner, weight = sampled(segments)
    distance = nearest(samples, owner, segments, others, max(thresholds))
    length = np.array([weight[distance <= t].sum() for t in thresholds])
    return length / weight.sum() if len(weight) else np.full(len(thresholds), np.nan), length


def sampled(segments: F64) -> tuple[F64, np.ndarray, F64]:
    """Samples (S, 3) at the middles of equal pieces of at most STEP, the segment each is of and its length, m."""
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    pieces = np.maximum(np.ceil(length / STEP - 1e-9).astype(np.int64), 1)
    owner = np.repeat(np.arange(len(segments)), pieces)
    index = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    position = (index + 0.5) / pieces[owner]
    samples = segments[owner, 0] + position[:, None] * (segments[owner, 1] - segments[owner, 0])
    return samples, owner, (length / pieces)[owner]


def nearest(samples: F64, owner: np.ndarray, segments: F64, others: F64, furthest: float) -> F64:
    """Distance (S,) of each sample to the nearest of the others (G, 2, 3) that is not further than furthest and
    within ANGLE of its own segment's direction; infinite where there is none. Samples are ordered by owner."""
    distance = np.full(len(samples), np.inf)
    d, e = directions(segments), directions(others)
    low, high = others.min(axis=1, initial=np.inf) - furthest, others.max(axis=1, initial=-np.inf) + furthest
    first = np.searchsorted(owner, np.arange(len(segments) + 1))
    for k, ends in enumerate(segments):
        close = np.all((ends.min(axis=0) <= high) & (ends.max(axis=0) >= low), axis=1)
        rows = np.flatnonzero(close & (np.abs(e @ d[k]) >= np.cos(ANGLE)))
        if len(rows):
            mine = slice(first[k], first[k + 1])
            distance[mine] = point_to_segments(samples[mine], others[rows]).min(axis=1)
    return distance


def directions(segments: F64) -> F64:
    """Unit directions (L, 3); zero for a segment without length."""
    d = segments[:, 1] - segments[:, 0]
    return d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-12)


def point_to_segments(points: F64, segments: F64) -> F64:
    """Distances (P, G) of points (P, 3) to segments (G, 2, 3)."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    relative = points[:, None] - start
    position = np.einsum('pgi,gi->pg', relative, along) / np.maximum(np.einsum('gi,gi->g', along, along), 1e-18)
    return np.linalg.norm(relative - np.clip(position, 0.0, 1.0)[..., None] * along, axis=-1)


def repeats(segments: F64) -> np.ndarray:
    """Which segments (L,) bool overlap an earlier one, with both lines within 3 cm all along the overlap and 5 deg."""
    d, repeated = directions(segments), np.zeros(len(segments), bool)
    for k in range(1, len(segments)):
        rows = np.flatnonzero(np.abs(d[:k] @ d[k]) >= np.cos(DUPLICATE_ANGLE))
        start = segments[k, 0]
        span = np.sort((segments[rows] - start) @ d[k], axis=1)
        begin = np.maximum(span[:, 0], 0.0)
        end = np.minimum(span[:, 1], (segments[k, 1] - start) @ d[k])
        overlap = start + np.stack([begin, end], axis=1)[..., None] * d[k]
        across = np.cross(overlap - segments[rows, :1], d[rows, None])
        close = np.linalg.norm(across, axis=-1).max(axis=1, initial=0.0) <= DUPLICATE_DISTANCE
        repeated[k] = np.any(close & (end > begin))
    return repeated
