"""How large the errors of tracks really are: learned from their residuals, for each kind and for each track.

What the front end says of an observation is right to a factor only: images are blurred, dark or clean, patches lie on
flat walls or across an edge. So the variance of a track is the given one times a factor, of which only the distribution
is known: inverse gamma about the level of its kind, which makes its residuals together follow a multivariate t
distribution. Factors and level take one step of expectation maximisation whenever the window was optimised in motion.
Source: Lange, Little, Taylor, "Robust statistical modeling using the t distribution", 1989.

Nor are the errors of a track independent: as long as a patch looks the same it errs the same way. With correlation c
of successive errors, as in a first order autoregressive process, m views say as much as m (1 - c) / (1 + c) independent
ones, and so much larger is the variance that counts.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.types import F64

FREEDOM = 6.0  # of the distribution: how alike tracks are believed to be
TRACKS, PAIRS = 100.0, 400.0  # what is known of level and correlation counts for so many, and does not grow
VIEWS = 4  # and more tell something of a track
LEVELS = 0.1, 4.0  # least and most
MOST_CORRELATED = 0.6


class Noise:
    """Of one kind of landmark. A scale is the standard deviation that counts, over the given one."""

    def __init__(self) -> None:
        self.level, self.correlation = 1.0, 0.0

    @property
    def typical(self) -> float:
        """Scale of a track of which nothing is known yet."""
        return self.level * self._repetition()

    def _repetition(self) -> float:
        return float(np.sqrt((1.0 + self.correlation) / (1.0 - self.correlation)))

    def learn(self, r: F64, told: np.ndarray, unknowns: int) -> F64:
        """Scales (N,) of tracks from their residuals r (N, n, 2) in n states, over the given standard deviations.

        told (N, n): which there are, the others are zero; unknowns: numbers of a landmark, fitted to them.
        """
        views = told.sum(axis=1)
        some = views >= VIEWS
        freedom = np.where(some, 2.0 * views - unknowns, 0.0)
        squares = np.where(some, (r**2).sum(axis=(1, 2)), 0.0)
        precision = (FREEDOM + freedom) / (FREEDOM * self.level**2 + squares)
        mean = (TRACKS * self.level**-2.0 + precision[some].sum()) / (TRACKS + some.sum())
        self.level = float(np.clip(mean**-0.5, *LEVELS))
        self._learn_correlation(r[some] * np.sqrt(precision[some])[:, None, None], told[some], unknowns)
        return self._repetition() / np.sqrt(precision)

    def _learn_correlation(self, r: F64, told: np.ndarray, unknowns: int) -> None:
        """From residuals r (N, n, 2) of variance one. The fit takes unknowns / views of each product of successive
        ones: as much as of a square, for a landmark can hardly tell neighbours apart."""
        both = told[:, 1:] & told[:, :-1]
        products = (r[:, 1:] * r[:, :-1] * both[..., None]).sum()
        taken = (unknowns * both.sum(axis=1) / told.sum(axis=1)).sum()
        pairs = 2.0 * both.sum()
        mean = (PAIRS * self.correlation + products + taken) / (PAIRS + pairs)
        self.correlation = float(np.clip(mean, 0.0, MOST_CORRELATED))
