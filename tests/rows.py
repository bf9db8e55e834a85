"""What the two sources of the line mathematics hold, where they err and where it breaks: docs/line-geometry.md.

Tests say what they cover by marks: `row(3)`, `trap('plane z = 0')`, `source_error('D1 (15)')`. scripts/write_rows.py
writes the tables of the page from them, tests/test_rows.py checks that nothing here is without a test.
"""
from __future__ import annotations

from dataclasses import dataclass

ROWS = {
    1: 'line through two points: n . d = 0, |n| / |d| the distance of the foot, to 1e-12',
    2: 'closest point of a line, to the origin and to any point',
    3: 'Pluecker line to (U, phi) and back, to 1e-12, also for n parallel to z',
    4: 'Pluecker line to orth4 (Euler angles) and back; what orth4 cannot hold is refused',
    5: 'point and direction to orth4 and back',
    6: 'orthonormal updates from the left and from the right: U stays in SO(3) to 1e-12, no fold at phi = 0 or pi/2',
    7: 'plane through three points',
    8: 'line in which two planes meet; coincident planes are reported',
    9: 'line of many observation planes (SVD)',
    10: 'motion of points and lines, with the exact inverse',
    11: 'world to camera from body pose and extrinsic',
    12: 'projection of a line with K, skew included: parallel to (K a) x (K b)',
    13: 'residual is the distance in the image; a line without an image is refused',
    14: 'derivative of the residual by the Pluecker numbers, D1 (12) to (14)',
    15: 'derivative of the line by its left (D1 (15), corrected) and right update',
    16: 'derivative of the residual by the body pose, D1 (16)',
    17: 'derivative of the residual by the extrinsic, D1 (17)',
    18: 'update of a pose and its 7x6 ambient derivative',
    19: 'update of orth4 with its ambient derivative, which cannot replace the tangent one',
    20: 'update of (theta, rho) with theta in [-pi, pi)',
    21: 'two-camera factor of (theta, rho): the Pluecker residual of the same line up to sign',
    22: 'one-camera factor of (theta, rho): identically zero, so void',
    23: 'one-camera factor of a Pluecker line',
    24: 'two-camera factor of a Pluecker line held in its host camera',
    25: 'world-line factor with all its blocks',
    26: 'in-camera factor with all four blocks for any extrinsic',
    27: 'start-frame factor',
    28: "the host's local frame is in SO(3)",
    29: 'choice of the views that start a line, whatever the order of the ends; degenerate motion waits',
    30: 'two- and four-parameter starts describe the same line',
    31: 'end points by trimming, in three forms',
    32: 'end points from many views: partial ones recover the segment, one bad frame stops nothing, no limit of 8 m',
    33: 'cheirality: nothing behind a camera is used',
    34: 'fit with two parameters, jointly and line by line',
    35: 'fit with four parameters, jointly and line by line',
    36: 'whitening and robust loss: cost = 0.5 sum log(1 + |r|^2), sigma settable',
    37: 'readers of poses, landmarks and observations; quaternions are normalised',
    38: 'seeded noise: the same seed gives the same bytes',
    39: 'saved result: one row per line, failures listed',
    40: 'evaluation: angle, perpendicular distance, end points in either order',
    41: 'the experiment in both modes: cost, iterations, time, errors',
}

TRAPS = (
    'plane z = 0', 'phi across 0 and pi/2', 'line through the origin', 'swapped end points', 'motion along the line',
    'motion within the observation plane', 'pure rotation', 'points behind the camera', 'coincident planes',
    'extrinsic not the identity', 'quaternion not of unit length', 'partial views', 'line longer than 8 m',
    'one bad frame', 'near end-on views',
)


@dataclass(frozen=True)
class SourceError:
    """One error of a source; `{}` in `shown` stand for the numbers, which its test computes again."""

    says: str
    right: str
    shown: str
    numbers: tuple[float, ...] = ()

    def counter_example(self) -> str:
        return self.shown.format(*(f'{number:g}' for number in self.numbers))


SOURCE_ERRORS = {
    'D1 (3)': SourceError(
        'the angle of the orthonormal form is the arc cosine of w1 or the arc sine of w2',
        'phi = atan2(|d|, |n|)',
        'a line 1e9 m away comes back at infinity (acos), one 1e-9 m from the origin through it (asin); '
        'acos(cos(-0.3)) is +0.3'),
    'D1 (7)': SourceError(
        'auxiliary point e1 = a1 + a1 x b1, in the world frame',
        'e1 = a1 + (a1 - C) x (b1 - C): the source holds for C = 0 only',
        'cameras 1 m from the origin, 1 px: mean error of an end {} cm instead of {} cm, largest {} cm instead of '
        '{} cm',
        (4.70, 0.738, 281.0, 2.51)),
    'D1 (8)': SourceError(
        'the line meets any plane', 'there is no point when d . N = 0, and none worth using nearby',
        'a line parallel to the axis, 0.5 m beside it: seen at 1.15 px it ends at {} m, 1 px less and it ends at {} m; '
        'at 0 px the formula divides by zero', (200.0, 1533.0)),
    'D1 (15)': SourceError(
        'derivative by the left update with the sign of its last block turned',
        '[[-[w1 u1]x, -w2 u1], [-[w2 u2]x, w1 u2]]',
        'phi = 0.7: the column by phi is wrong by {}, its length is {}', (1.53, 1.0)),
    'D1 section 3': SourceError(
        'an end point may only move outwards', 'robust vote over the feet of all views',
        '60 full views at 4.5 px: {} cm by the outermost foot, {} cm by our vote', (11.1, 0.562)),
    'D2 pluckerOrigin': SourceError(
        'foot of the origin = n x d / |d|^2 = |n| / |d|',
        'd x n / |d|^2, whose length is |n| / |d|; a vector does not equal a number',
        'the point returned is {} m from the line, which is {} m from the origin', (8.26, 4.13)),
    'D2 plk_to_orth': SourceError(
        'every line has its Euler angles', 'not one with n parallel to z, nor with n = 0 or d = 0 (NaN)',
        'a line in the plane z = 0 comes back turned by {} degrees', (36.9,)),
    'D2 line_to_pose': SourceError(
        'the foot, transformed, is the foot in the other frame',
        'it is a point of the line; the foot of another origin is another point',
        'extrinsic with a 6 cm lever: {} cm apart along the line', (1.34,)),
    'D2 TrimLine': SourceError(
        'no guard: behind the camera, z = 0, d . N = 0, near end-on',
        'NaN behind the camera and along the line; the map uses no foot seen at less than 5 degrees to its line',
        'a foot at depth {} m is returned as seen; at {} degrees to the line one pixel moves an end by {} cm',
        (-4.0, 0.796, 131.0)),
    'D2 line Plus': SourceError(
        'phi = asin of the updated w2', 'phi + dphi: it may pass pi/2 and 0',
        '1.5 + 0.2 rad fold back to 1.44: n changes sign, the line moves {} cm; rounding above 1 gives NaN', (26.0,)),
    'D2 line Jacobian': SourceError(
        'the derivative of the update is the identity, whatever the factor',
        'only for derivatives by the update itself; those by the stored angles need blkdiag([[1, s1 t2, c1 t2], '
        '[0, c1, -s1], [0, s1 / c2, c1 / c2]], 1)',
        'angles (0.3, -0.9, 2.0): relative error of the derivative {}', (0.397,)),
    'D2 pose Plus': SourceError(
        'q <- q [d / 2, 1], normalised', 'q <- q Exp(d)', '{} % short at one radian', (7.27,)),
    'D2 pose Jacobian': SourceError(
        'one 7x6 derivative serves every factor', 'analytic factors are by the update already and need [I6; 0]',
        'at the identity the rotation block is wrong by {} of its size', (0.5,)),
    'D2 Twist inverse': SourceError(
        'the inverse of a stored quaternion is its conjugate', 'of a unit quaternion only: normalise what is read',
        'five decimals, 20 m: T inverse(T) is off by up to {} mm', (0.922,)),
    'D2 invTbc': SourceError(
        'the text says that it maps camera to body', 'it maps body to camera',
        'a point 5 m ahead, taken the other way: {} m off', (7.23,)),
    'D2 in-camera factor': SourceError(
        'position of camera i in camera j by R_BC (...)', "R_BC' (...)",
        "the sources' extrinsic, cameras 4 m apart: relative error of the line block {}, {}, {} (10, 50, 90 % of 100 "
        'cases)', (0.856, 1.43, 2.79)),
    'D2 relative pose': SourceError(
        "T_CjCi = T' T", 'the inverse, not the transpose', 'a point 5 m ahead: {} m off', (3.96,)),
    'D2 one-camera factor': SourceError(
        "the host's own view is a measurement of (theta, rho)", 'its residual and derivatives are zero for every line',
        '50 random (theta, rho): residual below 1e-14, derivatives below 1e-12'),
    'D2 general line': SourceError(
        'two numbers are enough for a line', 'they pin it to the plane of one noisy view, for ever',
        '4.5 px: the best line in the plane of the first view is {} cm off however many follow; that of all planes is '
        '{} cm off with 10 views and {} cm with 320', (3.67, 9.24, 1.43)),
    'D2 rho': SourceError(
        'rho is an inverse depth', 'rho is the inverse range along the bearing of the middle',
        '4 m deep and 40 degrees off the axis: the range is {} m; 1 / 4 m as rho puts the line {} cm off',
        (5.22, 122.0)),
    'D2 rho start': SourceError(
        'every line starts at rho = 0.2', 'rho = |y x d|^2 / ((y x d) . n) of the triangulated line, exact',
        'half a metre to the side, residual {} px for a line at 2 m and {} px at 20 m, instead of 0', (67.7, 33.8)),
    'D2 triangulate_line': SourceError(
        'parallax: the smallest cosine between two plane normals', 'the smallest |cosine|: a swapped segment turns its '
        'normal round',
        '4.5 px, every second view swapped: {} % of the lines start from almost coincident planes; median error {} '
        'degrees, {} with |cosine|, {} from all planes', (100.0, 50.8, 4.54, 1.63)),
    'D2 updatelineplk': SourceError(
        'an end point moves inwards only', 'robust vote over the feet of all views',
        'partial views at 4.5 px of a 2 m segment: {} cm by the innermost foot, {} cm by our vote', (179.0, 1.57)),
    'D2 updatelineplk break': SourceError(
        'the first bad frame ends the work on a line, and a bad host leaves its ends unset',
        'a bad view is one vote less', 'with one bad frame of 12, whichever it is, nothing moves'),
    'D2 updatelineplk 8 m': SourceError(
        'a line longer than 8 m is dropped', 'no limit of length', 'a line of 12 m is kept whole'),
    'D2 savefeatures': SourceError(
        'the file is opened anew for every line, so only the last one is in it', 'all lines, one row each',
        'seven lines written, seven read'),
    'D2 sqrt_info lost': SourceError(
        'the whitening matrix is overwritten by the identity', 'residuals are divided by their sigma',
        'an outlier of 50 px keeps the weight {} instead of {}', (0.988, 0.0004)),
    'D2 sqrt_info fixed': SourceError(
        'sigma is 3.2 px of 460, with Cauchy(1)', "the detector's own sigma, and a loss scale of 2.5 sigma",
        'mean weight of good data at 4.5 px: {} instead of {}', (0.337, 0.792)),
}
