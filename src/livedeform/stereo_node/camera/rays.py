"""Rays: where two of them meet, where they hit a surface, and how they are refracted there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from livedeform.common.experiment.smooth_surface import corner_normals
from livedeform.common.types import Array

MET, NEARLY_MET = 1e-10, 1e-6  # m, from a ray to the point that it is for: where the search ends, and is accepted


def meet(a: Array, u: Array, b: Array, v: Array) -> Array:
    """Return (n, 3): midpoint of the shortest connection of the lines a + s u and b + r v.

    ``a``, ``b`` (3,) or (n, 3); ``u``, ``v`` (n, 3), of any length. NaN for parallel lines.
    """
    w = np.broadcast_to(b - a, u.shape)
    uu, vv, uv = (u * u).sum(axis=1), (v * v).sum(axis=1), (u * v).sum(axis=1)
    uw, vw = (u * w).sum(axis=1), (v * w).sum(axis=1)
    det = uu * vv - uv**2
    det = np.where(det > 1e-14 * uu * vv, det, np.nan)
    s, r = (vv * uw - uv * vw) / det, (uv * uw - uu * vw) / det
    return np.asarray(0.5 * ((a + s[:, None] * u) + (b + r[:, None] * v)))


class TriangleSurface:
    """A triangle surface that rays can hit.

    Smooth normals are interpolated from the corners', so that a faceted surface refracts as the smooth one that it
    stands for; at an edge each side has its own.
    """

    def __init__(self, points: Array, triangles: NDArray[np.int64]) -> None:
        """Take ``points`` (m, 3) m and ``triangles`` (k, 3), outward."""
        self.points, self.triangles = points, triangles
        self._normals = corner_normals(points, triangles)
        a = points[triangles[:, 0]]
        self._a, self._e1, self._e2 = a, points[triangles[:, 1]] - a, points[triangles[:, 2]] - a
        edges = np.linalg.norm(np.stack([self._e1, self._e2, self._e2 - self._e1]), axis=2)
        self._reach = edges.max(axis=0)  # from the first corner to any place of its triangle

    def hit(self, origin: Array, directions: Array) -> tuple[Array, Array]:
        """Return the first place (n, 3) where rays from ``origin`` (3,) along ``directions`` (n, 3) hit, and the unit
        normal (n, 3) there.

        Moeller & Trumbore 1997. NaN where a ray misses.
        """
        places, normals = np.full(directions.shape, np.nan), np.full(directions.shape, np.nan)
        to_corner = self._a - origin
        length2 = (to_corner**2).sum(axis=1)
        for i, d in enumerate(directions / np.linalg.norm(directions, axis=1)[:, None]):
            along = to_corner @ d
            near = np.flatnonzero((along > -self._reach) & (length2 - along**2 <= self._reach**2))
            e1, e2, t_vec = self._e1[near], self._e2[near], -to_corner[near]
            p, q = np.cross(d, e2), np.cross(t_vec, e1)
            det = (e1 * p).sum(axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                u, v, t = (t_vec * p).sum(axis=1) / det, (q @ d) / det, (e2 * q).sum(axis=1) / det
            slack = 1e-9
            good = (np.abs(det) > 1e-30) & (u >= -slack) & (v >= -slack) & (u + v <= 1 + slack) & (t > 1e-9)
            if good.any():
                k = int(np.flatnonzero(good)[np.argmin(t[good])])
                n = np.array([1 - u[k] - v[k], u[k], v[k]]) @ self._normals[near[k]]
                places[i], normals[i] = origin + t[k] * d, n / np.linalg.norm(n)
        return places, normals


def apparent(origin: Array, points: Array, surface: TriangleSurface, index: float, n_iterations: int = 60) -> Array:
    """Find the directions (n, 3) from ``origin`` (3,) in which ``points`` (n, 3) behind the surface are seen; NaN where
    they are not.

    The aim is moved by what the refracted ray misses the point by, until it meets it (a fixed point; the ray moves
    nearly as much as the aim). A step that leads no nearer, as past a dome's horizon, is halved.
    """
    best, step, least = points.copy(), np.zeros_like(points), np.full(len(points), np.inf)
    left = np.arange(len(points))  # those that are still looked for
    for _ in range(n_iterations):
        aim = best[left] + step[left]
        place, normal = surface.hit(origin, aim - origin)
        inside = refract(aim - origin, normal, index)
        to_point = points[left] - place
        miss = to_point - (to_point * inside).sum(axis=1)[:, None] * inside
        length = np.nan_to_num(np.linalg.norm(miss, axis=1), nan=np.inf)
        nearer = length < least[left]
        best[left] = np.where(nearer[:, None], aim, best[left])
        step[left] = np.where(nearer[:, None], miss, 0.5 * step[left])
        least[left] = np.where(nearer, length, least[left])
        left = left[(least[left] > MET) & np.isfinite(least[left]) & (np.linalg.norm(step[left], axis=1) > MET)]
        if not len(left):
            break
    return np.where((least < NEARLY_MET)[:, None], best - origin, np.nan)


def refract(directions: Array, normals: Array, index: float) -> Array:
    """Refract: unit directions (n, 3) inside a body of refractive ``index`` of rays that enter it along ``directions``
    from air.

    Snell's law in vectors (Glassner 1989): e = d/N + (cos(i)/N - cos(r)) n, n the outward normal.
    """
    d = directions / np.linalg.norm(directions, axis=1)[:, None]
    cos_in = -(d * normals).sum(axis=1)
    cos_out = np.sqrt(np.maximum(1 - (1 - cos_in**2) / index**2, 0.0))
    return np.asarray(d / index + (cos_in / index - cos_out)[:, None] * normals)
