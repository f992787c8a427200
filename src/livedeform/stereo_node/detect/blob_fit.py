"""Sub-pixel centres: a blurred ellipse on a sloping background, fitted to the grey values around a blob.

    I(p) = b + l + (c + l c / b) f,   l = g . (p - p0),   f = erfc(d / (sqrt(2) s)) / 2,
    d = (|M (p - c0)| - 1) / |grad|M (p - c0)||

d is the first-order (Sampson) distance to the ellipse |M (p - c0)| = 1 with M symmetric, s the blur, c the contrast
(negative: darker than around). l is the slope of the light, which falls on the ink as on the ground: ink of a quarter
of the ground's grey shows a quarter of it. (With the same slope on both a disc on a curved body is measured 0.02 px
off.) A reflexion's slope is the same on both, so that the last step frees the slope on the ink: m . (p - p0) f beside
the above, with a prior for m of zero within ``FREE_SLOPE`` of the difference.

A sector of the disc whose ground or ink is not what the fit says is covered by something else (the probe, a neighbour,
the body's own silhouette): it is left out, and the rest is fitted again.

An outline that is no ellipse (egg-shaped, where the body stretches one end of a disc more than the other) shows by the
third harmonic of what the rim leaves: the *skewness*, as far as it is more than noise. The same stretching displaces
the middle by about three times as much, which no outline shows.

Ten parameters: centre (2), M (3), s, b, g (2), c. Levenberg-Marquardt with weights that fall off beyond four residual
sigmas, so that a specular spot or an occluded rim pulls little. The covariance of the centre is the marginal of
s_r^2 (J^T W J + prior)^-1, s_r the robust residual (Shortis et al. 1994 compare centroids with such fits).
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from livedeform.common.types import Array

N_PARAMETERS = 10
N_RESULTS = N_PARAMETERS + 8
"""Columns of a fit: x, y, m11, m12, m22, blur, background, gx, gy, contrast, var_x, cov_xy, var_y, residual sigma,
share of the rim that was seen, ok (1) or the reason why not (0 no convergence, -1 left its window), number of
pixels, skewness px."""
SQRT2 = math.sqrt(2.0)
INV_SQRT_2PI = 1.0 / math.sqrt(2.0 * math.pi)


FREE_SLOPE = 0.5  # share of the slope's part that the ink takes away which may not be so
N_SECTORS = 16
TAN_1 = math.tan(2.0 * math.pi / N_SECTORS)
HIDDEN = 0.2  # of the contrast: a sector whose ground or ink is off by more is covered by something else
MOST_HIDDEN = 6  # sectors
SKEW_NOISE = 6.0  # variances: noise alone has one (two degrees of freedom), and more than this once in 400 times
LEAST_SLOPE = 2e-4  # of the contrast per pixel: the same where there is no slope

# The rim's profile and its derivative at z = distance / blur, tabulated: interpolation errs by less than 1e-6.
Z_MOST, Z_STEP = 3.8, 0.004  # beyond, the rim's part is below 1e-4 of the contrast
_Z = np.arange(-Z_MOST - Z_STEP, Z_MOST + 3 * Z_STEP, Z_STEP)
PROFILE = np.ascontiguousarray(np.stack([0.5 * erfc(_Z / SQRT2), INV_SQRT_2PI * np.exp(-0.5 * _Z**2)], axis=1))
DERIVATIVES = 9  # rows of the room for a blob's pixels: place (2), grey, distance, profile, its derivative, residual,
N_WORK = DERIVATIVES + 14  # weight, a weighted derivative; the derivatives


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _sector(ex, ey):
    """Which of the 16 sectors round the middle, from the negative x axis on, a place in units of the half axes lies
    in."""
    x, y = abs(ex), abs(ey)
    k = int(y > TAN_1 * x) + int(y > x) + int(x < TAN_1 * y)  # from the x axis on
    if ey < 0.0:
        return k if ex < 0.0 else 7 - k
    return 15 - k if ex < 0.0 else 8 + k


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _rim(m11, m12, m22, dx, dy):
    """Of a place (dx, dy) px from the middle: M (dx, dy), its length q, the gradient of q, and that one's length."""
    qx = m11 * dx + m12 * dy
    qy = m12 * dx + m22 * dy
    q = math.sqrt(qx * qx + qy * qy) + 1e-12
    gx = (m11 * qx + m12 * qy) / q
    gy = (m12 * qx + m22 * qy) / q
    return qx, qy, q, gx, gy, math.sqrt(gx * gx + gy * gy) + 1e-12


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _window(picture, p, reach):
    """First and last column and row (exclusive) of what lies within ``reach`` px of the outline of ``p``."""
    rows, cols = picture.shape
    det = p[2] * p[4] - p[3] * p[3]
    # half axes of the bounding box of |M d| = 1 are the row norms of M^-1
    half_x = int(math.sqrt(p[4] * p[4] + p[3] * p[3]) / det + reach + 1.0)
    half_y = int(math.sqrt(p[2] * p[2] + p[3] * p[3]) / det + reach + 1.0)
    x, y = int(np.rint(p[0])), int(np.rint(p[1]))
    return max(0, x - half_x), min(cols, x + half_x + 1), max(0, y - half_y), min(rows, y + half_y + 1)


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _choose(picture, p, margin, hidden, work):
    """Writes the pixels within ``margin`` px of the outline of ``p`` into ``work``: their places relative to its middle
    and their greys, without those in ``hidden`` (N_SECTORS,) sectors. Returns their number and ``work`` with room for
    them.

    They stay the same from step to step, so that the steps' costs can be compared.
    """
    left, right, top, bottom = _window(picture, p, margin)
    if work.shape[1] < (right - left) * (bottom - top):
        work = np.empty((N_WORK, (right - left) * (bottom - top)))
    some_hidden = hidden.any()
    ax, ay, grey = work[0], work[1], work[2]
    n = 0
    for v in range(top, bottom):
        for u in range(left, right):
            qx, qy, q, _, _, norm = _rim(p[2], p[3], p[4], u - p[0], v - p[1])
            if q - 1.0 > margin * norm or (some_hidden and hidden[_sector(qx, qy)]):
                continue
            ax[n] = u - p[0]
            ay[n] = v - p[1]
            grey[n] = picture[v, u]
            n += 1
    return n, work


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _profile(n, p, middle, table, work):
    """The rim's profile f, its derivative and the distance d of the ``n`` pixels of ``work``, into it."""
    ax, ay, distance, inside, density = work[0], work[1], work[3], work[4], work[5]
    m11, m12, m22, s = p[2], p[3], p[4], p[5]
    shift_x, shift_y = middle[0] - p[0], middle[1] - p[1]
    for k in range(n):
        _, _, q, _, _, norm = _rim(m11, m12, m22, ax[k] + shift_x, ay[k] + shift_y)
        distance[k] = (q - 1.0) / norm
    for k in range(n):
        place = (min(max(distance[k] / s, -Z_MOST), Z_MOST) + Z_MOST) / Z_STEP + 1.0
        i = int(place)
        f = place - i
        inside[k] = table[i, 0] + f * (table[i + 1, 0] - table[i, 0])
        density[k] = (table[i, 1] + f * (table[i + 1, 1] - table[i, 1])) / s


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _residuals(n, p, scale, work):
    """Residuals and weights of the ``n`` pixels into ``work``; returns cost, sum of the weights, weights and number of
    the pixels on the rim. A ``scale`` of 0 weighs all alike."""
    ax, ay, grey, distance, inside = work[0], work[1], work[2], work[3], work[4]
    residual, weight = work[6], work[7]
    ink = min(max(p[9] / max(p[6], 5.0), -1.0), 3.0)
    per_scale = 1.0 / scale if scale > 0.0 else 0.0
    b, gx, gy, c = p[6], p[7], p[8], p[9]
    for k in range(n):
        light = gx * ax[k] + gy * ay[k]
        residual[k] = grey[k] - (b + light + (c + ink * light) * inside[k])
    for k in range(n):
        a = max(abs(residual[k]) * per_scale, 1.0)
        weight[k] = 1.0 / (a * a)
    cost = weight_sum = rim_weight = rim_count = 0.0
    for k in range(n):
        cost += weight[k] * residual[k] * residual[k]
        weight_sum += weight[k]
        on_rim = 1.0 if abs(distance[k]) < 1.5 else 0.0
        rim_weight += on_rim * weight[k]
        rim_count += on_rim
    return cost, weight_sum, rim_weight, rim_count


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _derivatives(n, p, middle, work):
    """Derivatives of the model with respect to the ten parameters at the ``n`` pixels, into the rows of ``work`` from
    ``DERIVATIVES`` on."""
    ax, ay, distance, inside, density = work[0], work[1], work[3], work[4], work[5]
    m11, m12, m22, s = p[2], p[3], p[4], p[5]
    shift_x, shift_y = middle[0] - p[0], middle[1] - p[1]
    ink = min(max(p[9] / max(p[6], 5.0), -1.0), 3.0)
    gx, gy, c = p[7], p[8], p[9]
    J = work[DERIVATIVES:]
    for k in range(n):
        dx, dy = ax[k] + shift_x, ay[k] + shift_y
        qx, qy, q, hx, hy, norm = _rim(m11, m12, m22, dx, dy)
        steep = (c + ink * (gx * ax[k] + gy * ay[k])) * density[k]  # dI / d(distance), with the other sign
        per_q = -steep / (norm * q)
        J[0, k] = -per_q * hx * q
        J[1, k] = -per_q * hy * q
        J[2, k] = per_q * qx * dx
        J[3, k] = per_q * (qx * dy + qy * dx)
        J[4, k] = per_q * qy * dy
        J[5, k] = steep * distance[k] / s
        J[6, k] = 1.0
        J[7, k] = ax[k] * (1.0 + ink * inside[k])
        J[8, k] = ay[k] * (1.0 + ink * inside[k])
        J[9, k] = inside[k]


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _more_derivatives(n, p, middle, work):
    """The same for the slope on the ink (2) and the outline's third harmonic (2)."""
    ax, ay, inside, density = work[0], work[1], work[4], work[5]
    shift_x, shift_y = middle[0] - p[0], middle[1] - p[1]
    ink = min(max(p[9] / max(p[6], 5.0), -1.0), 3.0)
    J = work[DERIVATIVES:]
    for k in range(n):
        J[10, k] = ax[k] * inside[k]
        J[11, k] = ay[k] * inside[k]
        qx, qy, q, _, _, _ = _rim(p[2], p[3], p[4], ax[k] + shift_x, ay[k] + shift_y)
        cosine, sine = qx / q, qy / q
        steep = (p[9] + ink * (p[7] * ax[k] + p[8] * ay[k])) * density[k]
        J[12, k] = steep * cosine * (4.0 * cosine * cosine - 3.0)
        J[13, k] = steep * sine * (3.0 - 4.0 * sine * sine)


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _normal_equations(n, work, H, g):
    """H = J^T W J and g = J^T W r of as many parameters as ``g`` has room for."""
    residual, weight, weighted = work[6], work[7], work[8]
    for i in range(len(g)):
        a = work[DERIVATIVES + i]
        total = 0.0
        for k in range(n):
            weighted[k] = a[k] * weight[k]
        for k in range(n):
            total += weighted[k] * residual[k]
        g[i] = total
        for j in range(i + 1):
            b = work[DERIVATIVES + j]
            total = 0.0
            for k in range(n):
                total += weighted[k] * b[k]
            H[i, j] = total
            H[j, i] = total


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _find_hidden(picture, p, hidden, noise, sums):
    """Adds to ``hidden`` the sectors whose ground outside the rim or whose ink inside it is not as in the others;
    returns how many there are that were not hidden before. ``sums`` (4, N_SECTORS): room.

    The fit's own ground and slope do not count, since what covers a disc has pulled them.
    """
    reach = 2.5 + p[5]
    left, right, top, bottom = _window(picture, p, reach)
    sums[:] = 0.0
    for v in range(top, bottom):
        for u in range(left, right):
            qx, qy, q, _, _, norm = _rim(p[2], p[3], p[4], u - p[0], v - p[1])
            d = (q - 1.0) / norm
            if abs(d) < 0.8 + p[5] or d > reach or d < -3.0 - p[5]:
                continue
            k = _sector(qx, qy)
            row = 0 if d > 0.0 else 2
            sums[row, k] += picture[v, u]
            sums[row + 1, k] += 1.0
    new = 0
    for row in (0, 2):
        new += _odd_sectors(sums[row], sums[row + 1], hidden, abs(p[9]), noise)
    return new


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _odd_sectors(total, count, hidden, contrast, noise):
    """Adds to ``hidden`` the sectors whose mean grey lies off a slope through the others'."""
    values = np.empty(N_SECTORS)
    n = 0
    for k in range(N_SECTORS):
        if count[k] >= 3.0 and not hidden[k]:
            values[n] = total[k] / count[k]
            n += 1
    if n < 8:
        return 0
    middle = np.median(values[:n])
    A = np.zeros((3, 3))
    y = np.zeros(3)
    x = np.zeros(3)
    row = np.ones(3)
    for k in range(N_SECTORS):  # a slope through those that are not far off
        if count[k] >= 3.0 and not hidden[k] and abs(total[k] / count[k] - middle) < 2.0 * HIDDEN * contrast:
            angle = (k + 0.5) / N_SECTORS * 2.0 * math.pi - math.pi
            row[1] = math.cos(angle)
            row[2] = math.sin(angle)
            for i in range(3):
                y[i] += row[i] * (total[k] / count[k] - middle)
                for j in range(3):
                    A[i, j] += row[i] * row[j]
    for i in range(3):
        A[i, i] += 1e-3
    if not _solve(A, y, x):
        return 0
    new = 0
    odd = np.zeros(N_SECTORS, np.bool_)
    for k in range(N_SECTORS):
        if count[k] >= 3.0 and not hidden[k]:
            angle = (k + 0.5) / N_SECTORS * 2.0 * math.pi - math.pi
            off = total[k] / count[k] - middle - x[0] - x[1] * math.cos(angle) - x[2] * math.sin(angle)
            odd[k] = abs(off) > HIDDEN * contrast + 4.0 * noise / math.sqrt(count[k])
    for k in range(N_SECTORS):
        if odd[k]:
            hidden[k] = True
            new += 1
    return new


@numba.njit(cache=True)
def _copy(source, target):
    """The upper left part of ``source`` that fits. (Assigning slices does the same, but takes seconds to compile.)"""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _solve(A, b, x):
    """Solves A x = b for a symmetric positive definite A, which is overwritten; False if it is not."""
    n = b.size
    for i in range(n):
        x[i] = b[i]
    for j in range(n):  # A = U^T D U, from the upper triangle
        if not A[j, j] > 1e-14:
            return False
        per_d = 1.0 / A[j, j]
        for i in range(j + 1, n):
            share = A[j, i] * per_d
            for k in range(i, n):
                A[i, k] -= share * A[j, k]
            x[i] -= share * x[j]
        A[j, j] = per_d
    for j in range(n - 1, -1, -1):
        for k in range(j + 1, n):
            x[j] -= A[j, k] * x[k]
        x[j] *= A[j, j]
    return True


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _plausible(p, start, limit):
    if abs(p[0] - start[0]) > limit or abs(p[1] - start[1]) > limit:
        return False
    det = p[2] * p[4] - p[3] * p[3]
    if p[2] <= 0.0 or p[4] <= 0.0 or det <= 0.0:
        return False
    return 0.15 < p[5] < 12.0


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _descend(picture, p, start, margin_px, noise_floor, max_iterations, table, hidden, work):
    """Levenberg-Marquardt from ``p`` (10,), which it moves. Returns whether it converged (1, else 0), the robust scale,
    the pixels' number, what they are placed relative to, and ``work``."""
    H, g, A, step, trial = np.empty((10, 10)), np.empty(10), np.empty((10, 10)), np.empty(10), np.empty(10)
    radius = math.sqrt(1.0 / (p[2] * p[4] - p[3] * p[3]))
    limit = max(2.0, 0.7 * radius)
    chosen = p.copy()
    n, work = _choose(picture, chosen, max(margin_px, 0.5 * radius), hidden, work)
    scale, damping = 0.0, 1e-3
    _profile(n, p, chosen, table, work)
    cost, weight, _, _ = _residuals(n, p, scale, work)
    for iteration in range(max_iterations):
        if iteration == 2 or iteration == 5:  # weights only after the shape is roughly right
            # the pixels that take part are chosen anew: the start's outline may be far too small for the blur
            for i in range(2, 5):
                chosen[i] = p[i]
            radius = math.sqrt(1.0 / (p[2] * p[4] - p[3] * p[3]))
            n, work = _choose(picture, chosen, max(margin_px, 0.5 * radius, 3.0 * p[5]), hidden, work)
            scale = 4.0 * max(noise_floor, math.sqrt(cost / max(weight - 10.0, 1.0)))
            _profile(n, p, chosen, table, work)
            cost, weight, _, _ = _residuals(n, p, scale, work)
        _derivatives(n, p, chosen, work)
        _normal_equations(n, work, H, g)
        accepted = False
        for _ in range(10):
            _copy(H, A)
            for i in range(10):
                A[i, i] = H[i, i] * (1.0 + damping) + 1e-12
            if _solve(A, g, step):
                for i in range(10):
                    trial[i] = p[i] + step[i]
                if _plausible(trial, start, limit):
                    _profile(n, trial, chosen, table, work)
                    new_cost, new_weight, _, _ = _residuals(n, trial, scale, work)
                    # reweighting changes the cost's meaning: compare mean squares
                    if new_cost / max(new_weight, 1.0) <= cost / max(weight, 1.0) * (1.0 + 1e-9):
                        accepted = True
                        break
            damping = damping * 10.0 + 1e-3
        if not accepted:
            return (1.0 if iteration >= 2 else 0.0), scale, n, chosen, work
        for i in range(10):
            p[i] = trial[i]
        cost, weight = new_cost, new_weight
        damping = max(damping * 0.1, 1e-9)
        centre_stands = abs(step[0]) < 2e-3 and abs(step[1]) < 2e-3  # the next step would be far smaller
        rim_stands = abs(step[5]) < 0.03 * p[5] and abs(step[9]) < 0.01 * abs(p[9])
        if iteration >= 2 and centre_stands and rim_stands:
            return 1.0, scale, n, chosen, work
    return 0.0, scale, n, chosen, work


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _finish(p, status, noise_floor, scale, n, chosen, table, hidden, work, out):
    """The last step from ``p``, with the slope on the ink free, and the covariance: a row ``out`` (N_RESULTS,)."""
    H, g, A, step, unit = np.empty((14, 14)), np.empty(14), np.empty((12, 12)), np.empty(12), np.zeros(12)
    _profile(n, p, chosen, table, work)
    cost, weight, rim_weight, rim_count = _residuals(n, p, scale, work)
    _derivatives(n, p, chosen, work)
    _more_derivatives(n, p, chosen, work)
    _normal_equations(n, work, H, g)
    sigma2 = max(cost / max(weight - 10.0, 1.0), noise_floor * noise_floor)
    taken = min(abs(p[9]) / max(p[6], 5.0), 1.0) * math.sqrt(p[7] * p[7] + p[8] * p[8])
    free = FREE_SLOPE * taken + LEAST_SLOPE * abs(p[9])
    H[10, 10] += sigma2 / (free * free)
    H[11, 11] += sigma2 / (free * free)
    for i in range(12):
        H[i, i] = H[i, i] * (1.0 + 1e-10) + 1e-12
    third = H[12, 12] + H[13, 13] + 1e-12
    skew2 = 4.0 * (g[12] * g[12] + g[13] * g[13]) / (third * third)
    out[17] = math.sqrt(max(skew2 - SKEW_NOISE * sigma2 * 4.0 / third, 0.0))
    _copy(H, A)
    if _solve(A, g[:12], step) and abs(step[0]) < 0.3 and abs(step[1]) < 0.3:
        p[0] += step[0]
        p[1] += step[1]
    for i in range(10):
        out[i] = p[i]
    for k in range(2):
        unit[:] = 0.0
        unit[k] = 1.0
        _copy(H, A)
        if not _solve(A, unit, step):
            status = 0.0
            break
        out[11 if k == 0 else 12] = sigma2 * step[1]
        if k == 0:
            out[10] = sigma2 * step[0]
    out[13] = math.sqrt(sigma2)
    out[14] = rim_weight / max(rim_count, 1.0) * (1.0 - hidden.sum() / N_SECTORS)
    out[15] = status
    out[16] = n


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _fit_blobs(picture, start, margin_px, noise_floor, max_iterations, table):
    out = np.zeros((start.shape[0], N_RESULTS))
    hidden = np.zeros(N_SECTORS, np.bool_)
    sums = np.empty((4, N_SECTORS))
    work = np.empty((N_WORK, 0))
    for b in range(start.shape[0]):
        p = start[b].copy()
        hidden[:] = False
        for _ in range(3):
            status, scale, n, chosen, work = _descend(
                picture, p, start[b], margin_px, noise_floor, max_iterations, table, hidden, work
            )
            if status <= 0.0 or _find_hidden(picture, p, hidden, noise_floor, sums) == 0:
                break
            if hidden.sum() > MOST_HIDDEN:
                break
            p[7] = 0.0
            p[8] = 0.0
        _finish(p, status, noise_floor, scale, n, chosen, table, hidden, work, out[b])
    return out


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def surrounded(picture, centres, axes, least):
    """(n,) bool: whether the spots (half axes (n, 2) px) differ from most of a ring around them, all in the same sense.

    A saddle between markers, a streak or an edge does not; the fit need not look at it.
    """
    n = centres.shape[0]
    out = np.zeros(n, np.bool_)
    rows, cols = picture.shape
    for k in range(n):
        x = int(np.rint(centres[k, 0]))
        y = int(np.rint(centres[k, 1]))
        if x < 1 or y < 1 or x >= cols - 1 or y >= rows - 1:
            continue
        middle = 0.0
        for v in range(y - 1, y + 2):
            for u in range(x - 1, x + 2):
                middle += picture[v, u] / 9.0
        lighter = 0
        darker = 0
        count = 0
        for a in range(16):
            angle = 2.0 * math.pi * a / 16.0
            u = int(np.rint(centres[k, 0] + (1.4 * axes[k, 0] + 1.5) * math.cos(angle)))
            v = int(np.rint(centres[k, 1] + (1.4 * axes[k, 1] + 1.5) * math.sin(angle)))
            if 0 <= u < cols and 0 <= v < rows:
                count += 1
                if picture[v, u] > middle + least:
                    lighter += 1
                elif picture[v, u] < middle - least:
                    darker += 1
        out[k] = max(lighter, darker) >= 0.6 * count and count >= 10
    return out


def fit_blobs(picture: NDArray[np.uint8], start: Array, margin_px: float, noise: float, max_iterations: int) -> Array:
    """Fits every row of ``start`` (n, 10) in ``picture`` (h, w); returns (n, N_RESULTS).

    ``margin_px``: how far around the outline pixels take part; ``noise``: the least residual sigma, grey values.
    """
    return _fit_blobs(picture, np.ascontiguousarray(start, float), margin_px, noise, max_iterations, PROFILE)


def start_parameters(centres: Array, radii: Array, background: Array, contrast: Array, blur: float = 0.8) -> Array:
    """Rows (n, 10) to start ``fit_blobs`` from circles: ``centres`` (n, 2), ``radii`` (n,) or half axes (n, 2), px."""
    start = np.zeros((len(centres), N_PARAMETERS))
    axes = np.broadcast_to(radii[:, None], (len(centres), 2)) if radii.ndim == 1 else radii
    start[:, :2] = centres
    start[:, 2], start[:, 4] = 1 / axes[:, 0], 1 / axes[:, 1]
    start[:, 5] = blur
    start[:, 6], start[:, 9] = background, contrast
    return start
