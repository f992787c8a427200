"""Sectors of a disc that something else covers: the probe, a neighbour, the body's own silhouette.

A sector of the disc whose ground or ink is not what the fit says is covered by something else (the probe, a neighbour,
the body's own silhouette): it is left out, and the rest is fitted again. What is as light as the ground shows by the
rim alone: it is cut off along a chord. A smaller ellipse takes up the most of that, and leaves a rim that is neither an
ellipse nor egg-shaped, but is an ellipse without a few sectors beside each other.
"""

from __future__ import annotations

import math

import numpy as np

from livedeform.common.compiled import njit
from livedeform.stereo_node.detect.blob_model import N_SECTORS, profile, residuals, rim, sector, window
from livedeform.stereo_node.detect.small_linear import solve_spd

HIDDEN = 0.2  # of the contrast: a sector whose ground or ink is off by more is covered by something else
MOST_HIDDEN = 6  # sectors
CERTAIN, LEAST_CUT = 3.0, 0.06  # sigmas, px (rms): a rim that is off by less is as round as pictures show
CUT = 4.0  # times what the other sectors leave: 5 and more of discs that are cut, up to 2.8 of round, egg-shaped ones
MOST_CUT, LITTLE, ABOUT = 7, 1.5, 2.0  # sectors; times the least that any number of them leaves, sigmas
FAR = 6.0  # sigmas: what is left of a covered disc is none either
LEAST_SEEN = 8  # sectors, for an ellipse's five numbers


@njit(cache=True, fastmath=True, error_model="numpy")
def find_hidden(picture, p, hidden, noise, sums):
    """Add to ``hidden`` the sectors whose ground outside the rim or whose ink inside it is not as in the others;
    returns how many there are that were not hidden before. ``sums`` (4, N_SECTORS): room.

    The fit's own ground and slope do not count, since what covers a disc has pulled them.
    """
    reach = 2.5 + p[5]
    left, right, top, bottom = window(picture, p, reach)
    sums[:] = 0.0
    for v in range(top, bottom):
        for u in range(left, right):
            qx, qy, q, _, _, norm = rim(p[2], p[3], p[4], u - p[0], v - p[1])
            d = (q - 1.0) / norm
            if abs(d) < 0.8 + p[5] or d > reach or d < -3.0 - p[5]:
                continue
            k = sector(qx, qy)
            row = 0 if d > 0.0 else 2
            sums[row, k] += picture[v, u]
            sums[row + 1, k] += 1.0
    new = 0
    for row in (0, 2):
        new += _odd_sectors(sums[row], sums[row + 1], hidden, abs(p[9]), noise)
    return new


@njit(cache=True, fastmath=True, error_model="numpy")
def _odd_sectors(total, count, hidden, contrast, noise):
    """Add to ``hidden`` the sectors whose mean grey lies off a slope through the others'."""
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
    if not solve_spd(A, y, x):
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


@njit(cache=True, fastmath=True, error_model="numpy")
def find_cut(n, p, chosen, table, work, hidden, noise):
    """Add to ``hidden`` the fewest sectors beside each other without which the rim is an ellipse; returns how many
    there are that were not hidden before.

    0 where all of it is one, or an egg; all where a part was hidden and nothing makes the rest one. ``n`` pixels are in
    ``work``; ``noise`` in grey values.
    """
    off, weight = _rim_off(n, p, chosen, table, work)
    seen = 0
    least = 0.0
    for k in range(N_SECTORS):
        if hidden[k] or weight[k] <= 0.0:
            weight[k] = 0.0
        else:
            seen += 1
            least += noise * noise / weight[k]
            weight[k] = 1.0
    if seen < LEAST_SEEN + 1:
        return 0
    sigma, whole = math.sqrt(least / seen), _beside_ellipse(off, weight, 7)
    if whole < max(LEAST_CUT, CERTAIN * sigma):
        return 0
    left, first = np.empty(MOST_CUT), np.empty(MOST_CUT, np.int64)
    for width in range(MOST_CUT):
        left[width], first[width] = _without(off, weight, width + 1)
    enough = max(LITTLE * left.min(), ABOUT * sigma)
    for width in range(MOST_CUT):
        if left[width] <= enough and left[width] < whole / CUT:
            beside = 1 if seen == N_SECTORS else 0  # those at both ends may be covered in part
            return _hide(hidden, first[width] - beside, width + 1 + 2 * beside)
    if seen < N_SECTORS and whole > FAR * sigma:
        return _hide(hidden, 0, N_SECTORS)
    return 0


@njit(cache=True, fastmath=True, error_model="numpy")
def _without(off, weight, width):
    """Return how far (rms px) the rim is from an ellipse without the ``width`` sectors that spoil it most, and the
    first of these."""
    rest = np.empty(N_SECTORS)
    best, first = 1e9, 0
    for start in range(N_SECTORS):
        rest[:] = weight
        for k in range(start, start + width):
            rest[k % N_SECTORS] = 0.0
        if rest.sum() >= LEAST_SEEN:
            left = _beside_ellipse(off, rest, 5)
            if left < best:
                best, first = left, start
    return best, first


@njit(cache=True, fastmath=True, error_model="numpy")
def _hide(hidden, first, width):
    """Add ``width`` sectors from ``first`` on to ``hidden``; returns how many were not hidden before."""
    new = 0
    for k in range(first, first + width):
        new += 0 if hidden[k % N_SECTORS] else 1
        hidden[k % N_SECTORS] = True
    return new


@njit(cache=True, fastmath=True, error_model="numpy")
def _rim_off(n, p, chosen, table, work):
    """Return how far (N_SECTORS,) px the rim lies outside the fitted one by sector, and the sums of squares of what a
    pixel's grey changes by per px."""
    profile(n, p, chosen, table, work)
    residuals(n, p, 0.0, work)
    off, weight = np.zeros(N_SECTORS), np.zeros(N_SECTORS)
    shift_x, shift_y = chosen[0] - p[0], chosen[1] - p[1]
    ink = min(max(p[9] / max(p[6], 5.0), -1.0), 3.0)
    for i in range(n):
        qx, qy, _, _, _, _ = rim(p[2], p[3], p[4], work[0, i] + shift_x, work[1, i] + shift_y)
        steep = (p[9] + ink * (p[7] * work[0, i] + p[8] * work[1, i])) * work[5, i]
        k = sector(qx, qy)
        off[k] += steep * work[6, i]
        weight[k] += steep * steep
    for k in range(N_SECTORS):
        off[k] /= max(weight[k], 1e-12)
    return off, weight


@njit(cache=True, fastmath=True, error_model="numpy")
def _beside_ellipse(off, weight, size):
    """Return the rms (px) of ``off`` (N_SECTORS,) with ``weight`` 0 or 1 beside the nearest ellipse, of ``size`` 5
    numbers, or the nearest egg, of 7."""
    A, y, x, row = np.zeros((size, size)), np.zeros(size), np.zeros(size), np.ones(size)
    for solved in range(2):
        total = 0.0
        for k in range(N_SECTORS):
            angle = (k + 0.5) / N_SECTORS * 2.0 * math.pi - math.pi
            for i in range(1, size):
                turn = ((i + 1) // 2) * angle
                row[i] = math.cos(turn) if i % 2 == 1 else math.sin(turn)
            left = off[k]
            for i in range(size):
                left -= x[i] * row[i]
                for j in range(size):
                    A[i, j] += weight[k] * row[i] * row[j]
                y[i] += weight[k] * row[i] * off[k]
            total += weight[k] * left * left
        if solved == 0 and not solve_spd(A, y, x):
            return 1e9
    return math.sqrt(total / max(weight.sum() - size, 1.0))
