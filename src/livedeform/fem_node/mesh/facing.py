"""Find the parts of a surface that look at one another across a gap, as the walls of a cavity, a slit or a fold do:
where a body is pressed they may come to touch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.fem_node.mesh.triangle_distance import dot

ALONG = 1e-6  # cosine; a triangle that is seen that much from the side is not looked at
FLAT = 1e-9  # of the surface's size; what is less in front of a triangle lies in its plane
PRODUCTS = 1_000_000  # of triangles with vertices at once, which take up memory


def facing(vertices: Array, triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the rows (f,), sorted, of the ``triangles`` (k, 3), outward, of a closed surface (``vertices`` (n, 3) m)
    that look at another one, or are looked at, and of their neighbours; none of a body that is convex."""
    corners = np.ascontiguousarray(vertices[triangles])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    free = np.flatnonzero(_has_in_front(vertices[np.unique(triangles)], corners[:, 0], normals))
    some = np.zeros(len(free), bool)
    _look(corners[free], normals[free], some)
    seen = free[some]
    touched = np.zeros(len(vertices), bool)
    touched[triangles[seen]] = True
    return np.flatnonzero(touched[triangles].any(axis=1))


def _has_in_front(vertices: Array, corners: Array, normals: Array) -> NDArray[np.bool_]:
    """Tell which triangles (k,), by a corner and the outward normal (k, 3), have a vertex of the surface (n, 3) m in
    front of their plane. Any that sees another one has, and so has any that is seen."""
    least = FLAT * float(np.ptp(vertices, axis=0).max())
    at_once = max(PRODUCTS // len(vertices), 1)
    rows = [slice(first, first + at_once) for first in range(0, len(normals), at_once)]
    furthest = np.concatenate([(normals[r] @ vertices.T).max(axis=1) for r in rows])
    return np.asarray(furthest - np.einsum("ki,ki->k", normals, corners) > least)


@njit(cache=True)
def _look(corners: Array, normals: Array, seen: NDArray[np.bool_]) -> None:
    """Mark the triangles (k,) from whose middle the outward normal meets the surface again, and the first one that it
    meets (Moeller & Trumbore 1997)."""
    middle, direction, from_a, p, q = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    ab, ac = np.empty(3), np.empty(3)
    for i in range(len(corners)):
        for axis in range(3):
            middle[axis] = (corners[i, 0, axis] + corners[i, 1, axis] + corners[i, 2, axis]) / 3.0
            direction[axis] = normals[i, axis]
        nearest, met = np.inf, -1
        for j in range(len(corners)):
            against = height = 0.0
            for axis in range(3):
                against += direction[axis] * normals[j, axis]
                height += (corners[j, 0, axis] - middle[axis]) * normals[j, axis]
            if against >= -ALONG or height >= 0.0 or height / against >= nearest:
                continue
            for axis in range(3):
                ab[axis] = corners[j, 1, axis] - corners[j, 0, axis]
                ac[axis] = corners[j, 2, axis] - corners[j, 0, axis]
                from_a[axis] = middle[axis] - corners[j, 0, axis]
            _cross(direction, ac, p)
            _cross(from_a, ab, q)
            determinant = dot(ab, p)
            if determinant == 0.0:
                continue
            u, w = dot(from_a, p) / determinant, dot(direction, q) / determinant
            if u >= 0.0 and w >= 0.0 and u + w <= 1.0:
                nearest, met = height / against, j
        if met >= 0:
            seen[i] = seen[met] = True


@njit(cache=True)
def _cross(a: Array, b: Array, out: Array) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
