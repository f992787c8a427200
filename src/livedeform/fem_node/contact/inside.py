"""Decide whether points lie inside a closed surface: the winding number, the sum of the solid angles of its triangles.

It is 1 inside and 0 outside, whatever the surface's shape (Jacobson, Kavan & Sorkine-Hornung 2013); a triangle's solid
angle is that of van Oosterom & Strackee (1983).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from livedeform.common.compiled import njit
from livedeform.common.types import Array


def is_inside(points: Array, vertices: Array, triangles: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which of ``points`` (n, 3) lie inside the closed surface of ``triangles`` (k, 3), outward, on ``vertices``
    (m, 3)."""
    within = np.all((points >= vertices.min(axis=0)) & (points <= vertices.max(axis=0)), axis=1)
    turns = np.zeros(len(points))
    turns[within] = _winding(np.ascontiguousarray(points[within]), vertices, triangles)
    return turns > 0.5


@njit(cache=True)
def _winding(points, vertices, triangles):
    turns = np.zeros(len(points))
    v = np.empty((3, 3))
    length = np.empty(3)
    for p in range(len(points)):
        total = 0.0
        for t in range(len(triangles)):
            for c in range(3):
                square = 0.0
                for i in range(3):
                    v[c, i] = vertices[triangles[t, c], i] - points[p, i]
                    square += v[c, i] * v[c, i]
                length[c] = np.sqrt(square)
            volume = (
                v[0, 0] * (v[1, 1] * v[2, 2] - v[1, 2] * v[2, 1])
                - v[0, 1] * (v[1, 0] * v[2, 2] - v[1, 2] * v[2, 0])
                + v[0, 2] * (v[1, 0] * v[2, 1] - v[1, 1] * v[2, 0])
            )
            d01 = v[0, 0] * v[1, 0] + v[0, 1] * v[1, 1] + v[0, 2] * v[1, 2]
            d12 = v[1, 0] * v[2, 0] + v[1, 1] * v[2, 1] + v[1, 2] * v[2, 2]
            d20 = v[2, 0] * v[0, 0] + v[2, 1] * v[0, 1] + v[2, 2] * v[0, 2]
            below = length[0] * length[1] * length[2] + d01 * length[2] + d12 * length[0] + d20 * length[1]
            total += np.arctan2(volume, below)
        turns[p] = total / (2.0 * np.pi)
    return turns
