"""Turning a state that leaves the window, and what only it ties together, into the prior."""
from __future__ import annotations

import numpy as np

from line_slam_ros.estimation.solver import Solver
from line_slam_ros.estimation.window import RIG, STATE, state_row
from line_slam_ros.types import F64

NO_LINKS = (0, 0)


def marginalise_oldest(solver: Solver, points: np.ndarray, lines: np.ndarray) -> None:
    """Slot 0 and the landmarks of rows with points[i], lines[i] go into the prior with all their observations.

    points, lines: bool over the tables' rows. Other landmarks just lose their view from slot 0, and
    marginalised ones are removed: no measurement is counted twice.
    """
    window = solver.window
    _into_prior(solver, 0, points, lines, (0, 1))
    window.points.keep(~points)
    window.lines.keep(~lines)
    window.remove(0)


def drop_state(solver: Solver, slot: int) -> None:
    """Remove a state that is no keyframe: its views go, its links become one, the prior is marginalised."""
    window = solver.window
    own = slice(state_row(slot), state_row(slot + 1))
    if np.any(window.prior_H[own, own]):
        none = (np.zeros(table.count, np.bool_) for table in (window.points, window.lines))
        _into_prior(solver, slot, *none, NO_LINKS)
    window.remove(slot)


def _into_prior(solver: Solver, slot: int, points: np.ndarray, lines: np.ndarray, links: tuple[int, int]) -> None:
    """prior <- (prior + links + landmarks) with the slot's state eliminated.

    The gradient is taken at the present state and carried back to the first estimates, which are
    frozen from now on for every state the prior touches.
    """
    window = solver.window
    solver.linearise(points, lines, links=links)
    gone = np.arange(state_row(slot), state_row(slot + 1))
    kept = np.delete(np.arange(window.rows), gone)
    reduced_H, reduced_g = eliminate(solver.H, solver.g, gone, kept)
    touched = kept[np.any(reduced_H != 0.0, axis=1)]
    window.freeze(np.unique((touched[touched >= RIG] - RIG) // STATE))
    delta = window.delta(np.empty(len(window.prior_g)))
    window.prior_H[:], window.prior_g[:] = 0.0, 0.0
    window.prior_H[np.ix_(kept, kept)] = reduced_H
    window.prior_g[kept] = reduced_g - reduced_H @ delta[kept]


def eliminate(H: F64, g: F64, gone: np.ndarray, kept: np.ndarray) -> tuple[F64, F64]:
    """Schur complement (H_kk - H_kg H_gg^+ H_gk, g_k - H_kg H_gg^+ g_g), H symmetric (D, D), g (D,).

    The pseudo-inverse leaves unobserved directions of the eliminated state without information.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[gone], 1e-12))
    values, vectors = np.linalg.eigh(scale[:, None] * H[np.ix_(gone, gone)] * scale)
    inverse = np.where(values > 1e-10, 1.0 / np.maximum(values, 1e-10), 0.0)
    root = (scale[:, None] * vectors) * np.sqrt(inverse)
    B = H[np.ix_(kept, gone)] @ root
    reduced = H[np.ix_(kept, kept)] - B @ B.T
    return 0.5 * (reduced + reduced.T), g[kept] - B @ (root.T @ g[gone])
