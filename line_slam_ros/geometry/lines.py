"""3D lines as Pluecker coordinates and planes as homogeneous ones; leading batch axes everywhere.

A line is L = [n, d] (..., 6): direction d and moment n = p x d of any point p on it, so n . d = 0, |n| / |d| is the
distance from the origin and a factor on L does not change the line. Seen from a camera at the origin, n is the normal
of the plane through the optical centre and the line, which makes it the projected line in normalised coordinates.
A plane is P = [N, e] (..., 4): the points with N . p + e = 0, |N| = 1 where a function returns it.

What has no answer (coincident planes, a segment seen end on, equal points) is NaN: gate on np.isfinite.

Formulas: Bartoli, Sturm, "Structure-from-motion using lines: representation, triangulation and bundle adjustment",
2005; Zhang, Koch, "Structure and motion from line correspondences", 2014.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from line_slam_ros.geometry.lie import hat
from line_slam_ros.types import F64

COINCIDENT = 1e-9  # sine of the angle between directions that rounding cannot tell apart


def line_through(p: ArrayLike, d: ArrayLike) -> F64:
    """Line (..., 6) through points (..., 3) along directions (..., 3) of any length."""
    return np.concatenate(np.broadcast_arrays(np.cross(p, d), d), axis=-1)


def line_from_points(a: ArrayLike, b: ArrayLike) -> F64:
    """Line (..., 6) with moment a x b and direction b - a."""
    return np.concatenate([np.cross(a, b), np.subtract(b, a)], axis=-1)


def unit_direction(L: ArrayLike) -> F64:
    """The same lines (..., 6) with |d| = 1, so that |n| is the distance from the origin in metres."""
    L = np.asarray(L, float)
    with np.errstate(invalid='ignore', divide='ignore'):
        return L / np.linalg.norm(L[..., 3:], axis=-1, keepdims=True)


def closest_point(L: ArrayLike, p: ArrayLike = (0.0, 0.0, 0.0)) -> F64:
    """Foot (..., 3) of the perpendicular from p (..., 3) on the line; from the origin it is d x n / |d|^2."""
    n, d = _split(unit_direction(L))
    return np.cross(d, n) + np.sum(d * p, axis=-1, keepdims=True) * d


def point_distance(L: ArrayLike, p: ArrayLike) -> F64:
    """Distance (...) of points (..., 3) from lines (..., 6)."""
    n, d = _split(unit_direction(L))
    return np.linalg.norm(np.cross(p, d) - n, axis=-1)


def line_angle(L_1: ArrayLike, L_2: ArrayLike) -> F64:
    """Angle (...) in [0, pi/2] between lines, whatever the sign of their directions."""
    d_1, d_2 = _split(L_1)[1], _split(L_2)[1]
    return np.arctan2(np.linalg.norm(np.cross(d_1, d_2), axis=-1), np.abs(np.sum(d_1 * d_2, axis=-1)))


def line_distance(L_1: ArrayLike, L_2: ArrayLike) -> F64:
    """Length (...) of the common perpendicular; parallel lines: the distance between them."""
    L_1, L_2 = unit_direction(L_1), unit_direction(L_2)
    (n_1, d_1), (n_2, d_2) = _split(L_1), _split(L_2)
    sine = np.linalg.norm(np.cross(d_1, d_2), axis=-1)
    moment = np.abs(np.sum(d_1 * n_2 + d_2 * n_1, axis=-1))
    parallel = point_distance(L_2, closest_point(L_1))
    return np.where(sine > COINCIDENT, moment / np.where(sine > COINCIDENT, sine, 1.0), parallel)


def transform_lines(T_AB: ArrayLike, L_B: ArrayLike) -> F64:
    """Lines (..., N, 6) in B to A; T_AB (..., 4, 4): d_A = R d_B, n_A = R n_B + p x d_A."""
    T_AB = np.asarray(T_AB, float)
    R_BA = np.swapaxes(T_AB[..., :3, :3], -1, -2)
    n_B, d_B = _split(L_B)
    d_A = d_B @ R_BA
    return np.concatenate([n_B @ R_BA + np.cross(T_AB[..., None, :3, 3], d_A), d_A], axis=-1)


def line_motion(T_AB: ArrayLike) -> F64:
    """Matrix H (..., 6, 6) = [[R, [p]x R], [0, R]] with L_A = H L_B; that of the inverse is the inverse."""
    T_AB = np.asarray(T_AB, float)
    H = np.zeros((*T_AB.shape[:-2], 6, 6))
    R = T_AB[..., :3, :3]
    H[..., :3, :3], H[..., :3, 3:], H[..., 3:, 3:] = R, hat(T_AB[..., :3, 3]) @ R, R
    return H


def line_motion_jacobian(T_AB: ArrayLike, L_B: ArrayLike) -> F64:
    """Derivative (..., 6, 6) of L_A = H(T_AB) L_B (..., 6) by [dtheta, dp] of T_AB (..., 4, 4), convention of lie.py.

    Chained with a reprojection factor it gives the host pose's and both extrinsic blocks of a line kept in the
    coordinates of the camera that first saw it.
    """
    T_AB = np.asarray(T_AB, float)
    R, p = T_AB[..., :3, :3], hat(T_AB[..., :3, 3])
    n_B, d_B = _split(L_B)
    turned = R @ hat(d_B)
    J = np.zeros((*turned.shape[:-2], 6, 6))
    J[..., :3, :3] = -R @ hat(n_B) - p @ turned
    J[..., :3, 3:] = -hat((R @ d_B[..., None])[..., 0])
    J[..., 3:, :3] = -turned
    return J


def line_projection_matrix(K: ArrayLike) -> F64:
    """(..., 3, 3), det(K) K^-T: takes n_C to the line l in pixels, l . (u, v, 1) = 0. Skew K[0, 1] included."""
    K = np.asarray(K, float)
    return np.linalg.det(K)[..., None, None] * np.swapaxes(np.linalg.inv(K), -1, -2)


def plane_from_points(a: ArrayLike, b: ArrayLike, c: ArrayLike) -> F64:
    """Plane (..., 4) of three points (..., 3); NaN when they lie on one line."""
    a, b, c = (np.asarray(p, float) for p in (a, b, c))
    return _plane(np.cross(b - a, c - a), a, np.linalg.norm(b - a, axis=-1) * np.linalg.norm(c - a, axis=-1))


def observation_plane(T_WC: ArrayLike, ends: ArrayLike) -> F64:
    """Plane (..., 4) in W of the optical centre and a segment's ends (..., 2, 2), normalised; T_WC (..., 4, 4)."""
    T_WC, rays = np.asarray(T_WC, float), _rays(ends)
    N_C = np.cross(rays[..., 0, :], rays[..., 1, :])
    return _plane((T_WC[..., :3, :3] @ N_C[..., None])[..., 0], T_WC[..., :3, 3], np.ones(N_C.shape[:-1]))


def plane_cosine(P_1: ArrayLike, P_2: ArrayLike) -> F64:
    """|cos| (...) of the angle between unit planes (..., 4): 1 is no parallax, whatever the order of the ends."""
    return np.abs(np.sum(np.asarray(P_1)[..., :3] * np.asarray(P_2)[..., :3], axis=-1))


def widest_pair(planes: ArrayLike) -> tuple[int, int, float]:
    """The two of (N, 4) unit planes that cross at the largest angle, and their plane_cosine; NaN planes cross none."""
    normals = np.asarray(planes, float)[:, :3]
    cosine = np.nan_to_num(np.abs(normals @ normals.T), nan=1.0)
    i, j = divmod(int(np.argmin(cosine)), len(normals))
    return min(i, j), max(i, j), float(cosine[i, j])


def line_from_planes(P_1: ArrayLike, P_2: ArrayLike) -> F64:
    """Line (..., 6), |d| = 1, in which two unit planes (..., 4) meet; NaN for parallel or coincident planes.

    d = N2 x N1, n = N1 e2 - N2 e1.
    """
    P_1, P_2 = np.asarray(P_1, float), np.asarray(P_2, float)
    d = np.cross(P_2[..., :3], P_1[..., :3])
    L = np.concatenate([P_1[..., :3] * P_2[..., 3:] - P_2[..., :3] * P_1[..., 3:], d], axis=-1)
    return unit_direction(np.where(np.linalg.norm(d, axis=-1, keepdims=True) > COINCIDENT, L, np.nan))


def line_from_many_planes(planes: ArrayLike) -> F64:
    """Line (..., 6), |d| = 1, nearest to all of (..., N, 4) unit planes in the algebraic sense; N >= 2.

    The null space of the stacked planes holds the points of the line (Hartley, Zisserman, section 12.7). Rows of zeros
    or NaN do not count, so that lines with different numbers of views fit one array. NaN when all planes coincide.
    Give the planes in a frame near the cameras, a weight on a row is its importance.
    """
    _, singular, Vt = np.linalg.svd(np.nan_to_num(planes))
    (x_1, w_1), (x_2, w_2) = ((Vt[..., k, :3], Vt[..., k, 3:]) for k in (2, 3))
    L = np.concatenate([np.cross(x_1, x_2), w_1 * x_2 - w_2 * x_1], axis=-1)
    return unit_direction(np.where(singular[..., 1:2] > COINCIDENT * singular[..., :1], L, np.nan))


def trim(L_C: ArrayLike, ends: ArrayLike, form: str = 'projected', min_depth: float = 1e-3) -> F64:
    """Points (..., 2, 3) of lines L_C (..., 6) that a camera saw as segment ends (..., 2, 2), normalised.

    Each is where the line crosses a plane through the optical centre and the ray x of the end. The second direction o
    in that plane is the image normal (n0, n1, 0) of the projected line ('projected': x's orthogonal foot in the image,
    exact under noise), the normal of the observed segment in the image ('segment'), or the normal x1 x x2 of the
    observation plane ('plane'). All agree on exact data. With N = x x o: p = n x N / -(d . N).

    NaN where the line lies in that plane, or the point is not at least min_depth (m) in front of the camera.
    """
    n, d = (part[..., None, :] for part in _split(L_C))
    rays = _rays(ends)
    across = np.diff(np.asarray(ends, float), axis=-2)
    normals = {'projected': n * (1.0, 1.0, 0.0),
               'segment': np.stack([-across[..., 1], across[..., 0], 0.0 * across[..., 0]], axis=-1),
               'plane': np.cross(rays[..., :1, :], rays[..., 1:, :])}
    if form not in normals:
        raise ValueError(f'form must be one of {", ".join(normals)}, got {form!r}')
    N = np.cross(rays, normals[form])
    along = np.sum(d * N, axis=-1, keepdims=True)
    scale = np.linalg.norm(d, axis=-1, keepdims=True) * np.linalg.norm(N, axis=-1, keepdims=True)
    crossing = np.abs(along) > COINCIDENT * scale
    p_C = np.cross(n, N) / np.where(crossing, -along, np.nan)
    return np.where(p_C[..., 2:] >= min_depth, p_C, np.nan)


def _split(L: ArrayLike) -> tuple[F64, F64]:
    """Moment and direction, (..., 3) each."""
    L = np.asarray(L, float)
    return L[..., :3], L[..., 3:]


def _rays(x: ArrayLike) -> F64:
    """Normalised coordinates (..., 2) to (..., 3) with z = 1."""
    x = np.asarray(x, float)
    return np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)


def _plane(N: F64, p: F64, scale: F64) -> F64:
    """Unit plane (..., 4) with normal along N (..., 3) through p (..., 3); NaN where |N| is nothing beside scale."""
    length = np.linalg.norm(N, axis=-1, keepdims=True)
    N = N / np.where(length > COINCIDENT * scale[..., None], length, np.nan)
    return np.concatenate([N, -np.sum(N * p, axis=-1, keepdims=True)], axis=-1)
