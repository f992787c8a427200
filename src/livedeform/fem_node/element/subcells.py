"""Integrate a factor that jumps within elements: more finely than by the points at which strains are taken.

A tetrahedron of 14 mm has four of these. A layer of 5 mm holds none, one, two or three of them, by how the element
lies, and seems up to a fifth thicker than it is. So the factor is taken at the middles of many equal parts of each
element; the points get the values of the linear function of place that is nearest to those (least squares). The rule of
four points then has the factor's integral right, and that of the factor times place: what stretches and bends.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np

from livedeform.common.types import Array

PART = 0.004  # m, edge of a part: a few times the ramp over which factors jump (`fem_node.physics.fields.BLUR`)
MOST_SPLITS = 2  # of an element into eight: 64 parts

# an octahedron's four parts round its diagonal 0-5, as mid-edges in `_split`'s order
_ROUND = (1, 2, 4, 3)


def splits(size: float) -> int:
    """Return how often elements with edges of ``size`` m are split into eight."""
    return int(np.clip(np.ceil(np.log2(size / PART)), 1, MOST_SPLITS))


@lru_cache(maxsize=4)
def middles(times: int) -> Array:
    """Return the middles (8^times, 4), in barycentric coordinates, of a tetrahedron's parts of equal volume."""
    parts = np.eye(4)[None]
    for _ in range(times):
        parts = np.concatenate([_split(part) for part in parts])
    return np.asarray(parts.mean(axis=1))


def _split(corners: Array) -> Array:
    """Split a tetrahedron (4, d) into eight (8, 4, d): one at each corner, and the octahedron between in four."""
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    mid = np.array([0.5 * (corners[i] + corners[j]) for i, j in pairs])
    at_corners = [np.concatenate([corners[[i]], mid[[k for k, p in enumerate(pairs) if i in p]]]) for i in range(4)]
    inside = [mid[[0, 5, a, b]] for a, b in pairwise((*_ROUND, _ROUND[0]))]
    return np.array([*at_corners, *inside])


@lru_cache(maxsize=16)
def _weights(points: bytes, times: int) -> Array:
    at, parts = np.frombuffer(points).reshape(-1, 4), middles(times)
    if len(at) == 1:
        return np.full((1, len(parts)), 1.0 / len(parts))
    return np.asarray(at @ np.linalg.solve(parts.T @ parts, parts.T))


def averaged(factor: Array, points: Array, weights: Array) -> Array:
    """Return the factor (e, q) at the ``points`` (q, 4), in barycentric coordinates, with ``weights`` (q,) that add up
    to one, by its values ``factor`` (e, s) at the `middles`.

    A strong jump asks for less than the least of these somewhere: then that is taken, and the others are less by as
    much, so that the integral stays.
    """
    times = round(np.log2(factor.shape[1]) / 3)
    least = factor.min(axis=1, keepdims=True)
    over = np.maximum(factor @ _weights(np.ascontiguousarray(points).tobytes(), times).T - least, 0.0)
    whole, right = over @ weights, factor.mean(axis=1) - least[:, 0]
    share = np.divide(right, whole, out=np.ones_like(whole), where=whole > 0.0)
    return np.asarray(least + over * share[:, None])
