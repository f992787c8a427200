"""The body's surface at every marker, from the markers around it: its normal and its curvature.

A disc that is painted on a curved body has its rim below its middle: by r^2 / 2R on a ball of radius R, 0.054 mm for
r = 2.2 mm and R = 45 mm. The pictures show the rim only. What the middle is above it follows from the surface's
curvature, which a quadric through the neighbouring markers gives:

    height = a + b . t - (t^T K t + height^2 tr(K) / 2) / 2,    t: the place in the tangent plane, m;
    K: curvature, 1/m, convex positive (the height's square makes it exact on a ball)

by weighted least squares with a prior (K is 0 within ``CURVATURE_PRIOR``). A neighbour at a distance d errs by its own
noise and by what is not quadratic, ``ROUGHNESS`` d^3; residuals beyond that enlarge the covariance.
What a body's own unevenness adds is taken as ``UNEVEN`` of the curvature, and where the neighbours lie on one side
(near the foot, on the limb) ``ONE_SIDED`` of their mean distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array

N_NEIGHBOURS = 12
CURVATURE_PRIOR = 30.0  # 1/m: bodies of 3 cm radius and larger
SLOPE_PRIOR = 0.15  # rad, of the normals that are given
ROUGHNESS = 50.0  # 1/m2: a sixth of the curvature's change per length
UNEVEN = 0.035  # between a disc's place and its neighbourhood, of the curvature
ONE_SIDED = 400.0  # 1/m2: how fast the curvature may change beyond the outermost markers
N_AROUND = 6
SAME_SIDE = 0.6  # cosine: a neighbour whose normal is turned further lies round an edge


@dataclass(frozen=True)
class Quadrics:
    """Unit normals (n, 3), two directions across them ``bases`` (n, 3, 2), curvatures K (n, 3) = xx, xy, yy in these
    1/m, and their covariances (n, 3, 3); ``at_edge`` (n,): whether a near neighbour lies on another face."""

    normals: Array
    bases: Array
    curvatures: Array
    covariances: Array
    at_edge: NDArray[np.bool_]

    @property
    def tensors(self) -> Array:
        """(n, 3, 3) 1/m: K with K n = 0."""
        K = self.curvatures[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        out: Array = self.bases @ K @ np.swapaxes(self.bases, 1, 2)
        return out


def fit_quadrics(points: Array, sigma: Array, normals: Array, rows: NDArray[np.int64]) -> Quadrics:
    """Fit the surface at ``points[rows]``.

    ``points`` (m, 3) m all of one body; ``sigma`` (m,) m, inf for those that must not count; ``normals`` (m, 3) rough
    unit outward normals.
    """
    n = normals[rows]
    B = tangent_basis(n)
    near, d, offset, at_edge = _neighbours(points, sigma, normals, rows)
    used = np.isfinite(d)
    t = np.einsum("nkj,nja->nka", offset, B)
    h = np.where(used, np.einsum("nkj,nj->nk", offset, n), 0.0)
    variance = sigma[near] ** 2 + (ROUGHNESS * d**3) ** 2
    w = np.where(used, 1 / np.where(used, variance, 1.0), 0.0)
    p, C = _least_squares(t, h, w, used)
    refined = n - np.einsum("nja,na->nj", B, p[:, 1:3])
    refined /= np.linalg.norm(refined, axis=1)[:, None]
    beside = used[:, : N_AROUND + 1, None] * t[:, : N_AROUND + 1]
    off_side = np.linalg.norm(
        beside.sum(axis=1) / np.maximum(used[:, : N_AROUND + 1].sum(axis=1) - 1, 1)[:, None], axis=1
    )
    uneven = np.hypot(UNEVEN * np.abs(p[:, 3] + p[:, 5]), ONE_SIDED * off_side)
    C_K = C[:, 3:, 3:] + 0.5 * uneven[:, None, None] ** 2 * np.diag([1.0, 0.5, 1.0])
    return Quadrics(refined, B, p[:, 3:], C_K, at_edge)


def _neighbours(
    points: Array, sigma: Array, normals: Array, rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.bool_]]:
    """Return the nearest of the same face (n, k), their distances (n, k), inf for those that do not count, and offsets
    (n, k, 3) m; and whether (n,) a near one lies on another face."""
    offset = points[None] - points[rows][:, None]
    distance = np.linalg.norm(offset, axis=2)
    distance[:, ~np.isfinite(sigma)] = np.inf
    same = normals[rows] @ normals.T > SAME_SIDE
    around = np.argsort(distance, axis=1)[:, : N_AROUND + 1]
    other_face = ~np.take_along_axis(same, around, axis=1) & np.isfinite(np.take_along_axis(distance, around, axis=1))
    distance[~same] = np.inf
    near = np.argsort(distance, axis=1)[:, : N_NEIGHBOURS + 1]
    k = np.arange(len(rows))[:, None]
    return near, distance[k, near], offset[k, near], other_face.any(axis=1)


def _least_squares(t: Array, h: Array, w: Array, used: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Fit a, b and K (n, 6) to heights ``h`` (n, k) m at ``t`` (n, k, 2) m with weights ``w`` (n, k); and their
    covariances (n, 6, 6), enlarged where the residuals are larger than the weights say."""
    x, y = t[:, :, 0], t[:, :, 1]
    h2 = 0.5 * h * h
    A = np.stack([np.ones_like(x), x, y, -0.5 * (x * x + h2), -x * y, -0.5 * (y * y + h2)], axis=2)
    prior = np.array([0.0, *[SLOPE_PRIOR**-2] * 2, *[CURVATURE_PRIOR**-2] * 3])
    AtW = np.swapaxes(A * w[:, :, None], 1, 2)
    C = np.linalg.inv(AtW @ A + np.diag(prior) + 1e-6 * np.eye(6))
    p = np.einsum("nij,njk,nk->ni", C, AtW, h)
    residual = h - np.einsum("nki,ni->nk", A, p)
    spare = np.maximum(used.sum(axis=1) - 6, 1)
    return p, C * np.maximum((w * residual**2).sum(axis=1) / spare, 1.0)[:, None, None]


def tangent_basis(normals: Array) -> Array:
    """Return (n, 3, 2): two orthonormal directions across each of ``normals`` (n, 3)."""
    other = np.where(np.abs(normals[:, 2:]) < 0.7, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    a = np.cross(normals, other)
    a /= np.linalg.norm(a, axis=1)[:, None]
    return np.stack([a, np.cross(normals, a)], axis=2)
