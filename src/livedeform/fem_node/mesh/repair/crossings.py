"""Triangles of a surface that cross others, found by a sweep whose memory does not grow with the pairs it looks at."""

from __future__ import annotations

import numpy as np

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.fem_node.mesh.tet_mesh import IntArray

AT_ONCE = 1 << 16  # pairs that are looked at together: some 50 MB
ROUND_OFF = 1e-9  # of the surface's size: closer than that, on neither side of a plane


def count_self_intersections(v: Array, t: IntArray) -> int:
    """Return how many triangles are pierced by an edge of a triangle that is no neighbour of theirs."""
    return len(np.unique(crossing_pairs(v, t)[:, 1]))


def crossing_pairs(v: Array, t: IntArray) -> IntArray:
    """Return pairs (p, 2) of triangles, sorted: an edge of the first pierces the second, and they share no corner.

    The boxes of the triangles are swept along the surface's longest axis, so that large triangles among small ones
    cost time alone, and those that have one another's plane between them are no pair.
    """
    corners = np.ascontiguousarray(v[t])
    low, high = corners.min(axis=1), corners.max(axis=1)
    size = np.ptp(corners.reshape(-1, 3), axis=0)
    order = np.argsort(low[:, size.argmax()], kind="stable")
    turned = np.roll(np.arange(3), -int(size.argmax()))  # the axis of the sweep comes first
    low, high = (np.ascontiguousarray(a[order][:, turned]) for a in (low, high))
    swept, numbers = corners[order], np.ascontiguousarray(t[order], np.int64)
    normals = np.cross(swept[:, 1] - swept[:, 0], swept[:, 2] - swept[:, 0])
    slack = ROUND_OFF * float(size.max()) * np.linalg.norm(normals, axis=1)
    pairs, found, i, j = np.empty((AT_ONCE, 2), np.int64), [np.empty((0, 2), np.int64)], 0, 1
    while i < len(t):
        n, i, j = _sweep(swept, numbers, low, high, normals, slack, i, j, pairs)
        near = order[np.concatenate([pairs[:n], pairs[:n, ::-1]])]
        pierced = np.zeros(len(near), bool)
        for k in range(3):
            pierced |= _pierces(corners[near[:, 0], k], corners[near[:, 0], (k + 1) % 3], corners[near[:, 1]])
        found.append(near[pierced])
    every = np.concatenate(found)
    return np.asarray(every[np.lexsort(every.T[::-1])], np.int64)


@njit(cache=True)
def _sweep(
    corners: Array, t: IntArray, low: Array, high: Array, normals: Array, slack: Array, i: int, j: int, pairs: IntArray
) -> tuple[int, int, int]:
    """Fill ``pairs`` (p, 2) with triangles (in the order of the sweep) that may cross, from the pair (i, j) on; return
    how many there are, and the pair to go on from: ``i`` is past the last triangle where all are found."""
    n = 0
    while i < len(t):
        while j < len(t) and low[j, 0] <= high[i, 0]:
            apart = low[j, 1] > high[i, 1] or low[i, 1] > high[j, 1] or low[j, 2] > high[i, 2] or low[i, 2] > high[j, 2]
            if not apart and not _touch(t[i], t[j]):
                apart = _beside(corners[j], corners[i, 0], normals[i], slack[i])
                if not apart and not _beside(corners[i], corners[j, 0], normals[j], slack[j]):
                    if n == len(pairs):
                        return n, i, j
                    pairs[n, 0], pairs[n, 1] = i, j
                    n += 1
            j += 1
        i += 1
        j = i + 1
    return n, i, j


@njit(cache=True)
def _touch(one: IntArray, other: IntArray) -> bool:
    """Tell whether two triangles share a corner."""
    for a in one:
        for b in other:
            if a == b:
                return True
    return False


@njit(cache=True)
def _beside(corners: Array, point: Array, normal: Array, slack: float) -> bool:
    """Tell whether a triangle's corners (3, 3) all lie on one side of a plane."""
    above = below = 0
    for corner in corners:
        height = 0.0
        for axis in range(3):
            height += (corner[axis] - point[axis]) * normal[axis]
        above += height > slack
        below += height < -slack
    return above == 3 or below == 3


def _pierces(start: Array, end: Array, corners: Array) -> Array:
    """Return whether each segment crosses its triangle (Moeller & Trumbore 1997)."""
    direction = end - start
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction, ac)
    determinant = (ab * p).sum(1)
    safe = np.where(np.abs(determinant) < 1e-300, 1.0, determinant)
    s = start - corners[:, 0]
    q = np.cross(s, ab)
    u, w, along = (s * p).sum(1) / safe, (direction * q).sum(1) / safe, (ac * q).sum(1) / safe
    inside = (u > 0) & (w > 0) & (u + w < 1) & (along > 0) & (along < 1)
    return np.asarray(inside & (np.abs(determinant) >= 1e-300))
