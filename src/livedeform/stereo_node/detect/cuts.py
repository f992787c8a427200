"""Cuts that show by the rim alone: what covers a part of a disc and is as light as the ground.

A smaller ellipse takes up the most of such a cut. What is left of the rim is compared by evidence (MacKay 1992, Neural
Computation 4:415): of a whole disc the rim is an ellipse, with a third harmonic as of an egg and with unevenness in
each sector; of a cut one it is that without some sectors beside each other, in which it may lie inside by as much as a
chord does. How uneven rims are is told by all discs of a picture together: a hand paints all dots alike.

A cut that is likelier than none is left out, and the rest fitted again. One that may be adds to the covariance of the
middle, by its probability and what it would displace.
"""

from __future__ import annotations

import math

import numpy as np

from livedeform.common.compiled import njit
from livedeform.stereo_node.detect.blob_model import N_SECTORS, profile, residuals, rim, sector
from livedeform.stereo_node.detect.occlusion import MOST_HIDDEN

# Tried on 96 generated pictures of discs of 2 to 12 px radius with rims uneven by 0 to 4 %, of which a third was cut
LEAST_DISCS, LEAST_SIGNAL = 8, 5.0  # that tell how uneven rims are; contrast over residual of each
EGG = 0.01  # of the radius: the third harmonic that any disc may have
WIDEST = 9  # sectors
LEAST_SEEN = 7  # sectors, for an ellipse's five numbers
ALIKE = 0.3  # weights of sectors that differ from their mean by less count as alike, which is faster
RARE = 7.0  # the logarithm of how much rarer than a whole disc one is that is cut at a given place
SURE = 5.0  # times likelier cut than not, to leave a disc out
UNTOLD = 6.0  # variances: a cut displaces the middle by more than rims tell to first order
UNSUSPICIOUS = 20.0  # chi-square of a rim that is no more uneven than the pixels' noise: 11 degrees of freedom
TINY = 2.25  # px: the radius below which pictures do not tell a chord from a tilt
SHORT = 3.5  # px: a smaller rim that was skewed does not tell the whole, whatever is left out
MOST_MOVED = 0.25  # of the radius: a middle that leaving out a cut moves by more is not known
SMALL = 2.5  # px: half axis of a disc whose middle is off by as much as that moved it; by its third power of others
UNLIKE = 0.08  # px, of a half axis of 1 px, by its square of others: what pictures of rims differ from the model by
_ANGLE = (np.arange(N_SECTORS) + 0.5) / N_SECTORS * 2.0 * math.pi - math.pi
HARMONICS = np.stack([np.ones(N_SECTORS)] + [f(k * _ANGLE) for k in (1, 2, 3) for f in (np.cos, np.sin)])
_TURN = np.arange(N_SECTORS) / N_SECTORS * 2.0 * math.pi
TURNS = np.ascontiguousarray(np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1))


@njit(cache=True, fastmath=True, error_model="numpy")
def _per_axis(p):
    """Return one over the smaller half axis of the ellipse ``p``, 1/px."""
    return 0.5 * (p[2] + p[4]) + math.hypot(0.5 * (p[2] - p[4]), p[3])


@njit(cache=True, fastmath=True, error_model="numpy")
def rim_off(n, p, chosen, table, work, noise, off, sigma):
    """Write how far the rim lies outside the ellipse ``p`` by sector into ``off`` (N_SECTORS,), px of a circle of the
    same area, and what a ``noise`` in grey values makes of it into ``sigma`` (N_SECTORS,).

    A translation is a first harmonic of it, however slanted the ellipse. ``n`` pixels are in ``work``.
    """
    profile(n, p, chosen, table, work)
    residuals(n, p, 0.0, work)
    weight = np.zeros(N_SECTORS)
    off[:] = 0.0
    shift_x, shift_y = chosen[0] - p[0], chosen[1] - p[1]
    radius = 1.0 / math.sqrt(p[2] * p[4] - p[3] * p[3])
    unlike = UNLIKE * _per_axis(p) ** 2
    ink = min(max(p[9] / max(p[6], 5.0), -1.0), 3.0)
    for i in range(n):
        qx, qy, _, _, _, norm = rim(p[2], p[3], p[4], work[0, i] + shift_x, work[1, i] + shift_y)
        steep = (p[9] + ink * (p[7] * work[0, i] + p[8] * work[1, i])) * work[5, i] / (norm * radius)
        k = sector(qx, qy)
        off[k] += steep * work[6, i]
        weight[k] += steep * steep
    for k in range(N_SECTORS):
        off[k] /= max(weight[k], 1e-12)
        sigma[k] = math.hypot(noise / math.sqrt(max(weight[k], 1e-12)), unlike)


@njit(cache=True, fastmath=True, error_model="numpy")
def unevenness(off, sigma, fits, hidden):
    """Return how uneven the rims are, of their radii: the median in a sector, and of the third harmonic (rms).

    ``off`` (n, N_SECTORS) px with noise ``sigma``, of the ``fits`` (n, N_RESULTS), and what of them is ``hidden``.
    Nothing where fewer than ``LEAST_DISCS`` of them show whole.
    """
    rest, third = np.empty(len(off)), np.empty(len(off))
    n = 0
    x = np.empty(7)
    for b in range(len(off)):
        if hidden[b].any() or not fits[b, 15] > 0.0 or abs(fits[b, 9]) < LEAST_SIGNAL * fits[b, 13]:
            continue
        per_area = fits[b, 2] * fits[b, 4] - fits[b, 3] * fits[b, 3]
        left = variance = 0.0
        for k in range(N_SECTORS):
            variance += sigma[b, k] * sigma[b, k] / N_SECTORS
        for i in range(7):
            x[i] = 0.0
            for k in range(N_SECTORS):
                x[i] += HARMONICS[i, k] * off[b, k] * (1.0 if i == 0 else 2.0) / N_SECTORS
        for k in range(N_SECTORS):
            r = off[b, k]
            for i in range(7):
                r -= x[i] * HARMONICS[i, k]
            left += r * r
        rest[n] = (left / (N_SECTORS - 7) - variance) * per_area
        third[n] = ((x[5] * x[5] + x[6] * x[6]) / 2.0 - variance * 2.0 / N_SECTORS) * per_area
        n += 1
    if n < LEAST_DISCS:
        return 0.0, 0.0
    return math.sqrt(max(np.median(rest[:n]), 0.0)), math.sqrt(max(np.median(third[:n]) / math.log(2.0), 0.0))


@njit(cache=True, fastmath=True, error_model="numpy")
def find_cut(off, sigma, radius, uneven, third, hidden, extra):
    """Add to ``hidden`` the sectors that are most likely cut, if the disc is; returns how many are new.

    ``off`` (N_SECTORS,) px with noise ``sigma`` and the rims' unevenness ``uneven`` and ``third``, of the ``radius``
    px. Into ``extra`` (3,) px2 goes what is not known of the middle, xx, xy, yy, in the frame in which the disc is a
    circle: by unevenness where not all is seen, and by cuts that may be.
    """
    seen, rest, rolled = np.empty(N_SECTORS), np.empty(N_SECTORS), np.empty(N_SECTORS)
    n_seen, weights = 0, 0.0
    for k in range(N_SECTORS):
        seen[k] = 0.0 if hidden[k] else 1.0 / (sigma[k] * sigma[k] + (uneven * radius) ** 2)
        n_seen += 0 if hidden[k] else 1
        weights += seen[k]
    extra[:] = 0.0
    if n_seen < LEAST_SEEN + 1:
        return 0
    variance, even = n_seen / weights, True
    for k in range(N_SECTORS):
        seen[k] *= variance
        even = even and abs(seen[k] - 1.0) < ALIKE
    if even:
        seen[:] = 1.0
    ridge = variance / ((third * third + EGG * EGG) * radius * radius)
    x, x0, H = np.empty(7), np.empty(7), np.empty((7, 7))
    log_whole = _factor(seen, ridge, H)
    whole = _solve(off, seen, H, x0) / variance
    if n_seen < N_SECTORS:
        _add_uneven(H, (uneven * radius) ** 2, x, extra)
    if radius < TINY or (whole < UNSUSPICIOUS and (uneven + third) * radius < math.sqrt(variance)):
        return 0
    total, best, first, width, log_part = 0.0, -1e9, 0, 0, 0.0
    xx = xy = yy = 0.0
    for wide in range(1, WIDEST + 1):
        chord = radius * (1.0 - math.cos(wide * math.pi / N_SECTORS))
        chord2 = chord * chord / (2.0 * math.pi * variance)
        for start in range(N_SECTORS):  # turned so that the window is the first ``wide`` sectors
            free, whole_window = 1.0, True
            for k in range(N_SECTORS):
                at = (k + start) % N_SECTORS
                rolled[k] = off[at]
                rest[k] = seen[at] if k >= wide else 0.0
                if k < wide:
                    free *= 1.0 + chord2 * seen[at]
                    whole_window = whole_window and seen[at] > 0.0
            if not whole_window or n_seen - wide < LEAST_SEEN:
                continue
            if start == 0 or not even:
                log_part = _factor(rest, ridge, H)
            part = _solve(rolled, rest, H, x) / variance
            outside = 0.0  # what covers as light as the ground lays no rim outside the disc's
            for k in range(wide):
                r = rolled[k]
                for i in range(7):
                    r -= x[i] * HARMONICS[i, k]
                outside += seen[(k + start) % N_SECTORS] * max(r, 0.0) ** 2
            gain = 0.5 * (whole - part - outside / variance + log_whole - log_part - math.log(free)) - RARE
            likely = math.exp(min(gain, 300.0))
            total += likely
            c, s = TURNS[start, 0], TURNS[start, 1]
            dx, dy = c * x[1] - s * x[2] - x0[1], s * x[1] + c * x[2] - x0[2]
            xx += likely * dx * dx
            xy += likely * dx * dy
            yy += likely * dy * dy
            if gain > best:
                best, first, width = gain, start, wide
    beside = 1 if n_seen == N_SECTORS else 0  # those at both ends may be covered in part
    lost = width + 2 * beside + N_SECTORS - n_seen > MOST_HIDDEN
    if total > (SURE if lost and n_seen == N_SECTORS else 1.0):
        return _hide(hidden, first - beside, width + 2 * beside)
    extra[0] += UNTOLD * xx / (1.0 + total)
    extra[1] += UNTOLD * xy / (1.0 + total)
    extra[2] += UNTOLD * yy / (1.0 + total)
    return 0


@njit(cache=True, fastmath=True, error_model="numpy")
def _factor(seen, ridge, H):
    """Write the normal equations of an ellipse with a third harmonic, of the ``seen`` (N_SECTORS,) sectors, as U^T D U
    into ``H`` (7, 7); returns the logarithm of their determinant. ``ridge``: the third harmonic's prior."""
    for i in range(7):
        for j in range(i, 7):
            total = ridge if i == j and i > 4 else 0.0
            for k in range(N_SECTORS):
                total += seen[k] * HARMONICS[i, k] * HARMONICS[j, k]
            H[i, j] = total
    logarithm = 0.0
    for j in range(7):
        pivot = max(H[j, j], 1e-9)
        logarithm += math.log(pivot)
        for i in range(j + 1, 7):
            share = H[j, i] / pivot
            for k in range(i, 7):
                H[i, k] -= share * H[j, k]
        for i in range(j + 1, 7):
            H[j, i] /= pivot
        H[j, j] = 1.0 / pivot
    return logarithm


@njit(cache=True, fastmath=True, error_model="numpy")
def _solve(off, seen, H, x):
    """Fit ``x`` (7,) to the ``seen`` sectors of ``off`` by the factors ``H``; returns the sum of squares that is left,
    the third harmonic's prior included."""
    total = 0.0
    for k in range(N_SECTORS):
        total += seen[k] * off[k] * off[k]
    for i in range(7):
        right = 0.0
        for k in range(N_SECTORS):
            right += seen[k] * HARMONICS[i, k] * off[k]
        x[i] = right
    for j in range(7):
        total -= x[j] * x[j] * H[j, j]
        for i in range(j + 1, 7):
            x[i] -= H[j, i] * x[j]
    _back(H, x)
    return max(total, 0.0)


@njit(cache=True, fastmath=True, error_model="numpy")
def _back(H, x):
    """Solve D U x = x by the factors ``H``."""
    for j in range(6, -1, -1):
        x[j] *= H[j, j]
        for k in range(j + 1, 7):
            x[j] -= H[j, k] * x[k]


@njit(cache=True, fastmath=True, error_model="numpy")
def _add_uneven(H, variance, x, extra):
    """Add to ``extra`` (3,) px2 what unevenness of ``variance`` px2 does to the middle, by the factors ``H``, more
    than where all is seen. ``x`` (7,): room."""
    for row in (1, 2):
        x[:] = 0.0
        x[row] = 1.0
        for j in range(7):
            for i in range(j + 1, 7):
                x[i] -= H[j, i] * x[j]
        _back(H, x)
        extra[row] += variance * (x[2] - (0.0 if row == 1 else 2.0 / N_SECTORS))
        if row == 1:
            extra[0] += variance * (x[1] - 2.0 / N_SECTORS)


@njit(cache=True, fastmath=True, error_model="numpy")
def add_untold(before, p, extra, out):
    """Add to the covariance in the row ``out`` of a fit ``p`` what is not known of its middle.

    That is ``extra`` (3,) px2 of `find_cut`, and a share of how far leaving out a cut has moved it from the fit
    ``before``; one that has moved far is said to be hidden.
    """
    det = p[2] * p[4] - p[3] * p[3]
    radius = 1.0 / math.sqrt(det)
    a, b, c = p[4] / (det * radius), -p[3] / (det * radius), p[2] / (det * radius)
    x, y = p[0] - before[0], p[1] - before[1]
    moved2 = x * x + y * y
    if moved2 > (MOST_MOVED * radius) ** 2:
        out[14] = 0.0
    # a cut hides ink: where the disc is smaller without it, something else was left out
    grown = det <= before[2] * before[4] - before[3] * before[3]
    share = min((SMALL * _per_axis(p)) ** 6, 1.0) if grown else 1.0
    across = 0.25  # of the variance along
    out[10] += share * ((1.0 - across) * x * x + across * moved2)
    out[11] += share * (1.0 - across) * x * y
    out[12] += share * ((1.0 - across) * y * y + across * moved2)
    out[10] += a * a * extra[0] + 2.0 * a * b * extra[1] + b * b * extra[2]
    out[11] += a * b * extra[0] + (a * c + b * b) * extra[1] + b * c * extra[2]
    out[12] += b * b * extra[0] + 2.0 * b * c * extra[1] + c * c * extra[2]


@njit(cache=True, fastmath=True, error_model="numpy")
def _hide(hidden, first, width):
    """Add ``width`` sectors from ``first`` on to ``hidden``; returns how many were not hidden before."""
    new = 0
    for k in range(first, first + width):
        new += 0 if hidden[k % N_SECTORS] else 1
        hidden[k % N_SECTORS] = True
    return new
