"""Compiled kernels that find and measure straight edges across their normals.

A segment (pixels of the undistorted canvas, see edge_sampling.py) runs from ends[0] to ends[1] and is always brighter
on the side of its normal (-t_v, t_u), which fixes the order of its ends.

np.int64(...) in calls: a kernel would be compiled anew for each literal.
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.frontend.edge_sampling import PLACES, SAMPLES, SEEN, place, sample
from line_slam_ros.frontend.stripes import look
from line_slam_ros.kernel_cache import inner, kernel

HALF = 6  # px, half length of a remembered profile
WIDTH = 2 * HALF + 1
NEAR, NEAR_TILT = 4, 2  # px, displacement across the segment, and its difference at the ends, that is looked for first
SURE = 0.65  # mean correlation of a place near the prediction for which farther ones are not looked at
FAR, FAR_TILT = 10, 4  # px, the largest
PEAK = 3  # px, the edge is looked for this far from its expected place
FULL = FAR + FAR_TILT + HALF  # px, half length of the longest profile
LANES = 32  # at least 2 (FAR + FAR_TILT) + 1 displacements; what processors like, the rest is not used
TOGETHER = 4  # samples whose correlations are shifted as one: a tilt moves them by half a pixel against each other
INERTIA = 0.002  # loss of correlation per px that a farther place must make up for
DIM = np.float32(5.0)  # grey, norm of a profile below which its correlation counts little
LOST = 0.3  # support below which an edge is not measured on
END_STEP, INWARD, OUTWARD, GAP = 2.0, 22.0, 8.0, 3  # px, px, px, steps: how an end looks for where its edge ends
ROWS = 2 * PEAK + 5  # of work space: as many as rows of grey from which an edge is chosen
CLEAR = 0.4  # of the mean height of an edge, below which it ends
ALONG = np.array([2.0 * (i + 0.5) / SAMPLES - 1.0 for i in range(SAMPLES)], np.float32)  # of the samples, -1 to 1


@inner
def workspace():
    """Buffers for one segment at a time: places, which of them are seen (a part of places), grey, correlations, peaks
    (offset, height, merit), rows of other numbers; indices and pairs of neighbours for sampling."""
    places = np.empty(PLACES, np.float32)
    return (places, places[SEEN:SEEN + SAMPLES], np.empty((2 * FULL + 1, SAMPLES), np.float32),
            np.zeros((SAMPLES // TOGETHER, LANES), np.float32), np.empty((3, SAMPLES), np.float32),
            np.empty((ROWS, SAMPLES), np.float32), np.empty(SAMPLES, np.int32), np.empty(2 * SAMPLES, np.uint16))


@kernel
def strip(view, ends, half, work):
    """Grey across a segment (2, 2) into work. view: the image and the table of the lens."""
    du, dv = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    length = np.sqrt(du * du + dv * dv) + 1e-12
    (image, lens), places, index = view, work[0], work[6]
    du, dv, nu, nv = du / SAMPLES, dv / SAMPLES, -dv / length, du / length
    u, v = ends[0, 0] + 0.5 * du, ends[0, 1] + 0.5 * dv
    place(lens, image.shape, u, v, du, dv, nu, nv, half, np.int64(0), np.int64(SAMPLES), places, index)
    sample(image, places, half, work[2], index, work[7])


@inner(fastmath=True)
def normalise(values, seen, profile, rows):
    """Fill profile (WIDTH, SAMPLES) with the columns of values, zero mean and unit norm (0 where not seen).

    rows (2 and more, SAMPLES): work space.
    """
    total, square, zero = rows[0], rows[1], np.float32(0.0)
    total[:] = zero
    square[:] = zero
    for k in range(WIDTH):
        for i in range(SAMPLES):
            total[i] += values[k, i]
    for k in range(WIDTH):
        for i in range(SAMPLES):
            rest = values[k, i] - total[i] / np.float32(WIDTH)
            profile[k, i] = rest
            square[i] += rest * rest
    for i in range(SAMPLES):
        square[i] = seen[i] / (np.sqrt(square[i]) + DIM)
    for k in range(WIDTH):
        for i in range(SAMPLES):
            profile[k, i] *= square[i]


@inner(fastmath=True)
def correlate(values, seen, profile, count, table, rows):
    """Correlations of profile (WIDTH, SAMPLES) with values from row j < count on into table, TOGETHER of them summed.

    table (SAMPLES / TOGETHER, LANES). Negative ones count 0, as does a sample that cannot be compared. Returns the
    number of samples that can. rows (4 and more, SAMPLES): work space.
    """
    total, square, weight, product = rows[0], rows[1], rows[2], rows[3]
    zero, share = np.float32(0.0), np.float32(1.0 / WIDTH)
    total[:] = zero
    square[:] = zero
    weight[:] = zero
    for k in range(WIDTH):
        for i in range(SAMPLES):
            grey, known = values[k, i], profile[k, i]
            total[i] += grey
            square[i] += grey * grey
            weight[i] += abs(known)
    usable = zero
    for i in range(SAMPLES):
        weight[i] = seen[i] if weight[i] > zero else zero
        usable += weight[i]
    for j in range(count):
        for i in range(SAMPLES):
            both = zero
            for k in range(WIDTH):
                both += values[j + k, i] * profile[k, i]
            rest = max(square[i] - total[i] * total[i] * share, zero)
            product[i] = weight[i] * max(both, zero) / (np.sqrt(rest) + DIM)
        for i in range(0, SAMPLES, TOGETHER):
            table[i // TOGETHER, j] = product[i] + product[i + 1] + product[i + 2] + product[i + 3]
        if j + 1 < count:
            for i in range(SAMPLES):
                old, new = values[j, i], values[j + WIDTH, i]
                total[i] += new - old
                square[i] += (new - old) * (new + old)
    return int(usable)


@inner(fastmath=True)
def best_shift(table, usable, reach, tilt, total):
    """(mean correlation, a, b) of the best displacement a + b s, s from -1 to 1 along the rows of table.

    |a| <= reach, |b| <= tilt; the columns of table are displacements from -(reach + tilt) on. total (LANES,): work
    space.
    """
    lanes = LANES - 2 * FAR_TILT
    best, best_a, best_b = np.float32(-1.0), 0, 0
    for b in range(-tilt, tilt + 1):
        total[:] = np.float32(0.0)
        for i in range(SAMPLES // TOGETHER):
            middle = ALONG[i * TOGETHER] + np.float32((TOGETHER - 1.0) / SAMPLES)
            row = table[i, np.uintp(int(np.floor(b * middle + np.float32(0.5))) + tilt):]
            for j in range(lanes):
                total[j] += row[j]
        for j in range(2 * reach + 1):
            value = total[j] / np.float32(usable) - np.float32(INERTIA * (abs(j - reach) + 2 * abs(b)))
            if value > best:
                best, best_a, best_b = value, j - reach, b
    return best + INERTIA * (abs(best_a) + 2 * abs(best_b)), best_a, best_b


@inner
def search(view, profile, ends, reach, tilt, work):
    """(mean correlation, a, b) where a profile fits best across predicted ends (2, 2); 0 if under half can be seen."""
    strip(view, ends, reach + tilt + HALF, work)
    usable = correlate(work[2], work[1], profile, 2 * (reach + tilt) + 1, work[3], work[5])
    if usable < SAMPLES // 2:
        return 0.0, 0, 0
    return best_shift(work[3], usable, reach, tilt, work[5][0])


@inner
def shift(ends, first, second):
    """Move the two ends (2, 2) along the segment's normal, in place."""
    du, dv = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    length = np.sqrt(du * du + dv * dv) + 1e-12
    nu, nv = -dv / length, du / length
    ends[0, 0] += first * nu
    ends[0, 1] += first * nv
    ends[1, 0] += second * nu
    ends[1, 1] += second * nv


@inner(fastmath=True)
def peaks(values, seen, first, reach, floor, found, block):
    """Strongest rising edge in rows first + reach + 2 +- reach of each column of values, near the middle by preference.

    first (SAMPLES,); found (3, SAMPLES) <- offset from that row, height (0: none), merit. block (ROWS, SAMPLES): work
    space.
    """
    zero, half, one = np.float32(0.0), np.float32(0.5), np.float32(1.0)
    narrow = one / np.float32(reach + 1)
    found[:] = zero
    for i in range(SAMPLES):
        for k in range(2 * reach + 5):
            block[k, i] = values[np.uintp(first[i] + k), i]
    for k in range(2 * reach + 1):
        for i in range(SAMPLES):
            before, g = half * (block[k + 2, i] - block[k, i]), half * (block[k + 3, i] - block[k + 1, i])
            after = half * (block[k + 4, i] - block[k + 2, i])
            curvature = before - g - g + after
            t = np.float32(k - reach) + half * (before - after) / min(curvature, np.float32(-1e-6))
            near = one - half * (t * narrow) * (t * narrow)
            better = (g >= floor) & (g >= before) & (g > after) & (g * near * seen[i] > found[2, i])
            found[0, i] = t if better else found[0, i]
            found[1, i] = g if better else found[1, i]
            found[2, i] = g * near if better else found[2, i]


@inner(fastmath=True)
def fit(found, scale, line):
    """Robust displacement a + b s of samples found (3, SAMPLES) with height > 0 (Cauchy weights of scale px).

    line (6,) <- a, b, variances of the two ends, share of the samples that agree within 2 scale, their mean height.
    """
    a = b = np.float32(0.0)
    zero, one, narrow = np.float32(0.0), np.float32(1.0), np.float32(1.0 / scale)
    for _ in range(6):
        w0 = w1 = w2 = y0 = y1 = squares = heights = agreed = zero
        for i in range(SAMPLES):
            y, s, g = found[0, i], ALONG[i], found[1, i]
            e = y - a - b * s
            q = (e * narrow) * (e * narrow)
            w = one / ((one + q) * (one + q)) if g > zero else zero
            w0 += w
            w1 += w * s
            w2 += w * s * s
            y0 += w * y
            y1 += w * s * y
            squares += w * e * e
            heights += w * g
            agreed += one if (g > zero) & (q < np.float32(4.0)) else zero
        determinant = w0 * w2 - w1 * w1
        if determinant < np.float32(1e-6):
            line[4] = 0.0
            return
        a, b = (w2 * y0 - w1 * y1) / determinant, (w0 * y1 - w1 * y0) / determinant
    variance = squares / w0
    line[0], line[1], line[4], line[5] = a, b, agreed / np.float32(SAMPLES), heights / w0
    line[2] = variance * (w2 + w1 + w1 + w0) / determinant
    line[3] = variance * (w2 - w1 - w1 + w0) / determinant


@inner
def measure(view, floor, half, a, b, ends, work):
    """Put a segment (2, 2) on the edge itself, in place; (support, variances px^2 of its ends, height of the edge).

    work holds its strip() of this half length, in which the edge is expected at a + b s px. floor: smallest gradient,
    grey/px. Support: share of the samples that lie on the edge; under LOST the search ends there.
    """
    seen, values, found = work[1], work[2], work[4]
    first, line = np.empty(SAMPLES, np.int64), np.zeros(6)
    for i in range(SAMPLES):
        first[i] = half - PEAK - 2 + a + int(np.floor(b * ALONG[i] + 0.5))
    peaks(values, seen, first, PEAK, np.float32(floor), found, work[5])
    for i in range(SAMPLES):
        found[0, i] += first[i] - (half - PEAK - 2 + a) - b * ALONG[i]
    fit(found, 1.0, line)
    if line[4] < LOST:
        return line[4], 0.0, 0.0, 0.0
    shift(ends, a + line[0] - b - line[1], a + line[0] + b + line[1])
    strip(view, ends, np.int64(3), work)
    first[:] = 0
    peaks(values, seen, first, 1, np.float32(floor), found, work[5])
    fit(found, 0.5, line)
    if line[4] >= LOST:
        shift(ends, line[0] - line[1], line[0] + line[1])
    return line[4], line[2], line[3], line[5]


@inner
def reach_ends(view, ends, floor, work):
    """Let both ends grow (OUTWARD at most) or shrink to where the edge is visible, in place."""
    du, dv = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    length = np.sqrt(du * du + dv * dv) + 1e-12
    tu, tv = du / length, dv / length
    (image, lens), places, seen, values, index = view, work[0], work[1], work[2], work[6]
    start, lanes = -min(INWARD, 0.4 * length), SAMPLES // 2
    for side, sign in enumerate((-1.0, 1.0)):
        u, v = ends[side, 0] + sign * start * tu, ends[side, 1] + sign * start * tv
        place(lens, image.shape, u, v, sign * END_STEP * tu, sign * END_STEP * tv, -tv, tu, np.int64(3),
              side * lanes, lanes, places, index)
    sample(image, places, np.int64(3), values, index, work[7])
    for side, sign in enumerate((-1.0, 1.0)):
        last, missed = start, 0
        for k in range(lanes):
            i, along = side * lanes + k, start + k * END_STEP
            if along > OUTWARD or missed > GAP:
                break
            before, after = values[2, i] - values[0, i], values[6, i] - values[4, i]
            here = max(values[3, i] - values[1, i], values[4, i] - values[2, i], values[5, i] - values[3, i])
            if seen[i] > 0.0 and here > 2.0 * floor and here > before and here >= after:
                last, missed = along, 0
            else:
                missed += 1
        ends[side, 0] += sign * last * tu
        ends[side, 1] += sign * last * tv


@inner
def remember(view, ends, profile, stripe, work):
    """Fill profile (WIDTH, SAMPLES) of a segment (2, 2), and stripe (2, 2); returns its width: see stripes.look()."""
    strip(view, ends, np.int64(HALF), work)
    width = look(work[2][:WIDTH], work[1], work[5][0], stripe)
    normalise(work[2], work[1], profile, work[5])
    return width


@inner
def length_of(ends):
    """px of one segment (2, 2)."""
    return np.hypot(ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1])


@kernel
def turn(R, focals, centre, ends, turned):
    """Fill turned (M, 2, 2) px with where segments ends (M, 2, 2) are after rotation R (3, 3) of a pinhole camera."""
    for m in range(len(ends)):
        for k in range(2):
            u, v = (ends[m, k, 0] - centre[0]) / focals[0], (ends[m, k, 1] - centre[1]) / focals[1]
            z = max(R[2, 0] * u + R[2, 1] * v + R[2, 2], 0.1)
            for p in range(2):
                turned[m, k, p] = (R[p, 0] * u + R[p, 1] * v + R[p, 2]) / z * focals[p] + centre[p]


@kernel
def follow(view, floor, same, on_edge, shortest, slots, profiles, ends, motion, variance, widths, stripes, good):
    """Carry predicted segments ends (M, 2, 2), in place, to where their profiles fit best and put them on their edges.

    profiles (capacity, WIDTH, SAMPLES) in rows slots (M,) are those of the previous image and become those of this one.
    motion (M, 2, 2): predicted; how far the edge moved across itself in addition is added. variance (M, 2) px^2 of each
    end across the segment. widths (M,) px and stripes (M, 2, 2) as stripes.look() has them. good (M,): correlation
    above same, support above on_edge and length above shortest.
    """
    work, start = workspace(), np.empty((2, 2))
    for m in range(len(ends)):
        profile, end, reach, tilt = profiles[slots[m]], ends[m], np.int64(NEAR), np.int64(NEAR_TILT)
        score, a, b = search(view, profile, end, reach, tilt, work)
        if score < SURE or abs(a) == reach or abs(b) == tilt:
            reach, tilt = np.int64(FAR), np.int64(FAR_TILT)
            score, a, b = search(view, profile, end, reach, tilt, work)
        good[m] = False
        if not score > same:
            continue
        for k in range(2):
            start[k, 0], start[k, 1] = end[k, 0], end[k, 1]
        support, variance[m, 0], variance[m, 1], height = measure(view, floor, reach + tilt + HALF, a, b, end, work)
        if not support > on_edge:
            continue
        for k in range(2):
            motion[m, k, 0] += end[k, 0] - start[k, 0]
            motion[m, k, 1] += end[k, 1] - start[k, 1]
        reach_ends(view, end, max(floor, CLEAR * height), work)
        if length_of(end) > shortest:
            good[m] = True
            widths[m] = remember(view, end, profile, stripes[m], work)


@kernel
def settle(view, floor, on_edge, shortest, wanted, ends, variance, good):
    """Put new segments ends (M, 2, 2) on their edges, in place, until as many as wanted are; see follow()."""
    work, half, middle, count = workspace(), np.int64(PEAK + 2), np.int64(0), 0
    good[:] = False
    for m in range(len(ends)):
        if count == wanted:
            break
        strip(view, ends[m], half, work)
        support, variance[m, 0], variance[m, 1], height = measure(view, floor, half, middle, middle, ends[m],
                                                                      work)
        if support > on_edge:
            reach_ends(view, ends[m], max(floor, CLEAR * height), work)
            good[m] = length_of(ends[m]) > shortest
            count += good[m]


@kernel
def learn(view, ends, slots, profiles, widths, stripes):
    """Fill rows slots (M,) of profiles (capacity, WIDTH, SAMPLES), and widths (M,) and stripes (M, 2, 2), with those of
    segments ends (M, 2, 2); see remember()."""
    work = workspace()
    for m in range(len(ends)):
        widths[m] = remember(view, ends[m], profiles[slots[m]], stripes[m], work)
