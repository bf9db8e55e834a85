"""Compiled kernels that find and measure straight edges across their normals.

Pixels are those of an undistorted canvas. No such image is made: ``lens`` (H, W, 2) tells where each LENS_STEP-th pixel
of the canvas lies in ``image``, the image as received (NaN where the lens does not see). A segment runs from ends[0] to
ends[1] and is always brighter on the side of its normal (-t_v, t_u), which fixes the order of its ends.
"""
from __future__ import annotations

import numpy as np
from numba import njit

LENS_STEP = 4  # px, of the table of the lens; between, it is linear to 0.01 px
BORDER = 4.0  # px of the received image that are not trusted
SAMPLES = 32  # across-profiles per segment
HALF = 6  # px, half length of a remembered profile
SEARCH = 10  # px, largest displacement across the segment that is looked for around the prediction
TILT = 4  # px, largest difference of displacement between the middle and an end
LANES = 32  # at least 2 (SEARCH + TILT) + 1 displacements; what processors like, the rest is not used
INERTIA = 0.002  # loss of correlation per px that a farther place must make up for
DIM = np.float32(5.0)  # grey, norm of a profile below which its correlation counts little
PEAK = 3  # px, the edge is looked for this far from its expected place


@njit(cache=True, nogil=True, error_model='numpy')
def received(lens, u, v, nu, nv):
    """Where (u, v) of the canvas lies in the received image, and what a step (nu, nv) becomes there; NaN if unseen."""
    a, b = u * (1.0 / LENS_STEP), v * (1.0 / LENS_STEP)
    if not (a >= 0.0 and b >= 0.0 and a < lens.shape[1] - 1.0 and b < lens.shape[0] - 1.0):
        return np.nan, np.nan, np.nan, np.nan
    c0, r0 = np.uintp(int(a)), np.uintp(int(b))
    c1, r1 = np.uintp(int(a) + 1), np.uintp(int(b) + 1)
    a, b = a - int(a), b - int(b)
    nu, nv = nu * (1.0 / LENS_STEP), nv * (1.0 / LENS_STEP)
    low_u, low_v = lens[r0, c0, 0] + b * (lens[r1, c0, 0] - lens[r0, c0, 0]), \
        lens[r0, c0, 1] + b * (lens[r1, c0, 1] - lens[r0, c0, 1])
    high_u, high_v = lens[r0, c1, 0] + b * (lens[r1, c1, 0] - lens[r0, c1, 0]), \
        lens[r0, c1, 1] + b * (lens[r1, c1, 1] - lens[r0, c1, 1])
    down_u = (1.0 - a) * (lens[r1, c0, 0] - lens[r0, c0, 0]) + a * (lens[r1, c1, 0] - lens[r0, c1, 0])
    down_v = (1.0 - a) * (lens[r1, c0, 1] - lens[r0, c0, 1]) + a * (lens[r1, c1, 1] - lens[r0, c1, 1])
    return (low_u + a * (high_u - low_u), low_v + a * (high_v - low_v),
            nu * (high_u - low_u) + nv * down_u, nu * (high_v - low_v) + nv * down_v)


@njit(cache=True, nogil=True, error_model='numpy')
def trusted(image, u, v):
    """Does the received pixel (u, v) lie in the image, a border left out?"""
    return u >= BORDER and v >= BORDER and u < image.shape[1] - 1.0 - BORDER and v < image.shape[0] - 1.0 - BORDER


@njit(cache=True, nogil=True, error_model='numpy')
def across(image, lens, u, v, nu, nv, half, row):
    """Fill row (2 half + 1,) with grey at (u, v) + k (nu, nv), |k| <= half; False when it leaves the image.

    The lens is taken as linear around (u, v): what lies a pixel from there, as measured edges do, is out of place by
    some 0.001 px, what lies 10 px from there by 0.1 px. Positions advance in steps counted in 2^-32 px.
    """
    mu, mv, du, dv = received(lens, u, v, nu, nv)
    if not (trusted(image, mu - half * du, mv - half * dv) and trusted(image, mu + half * du, mv + half * dv)):
        return False
    flat, w, unit = image.reshape(-1), image.shape[1], np.float32(2.0**-32)
    right, below = np.uintp(1), np.uintp(w)
    cu, cv = int((mu - half * du) * 2.0**32), int((mv - half * dv) * 2.0**32)
    step_u, step_v = int(du * 2.0**32), int(dv * 2.0**32)
    for k in range(2 * half + 1):
        at = np.uintp((cv >> 32) * w + (cu >> 32))
        a, b = np.float32(cu & 0xFFFFFFFF) * unit, np.float32(cv & 0xFFFFFFFF) * unit
        top, low = np.float32(flat[at]), np.float32(flat[at + below])
        top += a * (np.float32(flat[at + right]) - top)
        low += a * (np.float32(flat[at + below + right]) - low)
        row[k] = top + b * (low - top)
        cu += step_u
        cv += step_v
    return True


@njit(cache=True, nogil=True, error_model='numpy')
def strip(image, lens, ends, half, values):
    """Fill values (SAMPLES, 2 half + 1) with grey across a segment (2, 2); a row starts with NaN outside the image."""
    du, dv = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    length = np.sqrt(du * du + dv * dv) + 1e-12
    for i in range(SAMPLES):
        s = (i + 0.5) / SAMPLES
        if not across(image, lens, ends[0, 0] + s * du, ends[0, 1] + s * dv, -dv / length, du / length, half,
                      values[i]):
            values[i, 0] = np.nan


@njit(cache=True, nogil=True, error_model='numpy')
def remember(image, lens, ends, profiles):
    """Fill profiles (M, SAMPLES, 2 HALF + 1), zero mean and unit norm, of segments ends (M, 2, 2)."""
    width = 2 * HALF + 1
    for m in range(len(ends)):
        strip(image, lens, ends[m], HALF, profiles[m])
        for i in range(SAMPLES):
            row, total, square = profiles[m, i], np.float32(0.0), np.float32(0.0)
            for k in range(width):
                total += row[k]
            for k in range(width):
                row[k] -= total / np.float32(width)
                square += row[k] * row[k]
            for k in range(width):
                row[k] /= np.sqrt(square) + DIM


@njit(cache=True, nogil=True, error_model='numpy')
def correlate(values, profiles, table):
    """Fill table (SAMPLES, LANES) with the correlations of profiles (SAMPLES, K) and values (SAMPLES, LANES + K) at j.

    Negative ones become 0, and all of a row that cannot be compared. Returns the number of those that can.
    """
    width, zero = profiles.shape[1], np.float32(0.0)
    product, total, square = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    usable = 0
    for i in range(SAMPLES):
        table[i] = zero
        if not (values[i, 0] == values[i, 0] and profiles[i, 0] == profiles[i, 0]):
            continue
        usable += 1
        product[:], total[:], square[:] = zero, zero, zero
        for k in range(width):
            grey, weight = values[i, k:k + LANES], profiles[i, k]
            for j in range(LANES):
                product[j] += grey[j] * weight
                total[j] += grey[j]
                square[j] += grey[j] * grey[j]
        for j in range(LANES):
            rest = max(square[j] - total[j] * total[j] / np.float32(width), zero)
            table[i, j] = max(product[j], zero) / (np.sqrt(rest) + DIM)
    return usable


@njit(cache=True, nogil=True, error_model='numpy')
def best_shift(table, usable):
    """(mean correlation, a, b) of the best displacement a + b s, s from -1 to 1 along the samples of table."""
    total = np.empty(LANES - 2 * TILT, np.float32)
    best, best_a, best_b = -np.inf, 0, 0
    for b in range(-TILT, TILT + 1):
        total[:] = np.float32(0.0)
        for i in range(SAMPLES):
            first = int(np.floor(b * (2.0 * (i + 0.5) / SAMPLES - 1.0) + 0.5)) + TILT
            row = table[i, first:]
            for j in range(LANES - 2 * TILT):
                total[j] += row[j]
        for j in range(2 * SEARCH + 1):
            value = total[j] / usable - INERTIA * (abs(j - SEARCH) + 2.0 * abs(b))
            if value > best:
                best, best_a, best_b = value, j - SEARCH, b
    return best + INERTIA * (abs(best_a) + 2.0 * abs(best_b)), best_a, best_b


@njit(cache=True, nogil=True, error_model='numpy')
def follow(image, lens, profiles, ends, score):
    """Shift predicted segments ends (M, 2, 2), in place, to where their profiles (M, SAMPLES, 2 HALF + 1) fit best.

    score (M,): mean correlation there, counting only samples that could be compared; 0 when under half could.
    """
    values = np.zeros((SAMPLES, LANES + 2 * HALF + 1), np.float32)
    table = np.empty((SAMPLES, LANES), np.float32)
    for m in range(len(ends)):
        strip(image, lens, ends[m], SEARCH + TILT + HALF, values)
        usable = correlate(values, profiles[m], table)
        score[m] = 0.0
        if usable >= SAMPLES // 2:
            score[m], a, b = best_shift(table, usable)
            shift(ends[m], a - b, a + b)


@njit(cache=True, nogil=True, error_model='numpy')
def shift(ends, first, second):
    """Move the two ends (2, 2) along the segment's normal, in place."""
    du, dv = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    length = np.sqrt(du * du + dv * dv) + 1e-12
    nu, nv = -dv / length, du / length
    ends[0, 0] += first * nu
    ends[0, 1] += first * nv
    ends[1, 0] += second * nu
    ends[1, 1] += second * nv


@njit(cache=True, nogil=True, error_model='numpy')
def peak(row, centre, reach, floor):
    """(offset, height) of the strongest rising edge in row within reach of centre; height 0: none."""
    offset, height, merit = 0.0, 0.0, 0.0
    for k in range(centre - reach, centre + reach + 1):
        g = 0.5 * (row[k + 1] - row[k - 1])
        before, after = 0.5 * (row[k] - row[k - 2]), 0.5 * (row[k + 2] - row[k])
        if g < floor or g < before or g <= after:
            continue
        curvature = before - 2.0 * g + after
        t = k - centre + (0.5 * (before - after) / curvature if curvature < -1e-9 else 0.0)
        near = 1.0 - 0.5 * (t / (reach + 1.0)) ** 2
        if g * near > merit:
            offset, height, merit = t, g, g * near
    return offset, height


@njit(cache=True, nogil=True, error_model='numpy')
def fit(offsets, heights, scale, line):
    """Robust displacement a + b s of samples with height > 0 (Cauchy weights of scale px).

    line (5,) <- a, b, variances of the two ends, share of the samples that agree within 2 scale.
    """
    a = b = 0.0
    for _ in range(6):
        w0 = w1 = w2 = y0 = y1 = squares = 0.0
        agreed = 0
        for i in range(SAMPLES):
            if heights[i] <= 0.0:
                continue
            s = 2.0 * (i + 0.5) / SAMPLES - 1.0
            e = offsets[i] - a - b * s
            w = 1.0 / (1.0 + (e / scale) ** 2) ** 2
            w0 += w
            w1 += w * s
            w2 += w * s * s
            y0 += w * offsets[i]
            y1 += w * s * offsets[i]
            squares += w * e * e
            agreed += abs(e) < 2.0 * scale
        determinant = w0 * w2 - w1 * w1
        if determinant < 1e-6:
            line[4] = 0.0
            return
        a, b = (w2 * y0 - w1 * y1) / determinant, (w0 * y1 - w1 * y0) / determinant
    variance = squares / w0
    line[0], line[1], line[4] = a, b, agreed / SAMPLES
    line[2] = variance * (w2 + 2.0 * w1 + w0) / determinant
    line[3] = variance * (w2 - 2.0 * w1 + w0) / determinant


@njit(cache=True, nogil=True, error_model='numpy')
def measure(image, lens, floor, ends, variance, support):
    """Put segments ends (M, 2, 2) on the edge itself, in place, and on its visible extent.

    floor: smallest gradient, grey/px; variance (M, 2) px^2 of each end across the segment, support (M,) share of the
    samples that lie on the edge (below 0.3 the search ends and the rest is not filled in).
    """
    half = PEAK + 2
    values = np.empty((SAMPLES, 2 * half + 1), np.float32)
    offsets, heights, line = np.empty(SAMPLES), np.empty(SAMPLES), np.zeros(5)
    for m in range(len(ends)):
        support[m] = 0.0
        for stage in range(2):
            reach = PEAK if stage == 0 else 1
            strip(image, lens, ends[m], half, values)
            for i in range(SAMPLES):
                heights[i] = 0.0
                if values[i, 0] == values[i, 0]:
                    offsets[i], heights[i] = peak(values[i], half, reach, floor)
            fit(offsets, heights, 1.0 if stage == 0 else 0.5, line)
            support[m] = line[4]
            if line[4] < 0.3:
                break
            shift(ends[m], line[0] - line[1], line[0] + line[1])
        if support[m] < 0.3:
            continue
        variance[m, 0], variance[m, 1] = line[2], line[3]
        reach_ends(image, lens, ends[m], max(floor, 0.4 * np.median(heights[heights > 0.0])))


@njit(cache=True, nogil=True, error_model='numpy')
def on_edge(image, lens, u, v, nu, nv, floor, row):
    """Does a rising edge cross the normal (nu, nv) within a pixel of (u, v)? row (7,): work space."""
    if not across(image, lens, u, v, nu, nv, 3, row):
        return False
    best, where = -np.inf, 0
    for k in range(-2, 3):
        g = 0.5 * (row[k + 4] - row[k + 2])
        if g > best:
            best, where = g, k
    return best > floor and abs(where) <= 1


@njit(cache=True, nogil=True, error_model='numpy')
def reach_ends(image, lens, ends, floor):
    """Let both ends grow (8 px at most) or shrink to where the edge is visible, in place."""
    row = np.empty(7, np.float32)
    step, inward, outward, gap = 2.0, 24.0, 8.0, 3
    du, dv = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    length = np.sqrt(du * du + dv * dv) + 1e-12
    tu, tv = du / length, dv / length
    for side in range(2):
        sign = -1.0 if side == 0 else 1.0
        eu, ev = ends[side, 0], ends[side, 1]
        start = -min(inward, 0.4 * length)
        last, missed, along = start, 0, start
        while along <= outward and missed <= gap:
            if on_edge(image, lens, eu + sign * along * tu, ev + sign * along * tv, -tv, tu, floor, row):
                last, missed = along, 0
            else:
                missed += 1
            along += step
        ends[side, 0], ends[side, 1] = eu + sign * last * tu, ev + sign * last * tv


@njit(cache=True, nogil=True, error_model='numpy')
def beside(ends, other, tolerance):
    """(first, last) px of other (2, 2) along the segment ends (2, 2); (0, -1) if not within tolerance px."""
    du, dv = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    length = np.sqrt(du * du + dv * dv) + 1e-12
    tu, tv = du / length, dv / length
    first = last = 0.0
    for k in range(2):
        a, b = other[k, 0] - ends[0, 0], other[k, 1] - ends[0, 1]
        if abs(a * tv - b * tu) > tolerance:
            return 0.0, -1.0
        if k == 0:
            first = a * tu + b * tv
        else:
            last = a * tu + b * tv
    return first, last


@njit(cache=True, nogil=True, error_model='numpy')
def duplicates(ends, tolerance, of, doubled):
    """Mark in doubled (M,) every segment that lies, for a third of the shorter, on an earlier unmarked one.

    Only the first ``of`` segments count as earlier ones.
    """
    for j in range(len(ends)):
        for i in range(min(j, of)):
            if doubled[i]:
                continue
            length = np.hypot(ends[i, 1, 0] - ends[i, 0, 0], ends[i, 1, 1] - ends[i, 0, 1])
            first, last = beside(ends[i], ends[j], tolerance)
            if last > first and min(last, length) - max(first, 0.0) > 0.33 * min(last - first, length):
                doubled[j] = True
                break


@njit(cache=True, nogil=True, error_model='numpy')
def join(ends, tolerance, gap, joined):
    """Lengthen segments by later collinear ones across at most gap px; mark these in joined (M,)."""
    for i in range(len(ends)):
        if joined[i]:
            continue
        for j in range(i + 1, len(ends)):
            if joined[j]:
                continue
            du, dv = ends[i, 1, 0] - ends[i, 0, 0], ends[i, 1, 1] - ends[i, 0, 1]
            length = np.hypot(du, dv) + 1e-12
            first, last = beside(ends[i], ends[j], tolerance)
            if not last > first or first > length + gap or last < -gap:
                continue
            low, high = min(first, 0.0) / length, max(last, length) / length
            u, v = ends[i, 0, 0], ends[i, 0, 1]
            ends[i, 0, 0], ends[i, 0, 1] = u + low * du, v + low * dv
            ends[i, 1, 0], ends[i, 1, 1] = u + high * du, v + high * dv
            joined[j] = True
