"""Find the parts of a surface that look at one another across a gap, as the walls of a cavity, a slit or a fold do:
where a body is pressed they may come to touch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.fem_node.mesh.triangle_distance import LEAF_SIZE, STACK_SIZE, dot

ALONG = 1e-6  # cosine; a triangle that is seen that much from the side is not looked at
FLAT = 1e-9  # of the surface's size; what is less in front of a triangle lies in its plane
BITS = 10  # by which places are told apart, per axis, to put neighbours in a row


def facing(vertices: Array, triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the rows (f,), sorted, of the ``triangles`` (k, 3), outward, of a closed surface (``vertices`` (n, 3) m)
    that look at another one, or are looked at, and of their neighbours; none of a body that is convex."""
    corners = np.ascontiguousarray(vertices[triangles])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    used = vertices[np.unique(triangles)]
    least = FLAT * float(np.ptp(used, axis=0).max())
    seen = np.zeros(len(triangles), bool)
    _look(corners, normals, used, least, *_boxes(corners, least), seen)
    touched = np.zeros(len(vertices), bool)
    touched[triangles[seen]] = True
    return np.flatnonzero(touched[triangles].any(axis=1))


def _boxes(corners: Array, margin: float) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the order (k,) in which the triangles ``corners`` (k, 3, 3) m lie beside one another (Morton's curve), and
    the boxes' ``low`` and ``high`` (2 l, 3) m, with a ``margin`` m, of a tree over them: box i has the boxes 2 i and
    2 i + 1 within it, and box l + i has the triangles from i k / l on."""
    middles = corners.mean(axis=1)
    middles -= middles.min(axis=0)
    at = (middles * ((2**BITS - 1) / max(float(middles.max()), 1e-300))).astype(np.int64)
    code = np.zeros(len(corners), np.int64)
    for bit in range(BITS):
        for axis in range(3):
            code |= ((at[:, axis] >> bit) & 1) << (3 * bit + axis)
    order = np.argsort(code, kind="stable")
    n_leaves = 1
    while n_leaves * LEAF_SIZE < len(corners):
        n_leaves *= 2
    low, high = np.empty((2 * n_leaves, 3)), np.empty((2 * n_leaves, 3))
    first = np.arange(n_leaves) * len(corners) // n_leaves
    low[n_leaves:] = np.minimum.reduceat(corners[order].min(axis=1), first) - margin
    high[n_leaves:] = np.maximum.reduceat(corners[order].max(axis=1), first) + margin
    while n_leaves > 1:
        n_leaves //= 2
        here, within = slice(n_leaves, 2 * n_leaves), slice(2 * n_leaves, 4 * n_leaves)
        low[here] = low[within].reshape(-1, 2, 3).min(axis=1)
        high[here] = high[within].reshape(-1, 2, 3).max(axis=1)
    return order, low, high


@njit(cache=True, error_model="numpy")
def _look(corners, normals, vertices, least, order, low, high, seen):
    """Mark the triangles (k,) from whose middle the outward normal meets the surface again, and the first one that it
    meets. Both have one of the ``vertices`` (n, 3) more than ``least`` m in front of their plane."""
    n, n_leaves = len(corners), len(low) // 2
    stack, free = np.empty(STACK_SIZE, np.int64), np.zeros(n, np.int64)
    for i in range(n):
        middle, direction = (corners[i, 0] + corners[i, 1] + corners[i, 2]) / 3.0, normals[i]
        nearest, met = np.inf, -1
        stack[0], depth = 1, 1
        while depth > 0:
            depth -= 1
            box = stack[depth]
            if not _meets_box(middle, direction, low, high, box, nearest):
                continue
            if box < n_leaves:
                stack[depth], stack[depth + 1] = 2 * box, 2 * box + 1
                depth += 2
                continue
            leaf = box - n_leaves
            for k in range(leaf * n // n_leaves, (leaf + 1) * n // n_leaves):
                j = order[k]
                ahead = _meets(middle, direction, corners[j], normals[j])
                first = ahead < nearest or (ahead == nearest and j < met)  # the surface's own order where two meet
                if first and _is_free(j, corners, normals, corners[i], vertices, least, free):
                    nearest, met = ahead, j
        if met >= 0 and _is_free(i, corners, normals, corners[met], vertices, least, free):
            seen[i] = seen[met] = True


@njit(cache=True, error_model="numpy")
def _meets_box(middle, direction, low, high, k, most):
    """Tell whether a ray meets box ``k`` before ``most`` m."""
    enter, leave = 0.0, most
    for axis in range(3):
        if direction[axis] == 0.0:
            if middle[axis] < low[k, axis] or middle[axis] > high[k, axis]:
                return False
            continue
        a, b = (low[k, axis] - middle[axis]) / direction[axis], (high[k, axis] - middle[axis]) / direction[axis]
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    return enter <= leave


@njit(cache=True, error_model="numpy")
def _meets(middle, direction, corners, normal):
    """Return how far (m) from ``middle`` a ray meets a triangle's outside, inf if not (Moeller & Trumbore 1997)."""
    against, height = dot(direction, normal), dot(corners[0], normal) - dot(middle, normal)
    if against >= -ALONG or height >= 0.0:
        return np.inf
    from_a = middle - corners[0]
    ab, ac = corners[1] - corners[0], corners[2] - corners[0]
    p, q = _cross(direction, ac), _cross(from_a, ab)
    determinant = dot(ab, p)
    if determinant == 0.0:
        return np.inf
    u, w = dot(from_a, p) / determinant, dot(direction, q) / determinant
    return height / against if u >= 0.0 and w >= 0.0 and u + w <= 1.0 else np.inf


@njit(cache=True, error_model="numpy")
def _is_free(k, corners, normals, asked_first, vertices, least, free):
    """Tell whether triangle ``k`` has a vertex in front of it; ``free`` (k,) keeps it: 1 it has, -1 it has not."""
    if free[k] == 0:
        free[k] = 1 if _in_front(corners[k, 0], normals[k], asked_first, least) else 0
    if free[k] == 0:
        free[k] = 1 if _in_front(corners[k, 0], normals[k], vertices, least) else -1
    return free[k] > 0


@njit(cache=True, error_model="numpy")
def _in_front(corner, normal, points, least):
    furthest = -np.inf
    for point in points:
        furthest = max(furthest, dot(normal, point) - dot(normal, corner))
        if furthest > least:
            break
    return furthest > least


@njit(cache=True, error_model="numpy")
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
