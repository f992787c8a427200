"""Triangles that stand for a smooth surface: normals at their corners, and how far the surface bulges out of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array

CREASE = 0.6  # rad between neighbouring triangles, beyond which a surface has an edge there


def corner_normals(points: Array, triangles: NDArray[np.int64]) -> Array:
    """(k, 3, 3) unit normals at the corners of ``triangles`` (k, 3) of ``points`` (m, 3): the mean of the adjacent
    triangles' normals, of those that lie on the same side of all edges (`CREASE`), with the weights that are right for
    any triangles of a ball: sin / (|e| |f|) of the edges e, f that meet there (Max 1999)."""
    corners = points[triangles]
    e, f = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    cross = np.cross(e, f)
    weighted = cross / np.maximum((e**2).sum(axis=2) * (f**2).sum(axis=2), 1e-60)[:, :, None]
    unit = cross[:, 0] / np.maximum(np.linalg.norm(cross[:, 0], axis=1), 1e-30)[:, None]
    own, other = _sharing(triangles)
    smooth = np.einsum("pi,pi->p", unit[own // 3], unit[other // 3]) > np.cos(CREASE)
    out = np.zeros((triangles.size, 3))
    np.add.at(out, own[smooth], weighted.reshape(-1, 3)[other[smooth]])
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1), 1e-30)[:, None]).reshape(-1, 3, 3)


def _sharing(triangles: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs (p,) of a corner's number 3 k + i and those of all corners at its vertex, its own included."""
    vertex = triangles.ravel()
    order = np.argsort(vertex, kind="stable")
    first = np.searchsorted(vertex[order], vertex)
    count = np.bincount(vertex)[vertex]
    own = np.repeat(np.arange(len(vertex)), count)
    nth = np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count)
    return own, order[np.repeat(first, count) + nth]


def bulge(corners: Array, normals: Array, barycentric: Array) -> Array:
    """(k, q, 3) m from flat triangles with ``corners`` (k, 3, 3) m to the smooth surface with ``normals`` (k, 3, 3)
    there, at ``barycentric`` (q, 3): nothing at the corners.

    An edge e between normals n, m bulges by e . (m - n) / 8 in its middle (a circle's e^2 / 8 R), the triangle in
    between as a quadratic (as the curved patches of Nagata 2005), along the interpolated normal.
    """
    along = np.einsum("qi,kid->kqd", barycentric, normals)
    along = along / np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-30)
    height = np.zeros(along.shape[:2])
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge = np.einsum("kd,kd->k", corners[:, j] - corners[:, i], normals[:, j] - normals[:, i]) / 8.0
        height += 4.0 * barycentric[:, i] * barycentric[:, j] * edge[:, None]
    return np.asarray(height[:, :, None] * along)
