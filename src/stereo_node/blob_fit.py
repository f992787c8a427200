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

from livedeform_common.types import Array

N_PARAMETERS = 10
N_RESULTS = N_PARAMETERS + 8
"""Columns of a fit: x, y, m11, m12, m22, blur, background, gx, gy, contrast, var_x, cov_xy, var_y, residual sigma,
share of the rim that was seen, ok (1) or the reason why not (0 no convergence, -1 left its window), number of
pixels, skewness px."""
SQRT2 = math.sqrt(2.0)
INV_SQRT_2PI = 1.0 / math.sqrt(2.0 * math.pi)


FREE_SLOPE = 0.5  # share of the slope's part that the ink takes away which may not be so
N_SECTORS = 16
HIDDEN = 0.2  # of the contrast: a sector whose ground or ink is off by more is covered by something else
MOST_HIDDEN = 6  # sectors
SKEW_NOISE = 6.0  # variances: noise alone has one (two degrees of freedom), and more than this once in 400 times
LEAST_SLOPE = 2e-4  # of the contrast per pixel: the same where there is no slope

# The rim's profile and its derivative at z = distance / blur, tabulated: interpolation errs by less than 1e-6.
Z_MOST, Z_STEP = 3.8, 0.004  # beyond, the rim's part is below 1e-4 of the contrast
_Z = np.arange(-Z_MOST - Z_STEP, Z_MOST + 3 * Z_STEP, Z_STEP)
PROFILE = np.ascontiguousarray(np.stack([0.5 * erfc(_Z / SQRT2), INV_SQRT_2PI * np.exp(-0.5 * _Z**2)], axis=1))


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _sector(ex, ey):
    """Which of the ``N_SECTORS`` round the middle a place in units of the half axes lies in."""
    return int((math.atan2(ey, ex) + math.pi) / (2.0 * math.pi) * N_SECTORS) % N_SECTORS


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _accumulate(picture, x0, y0, half_x, half_y, p, margin, mask_p, hidden, scale, table, J, wr, ww, H, g):
    """Normal equations of the pixels around the blob; returns cost, weight sum, rim weight, rim count, pixel count.

    ``J`` (14, n), ``wr`` (n,), ``ww`` (n,) are room for n pixels: derivatives, weighted residuals and weights. As many
    parameters as ``g`` has room for take part. Pixels in ``hidden`` (N_SECTORS,) sectors do not, if there are any.
    """
    rows, cols = picture.shape
    cost = 0.0
    weight_sum = 0.0
    rim_weight = 0.0
    rim_count = 0.0
    n = 0
    s = p[5]
    some_hidden = hidden.any()
    ink = min(max(p[9] / max(p[6], 5.0), -1.0), 3.0)
    for v in range(max(0, y0 - half_y), min(rows, y0 + half_y + 1)):
        for u in range(max(0, x0 - half_x), min(cols, x0 + half_x + 1)):
            # the pixels that take part are fixed by the start, so that the cost is comparable between steps
            ax = u - mask_p[0]
            ay = v - mask_p[1]
            ex = mask_p[2] * ax + mask_p[3] * ay
            ey = mask_p[3] * ax + mask_p[4] * ay
            length = math.sqrt(ex * ex + ey * ey) + 1e-12
            if length > 1.0:
                fx = (mask_p[2] * ex + mask_p[3] * ey) / length
                fy = (mask_p[3] * ex + mask_p[4] * ey) / length
                if (length - 1.0) > margin * math.sqrt(fx * fx + fy * fy):
                    continue
            if some_hidden and hidden[_sector(ex, ey)]:
                continue
            dx = u - p[0]
            dy = v - p[1]
            qx = p[2] * dx + p[3] * dy
            qy = p[3] * dx + p[4] * dy
            q = math.sqrt(qx * qx + qy * qy) + 1e-12
            gx = (p[2] * qx + p[3] * qy) / q
            gy = (p[3] * qx + p[4] * qy) / q
            norm = math.sqrt(gx * gx + gy * gy) + 1e-12
            d = (q - 1.0) / norm
            z = d / s
            if z > Z_MOST:
                inside = 0.0
                density = 0.0
            elif z < -Z_MOST:
                inside = 1.0
                density = 0.0
            else:
                place = (z + Z_MOST) / Z_STEP + 1.0
                k = int(place)
                f = place - k
                inside = table[k, 0] + f * (table[k + 1, 0] - table[k, 0])
                density = (table[k, 1] + f * (table[k + 1, 1] - table[k, 1])) / s
            light = p[7] * ax + p[8] * ay
            contrast = p[9] + ink * light
            share = 1.0 + ink * inside
            r = picture[v, u] - (p[6] + light + contrast * inside)
            w = 1.0
            if scale > 0.0:
                a = abs(r) / scale
                if a > 1.0:
                    w = 1.0 / (a * a)
            slope = -contrast * density / (norm * q)  # dI/dq / q
            J[0, n] = -slope * gx * q
            J[1, n] = -slope * gy * q
            J[2, n] = slope * qx * dx
            J[3, n] = slope * (qx * dy + qy * dx)
            J[4, n] = slope * qy * dy
            J[5, n] = contrast * density * z
            J[6, n] = 1.0
            J[7, n] = ax * share
            J[8, n] = ay * share
            J[9, n] = inside
            J[10, n] = ax * inside
            J[11, n] = ay * inside
            cosine = qx / q
            sine = qy / q
            J[12, n] = contrast * density * cosine * (4.0 * cosine * cosine - 3.0)
            J[13, n] = contrast * density * sine * (3.0 - 4.0 * sine * sine)
            wr[n] = w * r
            ww[n] = w
            n += 1
            cost += w * r * r
            weight_sum += w
            if abs(d) < 1.5:
                rim_weight += w
                rim_count += 1.0
    for i in range(len(g)):
        total = 0.0
        for k in range(n):
            total += J[i, k] * wr[k]
        g[i] = total
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += J[i, k] * J[j, k] * ww[k]
            H[i, j] = total
            H[j, i] = total
    return cost, weight_sum, rim_weight, rim_count, n


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _find_hidden(picture, p, hidden, noise, sums):
    """Adds to ``hidden`` the sectors whose ground outside the rim or whose ink inside it is not as in the others;
    returns how many there are that were not hidden before. ``sums`` (4, N_SECTORS): room.

    The fit's own ground and slope do not count, since what covers a disc has pulled them.
    """
    rows, cols = picture.shape
    det = p[2] * p[4] - p[3] * p[3]
    reach = 2.5 + p[5]
    half_x = int(math.sqrt(p[4] * p[4] + p[3] * p[3]) / det + reach + 1.0)
    half_y = int(math.sqrt(p[2] * p[2] + p[3] * p[3]) / det + reach + 1.0)
    x0 = int(np.rint(p[0]))
    y0 = int(np.rint(p[1]))
    sums[:] = 0.0
    for v in range(max(0, y0 - half_y), min(rows, y0 + half_y + 1)):
        for u in range(max(0, x0 - half_x), min(cols, x0 + half_x + 1)):
            dx = u - p[0]
            dy = v - p[1]
            qx = p[2] * dx + p[3] * dy
            qy = p[3] * dx + p[4] * dy
            q = math.sqrt(qx * qx + qy * qy) + 1e-12
            gx = (p[2] * qx + p[3] * qy) / q
            gy = (p[3] * qx + p[4] * qy) / q
            d = (q - 1.0) / (math.sqrt(gx * gx + gy * gy) + 1e-12)
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
    if not _cholesky_solve(A, y, x):
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


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _cholesky_solve(A, b, x):
    """Solves A x = b in place for a symmetric positive definite A; False if it is not."""
    n = b.size
    for j in range(n):
        d = A[j, j]
        for k in range(j):
            d -= A[j, k] * A[j, k]
        if not d > 1e-14:
            return False
        d = math.sqrt(d)
        A[j, j] = d
        for i in range(j + 1, n):
            value = A[i, j]
            for k in range(j):
                value -= A[i, k] * A[j, k]
            A[i, j] = value / d
    for i in range(n):
        value = b[i]
        for k in range(i):
            value -= A[i, k] * x[k]
        x[i] = value / A[i, i]
    for i in range(n - 1, -1, -1):
        value = x[i]
        for k in range(i + 1, n):
            value -= A[k, i] * x[k]
        x[i] = value / A[i, i]
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
def _fit_blobs(picture, start, margin_px, noise_floor, max_iterations, table):
    n = start.shape[0]
    out = np.zeros((n, N_RESULTS))
    H = np.empty((10, 10))
    g = np.empty(10)
    H_new = np.empty((10, 10))
    g_new = np.empty(10)
    A = np.empty((10, 10))
    step = np.empty(10)
    unit = np.empty(12)
    H_free = np.empty((14, 14))
    g_free = np.empty(14)
    A_free = np.empty((12, 12))
    step_free = np.empty(12)
    hidden = np.zeros(N_SECTORS, np.bool_)
    sums = np.empty((4, N_SECTORS))
    room = 0
    J = np.empty((14, room))
    wr = np.empty(room)
    ww = np.empty(room)
    for b in range(n):
        p = start[b].copy()
        hidden[:] = False
        for _attempt in range(3):
            mask_p = p.copy()
            x0 = int(np.rint(p[0]))
            y0 = int(np.rint(p[1]))
            det = p[2] * p[4] - p[3] * p[3]
            # half axes of the bounding box of |M d| = 1 are the row norms of M^-1
            extent_x = math.sqrt(p[4] * p[4] + p[3] * p[3]) / det
            extent_y = math.sqrt(p[2] * p[2] + p[3] * p[3]) / det
            radius = math.sqrt(1.0 / det)
            margin = max(margin_px, 0.5 * radius)
            half_x = int(extent_x + margin + 1.0)
            half_y = int(extent_y + margin + 1.0)
            limit = max(2.0, 0.7 * radius)
            needed = (2 * half_x + 1) * (2 * half_y + 1)
            if needed > room:
                room = needed
                J = np.empty((14, room))
                wr = np.empty(room)
                ww = np.empty(room)
            scale = 0.0
            cost, weight, rim_w, rim_n, count = _accumulate(
                picture, x0, y0, half_x, half_y, p, margin, mask_p, hidden, scale, table, J, wr, ww, H, g
            )
            damping = 1e-3
            status = 0.0
            for iteration in range(max_iterations):
                if iteration == 2 or iteration == 5:  # weights only after the shape is roughly right
                    # the pixels that take part are chosen anew: the start's outline may be far too small for the blur
                    mask_p[2:5] = p[2:5]
                    det = p[2] * p[4] - p[3] * p[3]
                    margin = max(margin_px, 0.5 * math.sqrt(1.0 / det), 3.0 * p[5])
                    half_x = int(math.sqrt(p[4] * p[4] + p[3] * p[3]) / det + margin + 2.0)
                    half_y = int(math.sqrt(p[2] * p[2] + p[3] * p[3]) / det + margin + 2.0)
                    needed = (2 * half_x + 1) * (2 * half_y + 1)
                    if needed > room:
                        room = needed
                        J = np.empty((14, room))
                        wr = np.empty(room)
                        ww = np.empty(room)
                    scale = 4.0 * max(noise_floor, math.sqrt(cost / max(weight - 10.0, 1.0)))
                    cost, weight, rim_w, rim_n, count = _accumulate(
                        picture, x0, y0, half_x, half_y, p, margin, mask_p, hidden, scale, table, J, wr, ww, H, g
                    )
                accepted = False
                for _ in range(10):
                    for i in range(10):
                        for j in range(10):
                            A[i, j] = H[i, j]
                        A[i, i] = H[i, i] * (1.0 + damping) + 1e-12
                    if not _cholesky_solve(A, g, step):
                        damping = damping * 10.0 + 1e-3
                        continue
                    trial = p + step
                    if not _plausible(trial, start[b], limit):
                        damping = damping * 10.0 + 1e-3
                        continue
                    new_cost, new_weight, new_rim_w, new_rim_n, count = _accumulate(
                        picture,
                        x0,
                        y0,
                        half_x,
                        half_y,
                        trial,
                        margin,
                        mask_p,
                        hidden,
                        scale,
                        table,
                        J,
                        wr,
                        ww,
                        H_new,
                        g_new,
                    )
                    # reweighting changes the cost's meaning: compare mean squares
                    if new_cost / max(new_weight, 1.0) <= cost / max(weight, 1.0) * (1.0 + 1e-9):
                        accepted = True
                        break
                    damping = damping * 10.0 + 1e-3
                if not accepted:
                    status = 1.0 if iteration >= 2 else 0.0
                    break
                p = trial
                cost = new_cost
                weight = new_weight
                rim_w = new_rim_w
                rim_n = new_rim_n
                for i in range(10):
                    g[i] = g_new[i]
                    for j in range(10):
                        H[i, j] = H_new[i, j]
                damping = max(damping * 0.1, 1e-9)
                centre_stands = abs(step[0]) < 2e-3 and abs(step[1]) < 2e-3  # the next step would be far smaller
                rim_stands = abs(step[5]) < 0.03 * p[5] and abs(step[9]) < 0.01 * abs(p[9])
                if iteration >= 2 and centre_stands and rim_stands:
                    status = 1.0
                    break
            if status <= 0.0 or _find_hidden(picture, p, hidden, noise_floor, sums) == 0:
                break
            if hidden.sum() > MOST_HIDDEN:
                break
            p[7] = 0.0
            p[8] = 0.0
        cost, weight, rim_w, rim_n, count = _accumulate(
            picture, x0, y0, half_x, half_y, p, margin, mask_p, hidden, scale, table, J, wr, ww, H_free, g_free
        )
        sigma2 = max(cost / max(weight - 10.0, 1.0), noise_floor * noise_floor)
        taken = min(abs(p[9]) / max(p[6], 5.0), 1.0) * math.sqrt(p[7] * p[7] + p[8] * p[8])
        free = FREE_SLOPE * taken + LEAST_SLOPE * abs(p[9])
        H_free[10, 10] += sigma2 / (free * free)
        H_free[11, 11] += sigma2 / (free * free)
        for i in range(12):
            H_free[i, i] = H_free[i, i] * (1.0 + 1e-10) + 1e-12
        third = H_free[12, 12] + H_free[13, 13] + 1e-12
        skew2 = 4.0 * (g_free[12] * g_free[12] + g_free[13] * g_free[13]) / (third * third)
        out[b, 17] = math.sqrt(max(skew2 - SKEW_NOISE * sigma2 * 4.0 / third, 0.0))
        A_free[:] = H_free[:12, :12]
        if _cholesky_solve(A_free, g_free[:12], step_free) and abs(step_free[0]) < 0.3 and abs(step_free[1]) < 0.3:
            p[0] += step_free[0]
            p[1] += step_free[1]
        for i in range(10):
            out[b, i] = p[i]
        for k in range(2):
            unit[:] = 0.0
            unit[k] = 1.0
            A_free[:] = H_free[:12, :12]
            if _cholesky_solve(A_free, unit, step_free):
                if k == 0:
                    out[b, 10] = sigma2 * step_free[0]
                    out[b, 11] = sigma2 * step_free[1]
                else:
                    out[b, 12] = sigma2 * step_free[1]
            else:
                status = 0.0
        out[b, 13] = math.sqrt(sigma2)
        out[b, 14] = rim_w / max(rim_n, 1.0) * (1.0 - hidden.sum() / N_SECTORS)
        out[b, 15] = status
        out[b, 16] = count
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
