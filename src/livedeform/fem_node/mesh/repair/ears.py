"""Cut a polygon with holes into triangles by its own vertices (ear clipping; Meisters 1975, holes as Eberly 2008)."""

from __future__ import annotations

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.mesh.tet_mesh import IntArray


def cut(points: Array, loops: list[list[int]]) -> IntArray | None:
    """Triangles (k, 3), counter-clockwise, of the polygon whose outlines ``loops`` are rows of ``points`` (n, 2).

    The outer outline runs counter-clockwise, holes clockwise. The ear with the shortest cut goes first. None if there
    is no ear left, as of an outline that crosses itself.
    """
    areas = [_area(points[loop]) for loop in loops]
    outer = [k for k, area in enumerate(areas) if area > 0.0]
    if len(outer) != 1:
        return None
    ring = list(loops[outer[0]])
    holes = [loop for k, loop in enumerate(loops) if k != outer[0]]
    for hole in sorted(holes, key=lambda loop: (-points[loop, 0].max(), min(loop))):
        bridged = _bridged(points, ring, hole)
        if bridged is None:
            return None
        ring = bridged
    return _ears(points, ring)


def _ears(points: Array, ring: list[int]) -> IntArray | None:
    """Clip ears off a simple polygon (its bridges walked twice) until a triangle is left."""
    triangles = []
    while len(ring) > 3:
        here = points[ring]
        before, after = np.roll(here, 1, axis=0), np.roll(here, -1, axis=0)
        turn = _cross(here - before, after - here)
        length = np.where(turn > 0.0, np.round(((after - before) ** 2).sum(axis=1), 15), np.inf)
        for k in np.argsort(length, kind="stable").tolist():
            if not np.isfinite(length[k]):
                return None
            if _is_ear(points, ring, k, here[turn <= 0.0]):
                break
        else:
            return None
        triangles.append((ring[k - 1], ring[k], ring[(k + 1) % len(ring)]))
        del ring[k]
    triangles.append((ring[0], ring[1], ring[2]))
    return np.array(triangles, np.int64)


def _is_ear(points: Array, ring: list[int], k: int, reflex: Array) -> bool:
    """Tell whether no ``reflex`` corner (r, 2) lies in the triangle at corner ``k``, its own corners aside."""
    a, b, c = (points[ring[i % len(ring)]] for i in (k - 1, k, k + 1))
    inside = np.ones(len(reflex), bool)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= _cross(end - start, reflex - start) >= 0.0
    for corner in (a, b, c):
        inside &= (reflex != corner).any(axis=1)
    return not inside.any()


def _bridged(points: Array, ring: list[int], hole: list[int]) -> list[int] | None:
    """Join a ``hole`` to the outer ``ring`` by an edge from the hole's rightmost corner to the nearest that it sees."""
    x = points[hole]
    at = int(np.lexsort((x[:, 1], -x[:, 0]))[0])
    start = points[hole[at]]
    corners = points[ring]
    both = np.concatenate([corners, x])
    ends = np.concatenate([np.roll(corners, -1, axis=0), np.roll(x, -1, axis=0)])
    for k in np.argsort(np.round(((corners - start) ** 2).sum(axis=1), 15), kind="stable").tolist():
        if _inside_corner(points, ring, k, start) and not _crossed(start, corners[k], both, ends):
            return [*ring[: k + 1], *hole[at:], *hole[: at + 1], *ring[k:]]
    return None


def _inside_corner(points: Array, ring: list[int], k: int, place: Array) -> bool:
    """Tell whether ``place`` (2,) lies on the polygon's side of its corner ``k``: that may be there twice."""
    before, here, after = (points[ring[i % len(ring)]] for i in (k - 1, k, k + 1))
    left, right = _cross(here - before, place - here) > 0.0, _cross(after - here, place - here) > 0.0
    return bool(left and right if _cross(here - before, after - here) > 0.0 else left or right)


def _crossed(start: Array, end: Array, a: Array, b: Array) -> bool:
    """Tell whether the segment from ``start`` to ``end`` meets one of the segments a (n, 2) to b, common ends aside."""
    apart = np.ones(len(a), bool)
    for place in (start, end):
        for corner in (a, b):
            apart &= (corner != place).any(axis=1)
    a, b = a[apart], b[apart]
    one, other = _cross(end - start, a - start), _cross(end - start, b - start)
    first, second = _cross(b - a, start - a), _cross(b - a, end - a)
    return bool(((one * other <= 0.0) & (first * second <= 0.0)).any())


def _area(x: Array) -> float:
    """Return twice the signed area of a polygon (n, 2)."""
    return float(_cross(x, np.roll(x, -1, axis=0)).sum())


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
