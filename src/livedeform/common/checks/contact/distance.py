"""Find how deep points lie in a closed surface, or how far above it, fast enough for the poses of half an hour."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from livedeform.common.experiment.surface import Surface
from livedeform.common.types import Array

N_SAMPLES = 20_000  # of the surface
SEED = 7  # of where they lie
NEAREST = 6  # samples, whose triangles are looked at where one sample does not tell
UPRIGHT = 0.95  # cosine between the way to a sample and its normal, from where on its plane tells the distance
AT_CORNER = 1e-6  # barycentric coordinate of a point on an edge or at a corner


class SurfaceDistance:
    """Signed distance (n,) m from a closed surface, positive inside: to the plane of the nearest of many samples, or,
    where that lies aslant, as beside an edge, to the nearest triangles. There the side is that of the angle-weighted
    normal of the nearest face, edge or corner (Baerentzen & Aanaes 2005): the plane of a rim's sample has points below
    it that are beside the body."""

    def __init__(self, surface: Surface) -> None:
        self._surface = surface

    @cached_property
    def _samples(self) -> tuple[cKDTree, NDArray[np.int64]]:
        a, b, c = np.moveaxis(self._surface.corners, 1, 0)
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        rng = np.random.default_rng(SEED)
        rows = rng.choice(len(areas), N_SAMPLES, p=areas / areas.sum())
        u, v = np.sqrt(rng.random(N_SAMPLES)), rng.random(N_SAMPLES)
        points = (1 - u)[:, None] * a[rows] + (u * (1 - v))[:, None] * b[rows] + (u * v)[:, None] * c[rows]
        return cKDTree(points), rows

    @cached_property
    def _normals(self) -> tuple[Array, Array, Array]:
        """Return normals of the faces (k, 3), of their edges (k, 3, 3), each opposite to a corner, and of the corners
        (v, 3); the first are of length one."""
        triangles, corners = self._surface.triangles, self._surface.corners
        faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        faces /= np.maximum(np.linalg.norm(faces, axis=1), 1e-300)[:, None]
        edges = np.sort(triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
        _, which = np.unique(edges @ [len(self._surface.vertices), 1], return_inverse=True)
        of_edges = np.zeros((int(which.max()) + 1, 3))
        np.add.at(of_edges, which.ravel(), np.repeat(faces, 3, axis=0))
        sides = np.roll(corners, -1, axis=1) - corners
        sides /= np.maximum(np.linalg.norm(sides, axis=2), 1e-300)[..., None]
        angles = np.arccos(np.clip(-np.einsum("kcj,kcj->kc", sides, np.roll(sides, 1, axis=1)), -1.0, 1.0))
        of_corners = np.zeros((len(self._surface.vertices), 3))
        np.add.at(of_corners, triangles, angles[..., None] * faces[:, None])
        return faces, of_edges[which.reshape(-1, 3)], of_corners

    def __call__(self, points: Array) -> Array:
        tree, rows = self._samples
        away, nearest = tree.query(points)
        offset = np.einsum("ij,ij->i", points - tree.data[nearest], self._normals[0][rows[nearest]])
        out = -offset
        aslant = np.flatnonzero(np.abs(offset) <= UPRIGHT * away)
        if len(aslant):
            out[aslant] = self._to_triangles(points[aslant])
        return np.asarray(out)

    def _to_triangles(self, points: Array) -> Array:
        """Return the signed distances (n,) m to the nearest of the triangles of some samples."""
        from trimesh.triangles import closest_point, points_to_barycentric

        tree, rows = self._samples
        candidates = rows[tree.query(points, k=NEAREST)[1]]
        corners = self._surface.corners
        feet = closest_point(corners[candidates.ravel()], np.repeat(points, NEAREST, axis=0)).reshape(-1, NEAREST, 3)
        best = np.argmin(np.linalg.norm(feet - points[:, None], axis=2), axis=1)
        own = np.arange(len(points))
        foot, triangle = feet[own, best], candidates[own, best]
        with np.errstate(all="ignore"):
            zero = points_to_barycentric(corners[triangle], foot, method="cramer") < AT_CORNER
        faces, edges, vertices = self._normals
        normal = faces[triangle]
        on_edge, at_corner = zero.sum(axis=1) == 1, zero.sum(axis=1) == 2
        normal[on_edge] = edges[triangle[on_edge], zero[on_edge].argmax(axis=1)]
        normal[at_corner] = vertices[self._surface.triangles[triangle[at_corner], (~zero[at_corner]).argmax(axis=1)]]
        side = np.einsum("ij,ij->i", points - foot, normal)
        return np.asarray(-np.sign(side) * np.linalg.norm(points - foot, axis=1))
