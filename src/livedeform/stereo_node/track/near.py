"""Distances of all points from all places, the kernels of tracking: as arrays, their differences would take long."""

from __future__ import annotations

import math

import numpy as np

from livedeform.common.compiled import njit


@njit(cache=True, error_model="numpy")
def _apart2(a, b):
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@njit(cache=True, error_model="numpy")
def distances(a, b):
    """Return how far (n, m) points ``a`` (n, 3) are from points ``b`` (m, 3)."""
    out = np.empty((len(a), len(b)))
    for i in range(len(a)):
        for j in range(len(b)):
            out[i, j] = math.sqrt(_apart2(a[i], b[j]))
    return out


@njit(cache=True, error_model="numpy")
def mahalanobis2(places, sigma, reach, points, covariances, gate):
    """Return the squared Mahalanobis distances (m, k) of points (k, 3) m with ``covariances`` (k, 3, 3) m2 from places
    (m, 3) m known to ``sigma`` (m,) m; inf of those beyond the ``gate`` (in sigmas) or ``reach`` (m,) m."""
    out = np.full((len(places), len(points)), np.inf)
    for j in range(len(points)):
        C = covariances[j]
        spread = math.sqrt(C[0, 0] + C[1, 1] + C[2, 2])
        for i in range(len(places)):
            # far pairs are sorted out by distance first: most of the table is far
            square = _apart2(points[j], places[i])
            if square >= min(reach[i], gate * (sigma[i] + spread)) ** 2:
                continue
            s2 = sigma[i] ** 2
            x, y, z = points[j, 0] - places[i, 0], points[j, 1] - places[i, 1], points[j, 2] - places[i, 2]
            # by Cholesky's factor, L L^T = C + s2 I, and L q = (x, y, z)
            a = math.sqrt(C[0, 0] + s2)
            b, c = C[1, 0] / a, C[2, 0] / a
            d = math.sqrt(C[1, 1] + s2 - b * b)
            e = (C[2, 1] - b * c) / d
            f2 = C[2, 2] + s2 - c * c - e * e
            q0 = x / a
            q1 = (y - b * q0) / d
            q2 = z - c * q0 - e * q1
            d2 = q0 * q0 + q1 * q1 + q2 * q2 / f2
            if d2 < gate * gate:
                out[i, j] = d2
    return out
