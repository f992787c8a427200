"""Sectors of a disc that something else covers: the probe, a neighbour, the body's own silhouette.

A sector of the disc whose ground or ink is not what the fit says is covered by something else (the probe, a neighbour,
the body's own silhouette): it is left out, and the rest is fitted again. What is as light as the ground shows by the
rim alone (`cuts`).
"""

from __future__ import annotations

import math

import numpy as np

from livedeform.common.compiled import njit
from livedeform.stereo_node.detect.blob_model import N_SECTORS, rim, sector, window
from livedeform.stereo_node.detect.small_linear import solve_spd

HIDDEN = 0.2  # of the contrast: a sector whose ground or ink is off by more is covered by something else
MOST_HIDDEN = 6  # sectors


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
