"""Compiled alignment (inverse compositional Lucas-Kanade) of square patches, blind to gain and offset of the light.

Images are float32. A patch of SIZE x SIZE pixels is sampled around (u, v); the residual of every pixel is

    e = I(W(x)) - (1 + gain) T(x) - offset

and the template's own gradient gives the Jacobian, so that the normal matrix is inverted once per template
(Baker and Matthews, Lucas-Kanade 20 years on, 2004, inverse compositional algorithm).
"""
from __future__ import annotations

import numpy as np
from numba import njit

RADIUS = 7  # px
SIZE = 2 * RADIUS + 1


@njit(cache=True, nogil=True, error_model='numpy', fastmath=True)
def cut(image, u, v, patch):
    """Fill patch (SIZE + 2, SIZE + 2) with bilinear grey around (u, v); False when it leaves the image."""
    h, w = image.shape
    c, r = int(np.floor(u)), int(np.floor(v))
    if not (c - RADIUS - 1 >= 0 and r - RADIUS - 1 >= 0 and c + RADIUS + 2 < w and r + RADIUS + 2 < h):
        return False
    a, b = np.float32(u - c), np.float32(v - r)
    one = np.float32(1.0)
    w00, w01, w10, w11 = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
    for y in range(SIZE + 2):
        top, low = image[r - RADIUS - 1 + y], image[r - RADIUS + y]
        x0 = c - RADIUS - 1
        for x in range(SIZE + 2):
            patch[y, x] = w00 * top[x0 + x] + w01 * top[x0 + x + 1] + w10 * low[x0 + x] + w11 * low[x0 + x + 1]
    return True


@njit(cache=True, nogil=True, error_model='numpy', fastmath=True)
def slide(previous, current, u0, v0, u, v, steps, patch, moved):
    """Translate (u, v) in current until it shows what previous shows at (u0, v0).

    patch, moved: work space (SIZE + 2, SIZE + 2). Returns (ok, u, v).
    """
    if not cut(previous, u0, v0, patch):
        return False, u, v
    sx = sy = st = sxx = sxy = syy = sxt = syt = stt = 0.0
    for y in range(1, SIZE + 1):
        for x in range(1, SIZE + 1):
            t = patch[y, x]
            gx, gy = 0.5 * (patch[y, x + 1] - patch[y, x - 1]), 0.5 * (patch[y + 1, x] - patch[y - 1, x])
            sx += gx
            sy += gy
            st += t
            sxx += gx * gx
            sxy += gx * gy
            syy += gy * gy
            sxt += gx * t
            syt += gy * t
            stt += t * t
    n = SIZE * SIZE
    mx, my, mt = sx / n, sy / n, st / n
    sxx, sxy, syy = sxx - sx * mx, sxy - sx * my, syy - sy * my
    sxt, syt, stt = sxt - sx * mt, syt - sy * mt, stt - st * mt + 1e-3
    # the gain is eliminated: Schur complement on the 2 x 2 of the translation
    hxx, hxy, hyy = sxx - sxt * sxt / stt, sxy - sxt * syt / stt, syy - syt * syt / stt
    determinant = hxx * hyy - hxy * hxy
    if determinant < 1e-6 * n * n or hxx + hyy < n * 0.2:
        return False, u, v
    for _ in range(steps):
        if not cut(current, u, v, moved):
            return False, u, v
        bx = by = bt = be = 0.0
        for y in range(1, SIZE + 1):
            for x in range(1, SIZE + 1):
                t = patch[y, x]
                e = moved[y, x] - t
                bx += 0.5 * (patch[y, x + 1] - patch[y, x - 1]) * e
                by += 0.5 * (patch[y + 1, x] - patch[y - 1, x]) * e
                bt += t * e
                be += e
        bx, by, bt = bx - mx * be, by - my * be, bt - mt * be
        bx, by = bx - sxt * bt / stt, by - syt * bt / stt
        du, dv = (hyy * bx - hxy * by) / determinant, (hxx * by - hxy * bx) / determinant
        gain = min(max(1.0 + (bt - sxt * du - syt * dv) / stt, 0.5), 2.0)
        du, dv = du / gain, dv / gain
        u, v = u - du, v - dv
        if du * du + dv * dv < 4e-4:
            break
    return True, u, v


@njit(cache=True, nogil=True, error_model='numpy')
def follow(previous, current, start, uv, lowest, steps, ok):
    """Move guesses uv (N, 2), in place, by translation of patches, from the coarsest pyramid level to lowest.

    Only rows with ok (N,) are looked at; it becomes False where level 0 has no answer (a coarse one may be left out).
    """
    patch, moved = np.empty((SIZE + 2, SIZE + 2), np.float32), np.empty((SIZE + 2, SIZE + 2), np.float32)
    for i in range(len(start)):
        if not ok[i]:
            continue
        u, v = uv[i]
        for level in range(len(previous) - 1, lowest - 1, -1):
            scale = 0.5 ** level
            good, a, b = slide(previous[level], current[level], start[i, 0] * scale, start[i, 1] * scale,
                               u * scale, v * scale, steps, patch, moved)
            if good:
                u, v = a / scale, b / scale
            elif level == 0:
                ok[i] = False
        uv[i, 0], uv[i, 1] = u, v


@njit(cache=True, nogil=True, error_model='numpy')
def _learn_one(image, u, v, template, inverse, patch):
    """Remember the patch at (u, v): template (3, SIZE, SIZE) grey and gradients, inverse (8, 8) of the normal matrix.

    Parameters: translation u v, affine uu uv vu vv (per RADIUS), gain, offset. False outside or without texture.
    """
    if not cut(image, u, v, patch):
        return False
    H, J = np.zeros((8, 8)), np.empty(8)
    for y in range(SIZE):
        for x in range(SIZE):
            t = patch[y + 1, x + 1]
            gx, gy = 0.5 * (patch[y + 1, x + 2] - patch[y + 1, x]), 0.5 * (patch[y + 2, x + 1] - patch[y, x + 1])
            template[0, y, x], template[1, y, x], template[2, y, x] = t, gx, gy
            a, b = (x - RADIUS) / RADIUS, (y - RADIUS) / RADIUS
            J[0], J[1], J[2], J[3], J[4], J[5], J[6], J[7] = gx, gy, gx * a, gx * b, gy * a, gy * b, t, 1.0
            for p in range(8):
                for q in range(p + 1):
                    H[p, q] += J[p] * J[q]
    for p in range(8):
        H[p, p] *= 1.0 + 1e-6
        for q in range(p):
            H[q, p] = H[p, q]
    for p in range(2, 6):
        H[p, p] += 50.0  # a weak belief that the shape does not change
    if H[0, 0] * H[1, 1] - H[0, 1] ** 2 < 1e-3 * SIZE**4 or abs(np.linalg.det(H)) < 1e-12:
        return False
    inverse[:] = np.linalg.inv(H)
    return True


@njit(cache=True, nogil=True, error_model='numpy')
def learn(image, uv, templates, inverses, ok):
    """Remember the patches at uv (N, 2) of the rows with ok (N,), which becomes False where it is not possible."""
    patch = np.empty((SIZE + 2, SIZE + 2), np.float32)
    for i in range(len(uv)):
        ok[i] = ok[i] and _learn_one(image, uv[i, 0], uv[i, 1], templates[i], inverses[i], patch)


@njit(cache=True, nogil=True, error_model='numpy', fastmath=True)
def warp(image, u, v, A, moved):
    """Fill moved (SIZE, SIZE) with grey at (u, v) + A (x, y); False when it leaves the image."""
    h, w = image.shape
    reach_u, reach_v = RADIUS * (abs(A[0, 0]) + abs(A[0, 1])), RADIUS * (abs(A[1, 0]) + abs(A[1, 1]))
    if not (u - reach_u >= 1.0 and v - reach_v >= 1.0 and u + reach_u < w - 2.0 and v + reach_v < h - 2.0):
        return False
    a00, a01, a10, a11 = np.float32(A[0, 0]), np.float32(A[0, 1]), np.float32(A[1, 0]), np.float32(A[1, 1])
    for y in range(SIZE):
        pu = np.float32(u) + a01 * np.float32(y - RADIUS)
        pv = np.float32(v) + a11 * np.float32(y - RADIUS)
        for x in range(SIZE):
            cu, cv = pu + a00 * np.float32(x - RADIUS), pv + a10 * np.float32(x - RADIUS)
            c, r = int(cu), int(cv)
            a, b = cu - np.float32(c), cv - np.float32(r)
            top = image[r, c] + a * (image[r, c + 1] - image[r, c])
            low = image[r + 1, c] + a * (image[r + 1, c + 1] - image[r + 1, c])
            moved[y, x] = top + b * (low - top)
    return True


@njit(cache=True, nogil=True, error_model='numpy', fastmath=True)
def align(image, templates, inverses, uv, shapes, steps, score):
    """Align remembered patches with image by an affine warp.

    templates (N, 3, SIZE, SIZE), inverses (N, 8, 8); guesses uv (N, 2) and shapes (N, 2, 2) are improved in place.
    score (N,): correlation of the aligned patches, 0 when they left the image.
    """
    moved = np.empty((SIZE, SIZE), np.float32)
    rhs = np.empty(8)
    n = SIZE * SIZE
    for i in range(len(uv)):
        A, T, H = shapes[i], templates[i], inverses[i]
        score[i] = 0.0
        settled = False
        for step in range(steps + 1):
            if not warp(image, uv[i, 0], uv[i, 1], A, moved):
                score[i] = 0.0
                break
            b0 = b1 = b2 = b3 = b4 = b5 = b6 = b7 = sm = smm = st = stt = 0.0
            for y in range(SIZE):
                r0 = r1 = r2 = r4 = r6 = r7 = np.float32(0.0)
                q0 = q1 = q2 = np.float32(0.0)
                for x in range(SIZE):
                    t, m = T[0, y, x], moved[y, x]
                    e, a = m - t, np.float32(x - RADIUS)
                    ex, ey = e * T[1, y, x], e * T[2, y, x]
                    r0 += ex
                    r1 += ey
                    r2 += ex * a
                    r4 += ey * a
                    r6 += e * t
                    r7 += e
                    q0 += m * m
                    q1 += t
                    q2 += t * t
                b = (y - RADIUS) / RADIUS
                b0 += r0
                b1 += r1
                b2 += r2 / RADIUS
                b3 += r0 * b
                b4 += r4 / RADIUS
                b5 += r1 * b
                b6 += r6
                b7 += r7
                smm += q0
                st += q1
                stt += q2
            sm = b7 + st
            cross = b6 + stt - sm * st / n
            score[i] = cross / np.sqrt(max((smm - sm * sm / n) * (stt - st * st / n), 1.0))
            if settled or step == steps:
                break
            rhs[0], rhs[1], rhs[2], rhs[3], rhs[4], rhs[5], rhs[6], rhs[7] = b0, b1, b2, b3, b4, b5, b6, b7
            d = np.dot(H, rhs)
            g = min(max(1.0 + d[6], 0.5), 2.0)
            d[:6] /= g
            # compose with the inverse of x -> (I + D) x + d, first order in D
            d00, d01, d10, d11 = 1.0 + d[2] / RADIUS, d[3] / RADIUS, d[4] / RADIUS, 1.0 + d[5] / RADIUS
            determinant = d00 * d11 - d01 * d10
            if not determinant > 0.25:
                score[i] = 0.0
                break
            i00, i01, i10, i11 = d11 / determinant, -d01 / determinant, -d10 / determinant, d00 / determinant
            a00, a01, a10, a11 = A[0, 0], A[0, 1], A[1, 0], A[1, 1]
            A[0, 0], A[0, 1] = a00 * i00 + a01 * i10, a00 * i01 + a01 * i11
            A[1, 0], A[1, 1] = a10 * i00 + a11 * i10, a10 * i01 + a11 * i11
            uv[i, 0] -= A[0, 0] * d[0] + A[0, 1] * d[1]
            uv[i, 1] -= A[1, 0] * d[0] + A[1, 1] * d[1]
            settled = d[0] * d[0] + d[1] * d[1] < 1e-4
