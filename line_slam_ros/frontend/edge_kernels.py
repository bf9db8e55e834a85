"""Compiled kernels that find and measure straight edges across their normals.

Pixels are those of the undistorted image. A segment runs from ends[0] to ends[1] and is always brighter on the side of
its normal (-t_v, t_u), which fixes the order of its ends. ``valid`` marks the pixels that the lens really saw.
"""
from __future__ import annotations

import numpy as np
from numba import njit

SAMPLES = 32  # across-profiles per segment
HALF = 6  # px, half length of a remembered profile
SEARCH = 10  # px, largest displacement across the segment that is looked for around the prediction
TILT = 4  # px, largest difference of displacement between the middle and an end
INERTIA = 0.002  # loss of correlation per px that a farther place must make up for
DIM = 5.0  # grey, norm of a profile below which its correlation counts little
PEAK = 3  # px, the edge is looked for this far from its expected place


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def bilinear(image, u, v):
    """Grey value at (u, v), which the caller knows to lie inside."""
    c, r = int(u), int(v)
    a, b = u - c, v - r
    top = image[r, c] + a * (np.float64(image[r, c + 1]) - image[r, c])
    low = image[r + 1, c] + a * (np.float64(image[r + 1, c + 1]) - image[r + 1, c])
    return top + b * (low - top)


@njit(cache=True, nogil=True, error_model='numpy')
def strip(image, valid, end0, end1, half, values):
    """Fill values (SAMPLES, 2 half + 1) with grey across the segment; a row starts with NaN outside the image."""
    h, w = image.shape
    du, dv = end1[0] - end0[0], end1[1] - end0[1]
    length = np.sqrt(du * du + dv * dv) + 1e-12
    nu, nv = -dv / length, du / length
    for i in range(SAMPLES):
        s = (i + 0.5) / SAMPLES
        u, v = end0[0] + s * du, end0[1] + s * dv
        values[i, 0] = np.nan
        au, av, bu, bv = u - half * nu, v - half * nv, u + half * nu, v + half * nv
        if not (min(au, bu) >= 1.0 and min(av, bv) >= 1.0 and max(au, bu) < w - 2.0 and max(av, bv) < h - 2.0):
            continue
        if not (valid[int(av), int(au)] and valid[int(bv), int(bu)]):
            continue
        for k in range(2 * half + 1):
            values[i, k] = bilinear(image, au + k * nu, av + k * nv)


@njit(cache=True, nogil=True, error_model='numpy')
def remember(image, valid, ends, profiles):
    """Fill profiles (M, SAMPLES, 2 HALF + 1), zero mean and unit norm, of segments ends (M, 2, 2)."""
    for m in range(len(ends)):
        strip(image, valid, ends[m, 0], ends[m, 1], HALF, profiles[m])
        for i in range(SAMPLES):
            row = profiles[m, i]
            if row[0] == row[0]:
                row -= np.mean(row)
                row /= np.sqrt(np.sum(row * row)) + DIM


@njit(cache=True, nogil=True, error_model='numpy')
def follow(image, valid, profiles, ends, score):
    """Shift predicted segments ends (M, 2, 2), in place, to where their profiles (M, SAMPLES, 2 HALF + 1) fit best.

    Displacement of sample i: a + b s_i with s from -1 to 1; all (a, b) are tried on one table of correlations.
    score (M,): mean correlation at the best, counting only samples that could be compared; 0 when under half could.
    """
    wide = SEARCH + TILT + HALF
    values = np.empty((SAMPLES, 2 * wide + 1))
    table = np.empty((SAMPLES, 2 * (SEARCH + TILT) + 1))
    total, width = np.empty(2 * SEARCH + 1), 2 * HALF + 1
    for m in range(len(ends)):
        strip(image, valid, ends[m, 0], ends[m, 1], wide, values)
        usable = 0
        for i in range(SAMPLES):
            table[i, 0] = np.nan
            if not (values[i, 0] == values[i, 0] and profiles[m, i, 0] == profiles[m, i, 0]):
                continue
            usable += 1
            for j in range(table.shape[1]):
                mean, square, product = 0.0, 0.0, 0.0
                for k in range(width):
                    g = values[i, j + k]
                    mean += g / width
                    square += g * g
                    product += g * profiles[m, i, k]
                table[i, j] = product / (np.sqrt(max(square - width * mean * mean, 0.0)) + DIM)
        score[m] = 0.0
        if usable < SAMPLES // 2:
            continue
        best, best_a, best_b = -np.inf, 0, 0
        for b in range(-TILT, TILT + 1):
            total[:] = 0.0
            for i in range(SAMPLES):
                if table[i, 0] == table[i, 0]:
                    first = int(np.floor(b * (2.0 * (i + 0.5) / SAMPLES - 1.0) + 0.5)) + TILT
                    for j in range(2 * SEARCH + 1):
                        total[j] += max(table[i, first + j], 0.0)
            for j in range(2 * SEARCH + 1):
                value = total[j] / usable - INERTIA * (abs(j - SEARCH) + 2.0 * abs(b))
                if value > best:
                    best, best_a, best_b = value, j - SEARCH, b
        score[m] = best + INERTIA * (abs(best_a) + 2.0 * abs(best_b))
        shift(ends[m], best_a - best_b, best_a + best_b)


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
def measure(image, valid, floor, ends, variance, support):
    """Put segments ends (M, 2, 2) on the edge itself, in place, and on its visible extent.

    floor: smallest gradient, grey/px; variance (M, 2) px^2 of each end across the segment, support (M,) share of the
    samples that lie on the edge (below 0.3 the search ends and the rest is not filled in).
    """
    half = PEAK + 2
    values = np.empty((SAMPLES, 2 * half + 1))
    offsets, heights, line = np.empty(SAMPLES), np.empty(SAMPLES), np.zeros(5)
    for m in range(len(ends)):
        support[m] = 0.0
        for stage in range(2):
            reach = PEAK if stage == 0 else 1
            strip(image, valid, ends[m, 0], ends[m, 1], half, values)
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
        reach_ends(image, valid, ends[m], max(floor, 0.4 * np.median(heights[heights > 0.0])))


@njit(cache=True, nogil=True, error_model='numpy')
def on_edge(image, valid, u, v, nu, nv, floor):
    """Does a rising edge cross the normal (nu, nv) within a pixel of (u, v)?"""
    h, w = image.shape
    if not (u >= 5.0 and v >= 5.0 and u < w - 6.0 and v < h - 6.0 and valid[int(v), int(u)]):
        return False
    best, where = -np.inf, 0
    for k in range(-2, 3):
        ahead = bilinear(image, u + (k + 1) * nu, v + (k + 1) * nv)
        g = 0.5 * (ahead - bilinear(image, u + (k - 1) * nu, v + (k - 1) * nv))
        if g > best:
            best, where = g, k
    return best > floor and abs(where) <= 1


@njit(cache=True, nogil=True, error_model='numpy')
def reach_ends(image, valid, ends, floor):
    """Let both ends grow (8 px at most) or shrink to where the edge is visible, in place."""
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
            if on_edge(image, valid, eu + sign * along * tu, ev + sign * along * tv, -tv, tu, floor):
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
def duplicates(ends, tolerance, doubled):
    """Mark in doubled (M,) every segment that lies, for a third of the shorter, on an earlier unmarked one."""
    for j in range(len(ends)):
        for i in range(j):
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
