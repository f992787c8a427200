"""The picture of a round marker: a blurred ellipse on a sloping background, and its derivatives.

    I(p) = b + l + (c + l c / b) f,   l = g . (p - p0),   f = erfc(d / (sqrt(2) s)) / 2,
    d = (|M (p - c0)| - 1) / |grad|M (p - c0)||

d is the first-order (Sampson) distance to the ellipse |M (p - c0)| = 1 with M symmetric, s the blur, c the contrast
(negative: darker than around). l is the slope of the light, which falls on the ink as on the ground: ink of a quarter
of the ground's grey shows a quarter of it. (With the same slope on both a disc on a curved body is measured 0.02 px
off.) A reflexion's slope is the same on both, so that the last step frees the slope on the ink: m . (p - p0) f beside
the above, with a prior for m of zero within ``FREE_SLOPE`` of the difference.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import erfc

from livedeform.common.compiled import njit

N_PARAMETERS = 10
SQRT2 = math.sqrt(2.0)
INV_SQRT_2PI = 1.0 / math.sqrt(2.0 * math.pi)
N_SECTORS = 16
TAN_1 = math.tan(2.0 * math.pi / N_SECTORS)
# The rim's profile and its derivative at z = distance / blur, tabulated: interpolation errs by less than 1e-6.
Z_MOST, Z_STEP = 3.8, 0.004  # beyond, the rim's part is below 1e-4 of the contrast
_Z = np.arange(-Z_MOST - Z_STEP, Z_MOST + 3 * Z_STEP, Z_STEP)
PROFILE = np.ascontiguousarray(np.stack([0.5 * erfc(_Z / SQRT2), INV_SQRT_2PI * np.exp(-0.5 * _Z**2)], axis=1))
DERIVATIVES = 9  # rows of the room for a blob's pixels: place (2), grey, distance, profile, its derivative, residual,
N_WORK = DERIVATIVES + 14  # weight, a weighted derivative; the derivatives


@njit(cache=True, fastmath=True, error_model="numpy")
def sector(ex, ey):
    """Return which of the 16 sectors round the middle, from the negative x axis on, a place in units of the half axes
    lies in."""
    x, y = abs(ex), abs(ey)
    k = int(y > TAN_1 * x) + int(y > x) + int(x < TAN_1 * y)  # from the x axis on
    if ey < 0.0:
        return k if ex < 0.0 else 7 - k
    return 15 - k if ex < 0.0 else 8 + k


@njit(cache=True, fastmath=True, error_model="numpy")
def rim(m11, m12, m22, dx, dy):
    """Return, of a place (dx, dy) px from the middle, M (dx, dy), its length q, the gradient of q, and that one's
    length."""
    qx = m11 * dx + m12 * dy
    qy = m12 * dx + m22 * dy
    q = math.sqrt(qx * qx + qy * qy) + 1e-12
    gx = (m11 * qx + m12 * qy) / q
    gy = (m12 * qx + m22 * qy) / q
    return qx, qy, q, gx, gy, math.sqrt(gx * gx + gy * gy) + 1e-12


@njit(cache=True, fastmath=True, error_model="numpy")
def window(picture, p, reach):
    """Return first and last column and row (exclusive) of what lies within ``reach`` px of the outline of ``p``."""
    rows, cols = picture.shape
    det = p[2] * p[4] - p[3] * p[3]
    # half axes of the bounding box of |M d| = 1 are the row norms of M^-1
    half_x = int(math.sqrt(p[4] * p[4] + p[3] * p[3]) / det + reach + 1.0)
    half_y = int(math.sqrt(p[2] * p[2] + p[3] * p[3]) / det + reach + 1.0)
    x, y = int(np.rint(p[0])), int(np.rint(p[1]))
    return max(0, x - half_x), min(cols, x + half_x + 1), max(0, y - half_y), min(rows, y + half_y + 1)


@njit(cache=True, fastmath=True, error_model="numpy")
def choose_pixels(picture, p, margin, hidden, work):
    """Write the pixels within ``margin`` px of the outline of ``p`` into ``work``: their places relative to its middle
    and their greys, without those in ``hidden`` (N_SECTORS,) sectors. Returns their number and ``work`` with room for
    them.

    They stay the same from step to step, so that the steps' costs can be compared.
    """
    left, right, top, bottom = window(picture, p, margin)
    if work.shape[1] < (right - left) * (bottom - top):
        work = np.empty((N_WORK, (right - left) * (bottom - top)))
    some_hidden = hidden.any()
    ax, ay, grey = work[0], work[1], work[2]
    n = 0
    for v in range(top, bottom):
        for u in range(left, right):
            qx, qy, q, _, _, norm = rim(p[2], p[3], p[4], u - p[0], v - p[1])
            if q - 1.0 > margin * norm or (some_hidden and hidden[sector(qx, qy)]):
                continue
            ax[n] = u - p[0]
            ay[n] = v - p[1]
            grey[n] = picture[v, u]
            n += 1
    return n, work


@njit(cache=True, fastmath=True, error_model="numpy")
def profile(n, p, middle, table, work):
    """Write the rim's profile f, its derivative and the distance d of the ``n`` pixels into ``work``."""
    ax, ay, distance, inside, density = work[0], work[1], work[3], work[4], work[5]
    m11, m12, m22, s = p[2], p[3], p[4], p[5]
    shift_x, shift_y = middle[0] - p[0], middle[1] - p[1]
    for k in range(n):
        _, _, q, _, _, norm = rim(m11, m12, m22, ax[k] + shift_x, ay[k] + shift_y)
        distance[k] = (q - 1.0) / norm
    for k in range(n):
        place = (min(max(distance[k] / s, -Z_MOST), Z_MOST) + Z_MOST) / Z_STEP + 1.0
        i = int(place)
        f = place - i
        inside[k] = table[i, 0] + f * (table[i + 1, 0] - table[i, 0])
        density[k] = (table[i, 1] + f * (table[i + 1, 1] - table[i, 1])) / s


@njit(cache=True, fastmath=True, error_model="numpy")
def residuals(n, p, scale, work):
    """Write residuals and weights of the ``n`` pixels into ``work``; return cost, sum of the weights, weights and
    number of the pixels on the rim. A ``scale`` of 0 weighs all alike."""
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


@njit(cache=True, fastmath=True, error_model="numpy")
def derivatives(n, p, middle, work):
    """Write the derivatives of the model with respect to the ten parameters at the ``n`` pixels into the rows of
    ``work`` from ``DERIVATIVES`` on."""
    ax, ay, distance, inside, density = work[0], work[1], work[3], work[4], work[5]
    m11, m12, m22, s = p[2], p[3], p[4], p[5]
    shift_x, shift_y = middle[0] - p[0], middle[1] - p[1]
    ink = min(max(p[9] / max(p[6], 5.0), -1.0), 3.0)
    gx, gy, c = p[7], p[8], p[9]
    J = work[DERIVATIVES:]
    for k in range(n):
        dx, dy = ax[k] + shift_x, ay[k] + shift_y
        qx, qy, q, hx, hy, norm = rim(m11, m12, m22, dx, dy)
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


@njit(cache=True, fastmath=True, error_model="numpy")
def more_derivatives(n, p, middle, work):
    """Write the derivatives with respect to the slope on the ink (2) and the outline's third harmonic (2)."""
    ax, ay, inside, density = work[0], work[1], work[4], work[5]
    shift_x, shift_y = middle[0] - p[0], middle[1] - p[1]
    ink = min(max(p[9] / max(p[6], 5.0), -1.0), 3.0)
    J = work[DERIVATIVES:]
    for k in range(n):
        J[10, k] = ax[k] * inside[k]
        J[11, k] = ay[k] * inside[k]
        qx, qy, q, _, _, _ = rim(p[2], p[3], p[4], ax[k] + shift_x, ay[k] + shift_y)
        cosine, sine = qx / q, qy / q
        steep = (p[9] + ink * (p[7] * ax[k] + p[8] * ay[k])) * density[k]
        J[12, k] = steep * cosine * (4.0 * cosine * cosine - 3.0)
        J[13, k] = steep * sine * (3.0 - 4.0 * sine * sine)


@njit(cache=True, fastmath=True, error_model="numpy")
def normal_equations(n, work, H, g):
    """Compute H = J^T W J and g = J^T W r of as many parameters as ``g`` has room for."""
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
