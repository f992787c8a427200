"""The nearest point of a triangle surface, in a tree of boxes, and the feature (face, edge, vertex) that it lies on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from livedeform.common.compiled import njit
from livedeform.common.errors import MeshError
from livedeform.common.types import Array

LEAF_SIZE = 4
STACK_SIZE = 128  # deeper than any balanced tree of 2**60 triangles needs


@dataclass(frozen=True)
class TriangleTree:
    """A balanced tree of axis-aligned boxes over triangles, and the pseudo-normals of every feature.

    ``corners`` (m, 3, 3) m in tree order; ``low``, ``high`` (k, 3) m of each box; ``child`` (k,) index of the first of
    two neighbouring children or -1; ``first``, ``last`` (k,) triangles of a leaf. ``normals`` (m, 7, 3): of the
    face, of edges 01, 12, 20 and of vertices 0, 1, 2.
    """

    corners: Array
    normals: Array
    low: Array
    high: Array
    child: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]

    @classmethod
    def build(cls, vertices: Array, triangles: NDArray[np.int64]) -> TriangleTree:
        """Build the tree of a closed surface; `MeshError` if it is not one."""
        return cls._of(vertices[triangles], pseudo_normals(vertices, triangles))

    @classmethod
    def without_normals(cls, corners: Array) -> TriangleTree:
        """Build the tree of any triangles ``corners`` (m, 3, 3) m, for distances alone: no inside, no normals."""
        return cls._of(corners, np.zeros((len(corners), 7, 3)))

    @classmethod
    def _of(cls, corners: Array, normals: Array) -> TriangleTree:
        centres = corners.mean(axis=1)
        order = np.arange(len(corners))
        low, high, child, first, last = [], [], [], [], []

        def add(start: int, stop: int) -> int:
            box = corners[order[start:stop]].reshape(-1, 3)
            low.append(box.min(axis=0))
            high.append(box.max(axis=0))
            child.append(-1)
            first.append(start)
            last.append(stop)
            return len(low) - 1

        pending = [add(0, len(corners))]
        while pending:
            node = pending.pop()
            start, stop = first[node], last[node]
            if stop - start <= LEAF_SIZE:
                continue
            axis = int(np.argmax(np.ptp(centres[order[start:stop]], axis=0)))
            order[start:stop] = order[start:stop][np.argsort(centres[order[start:stop], axis], kind="stable")]
            middle = (start + stop) // 2
            child[node] = add(start, middle)
            pending += [child[node], add(middle, stop)]
        return cls(
            np.ascontiguousarray(corners[order]),
            np.ascontiguousarray(normals[order]),
            np.array(low),
            np.array(high),
            np.array(child),
            np.array(first),
            np.array(last),
        )


def pseudo_normals(vertices: Array, triangles: NDArray[np.int64]) -> Array:
    """Unit normals (m, 7, 3) of each triangle's face, three edges and three vertices (angle-weighted)."""
    corners = vertices[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    if np.any(area <= 0):
        raise MeshError(
            f"{int(np.sum(area <= 0))} triangles have no area", where="probe.shape.mesh", remedy="remove them"
        )
    face = cross / area[:, None]
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, index, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    if np.any(count != 2):
        raise MeshError(
            f"{int(np.sum(count != 2))} edges do not have two triangles each",
            where="probe.shape.mesh",
            remedy="close the surface",
        )
    at_edge = np.zeros((len(unique), 3))
    np.add.at(at_edge, index.ravel(), np.repeat(face, 3, axis=0))
    at_vertex = np.zeros_like(vertices)
    for i in range(3):
        a = corners[:, (i + 1) % 3] - corners[:, i]
        b = corners[:, (i + 2) % 3] - corners[:, i]
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ni,ni->n", a, b))
        np.add.at(at_vertex, triangles[:, i], angle[:, None] * face)
    normals = np.concatenate([face[:, None], at_edge[index.reshape(-1, 3)], at_vertex[triangles]], axis=1)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-300))


def closest_features(tree: TriangleTree, points: Array) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Nearest surface point (n, 3), its pseudo-normal (n, 3), the edge's direction (n, 3; zero elsewhere) and its kind
    (n,): 0 face, 1 edge, 2 vertex."""
    place, normal, edge, kind = _closest(
        points, tree.corners, tree.normals, tree.low, tree.high, tree.child, tree.first, tree.last
    )
    return place, normal, edge, kind


@njit(cache=True)
def _box_distance2(p, low, high):
    total = 0.0
    for i in range(3):
        excess = max(low[i] - p[i], p[i] - high[i], 0.0)
        total += excess * excess
    return total


@njit(cache=True)
def dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@njit(cache=True)
def _less(u, v):
    return u[0] - v[0], u[1] - v[1], u[2] - v[2]


@njit(cache=True)
def _along(start, share, direction):
    return start[0] + share * direction[0], start[1] + share * direction[1], start[2] + share * direction[2]


@njit(cache=True)
def closest_on_triangle(p, a, b, c):
    """Nearest point of triangle abc, as numbers, and its feature: 0 face, 1-3 edges, 4-6 vertices (Ericson 2005,
    5.1.5)."""
    ab, ac, ap = _less(b, a), _less(c, a), _less(p, a)
    d1, d2 = dot(ab, ap), dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return (a[0], a[1], a[2]), 4
    bp = _less(p, b)
    d3, d4 = dot(ab, bp), dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return (b[0], b[1], b[2]), 5
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return _along(a, d1 / (d1 - d3), ab), 1
    cp = _less(p, c)
    d5, d6 = dot(ab, cp), dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return (c[0], c[1], c[2]), 6
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return _along(a, d2 / (d2 - d6), ac), 3
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        return _along(b, (d4 - d3) / ((d4 - d3) + (d5 - d6)), _less(c, b)), 2
    total = va + vb + vc
    return _along(_along(a, vb / total, ab), vc / total, ac), 0


@njit(cache=True)
def _closest(points, corners, normals, low, high, child, first, last):
    n = len(points)
    nearest = np.zeros((n, 3))
    normal = np.zeros((n, 3))
    along = np.zeros((n, 3))
    kind = np.zeros(n, np.int64)
    stack = np.zeros(STACK_SIZE, np.int64)
    for i in range(n):
        p = points[i]
        best = np.inf
        stack[0] = 0
        depth = 1
        while depth > 0:
            depth -= 1
            node = stack[depth]
            if _box_distance2(p, low[node], high[node]) >= best:
                continue
            if child[node] < 0:
                for t in range(first[node], last[node]):
                    q, feature = closest_on_triangle(p, corners[t, 0], corners[t, 1], corners[t, 2])
                    gap = _less(p, q)
                    distance2 = dot(gap, gap)
                    if distance2 < best:
                        best = distance2
                        nearest[i] = q
                        normal[i] = normals[t, feature]
                        kind[i] = 0 if feature == 0 else (1 if feature < 4 else 2)
                        along[i] = 0.0
                        if kind[i] == 1:
                            edge = corners[t, feature % 3] - corners[t, feature - 1]
                            along[i] = edge / np.sqrt(np.dot(edge, edge))
                continue
            left, right = child[node], child[node] + 1
            if _box_distance2(p, low[left], high[left]) < _box_distance2(p, low[right], high[right]):
                left, right = right, left
            stack[depth] = left
            stack[depth + 1] = right  # the nearer box is opened first
            depth += 2
    return nearest, normal, along, kind
