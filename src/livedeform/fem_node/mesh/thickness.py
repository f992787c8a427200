"""Measure how thick a body is at its thinnest: too few elements through a plate or a limb, and its answer depends on
them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.mesh.tet_mesh import IntArray

FEWEST = 2.0  # elements through the thinnest part
PRODUCTS = 1_000_000  # of rays with triangles at once, which take up memory
RAYS = 800  # from the surface inwards, spread evenly over its area
FACING = 0.85  # cosine between the two sides of a plate or limb; less is a wedge, which is thin at every rim
SHARE = 0.02  # of the surface that must be as thin, so that a notch or a speck is no part of the body


class Thickness(NamedTuple):
    """``thinnest`` m, inf where no two sides face each other, and its ``place`` (x, y, z) m on the surface."""

    thinnest: float
    place: tuple[float, float, float]


def thinnest_part(vertices: Array, triangles: IntArray) -> Thickness:
    """Measure a closed surface (vertices (n, 3) m, triangles (k, 3) outward) along its inward normals, from places
    spread over it to the side that faces them."""
    middle = vertices.mean(axis=0)
    corners = (vertices - middle)[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    normals = cross / np.maximum(area, 1e-300)[:, None]
    places, of = _spread(corners, area, RAYS)
    at_once = max(PRODUCTS // len(corners), 1)
    batches = [slice(k, k + at_once) for k in range(0, RAYS, at_once)]
    through = np.concatenate([_through(places[b], normals[of[b]], corners, cross, normals) for b in batches])
    order = np.argsort(np.round(through, 12), kind="stable")  # a plate is as thin everywhere: rounding tells no place
    at = int(order[int(SHARE * RAYS)])
    x, y, z = (float(c) for c in places[at] + middle)
    return Thickness(float(through[at]), (x, y, z))


def thickness_warning(thickness: Thickness, element_size: float) -> list[str]:
    """Return one line if fewer than `FEWEST` elements of ``element_size`` m go through the thinnest part."""
    n = thickness.thinnest / element_size
    if n >= FEWEST:
        return []
    place = ", ".join(f"{1e3 * c:.1f}" for c in thickness.place)
    return [
        f"WARN: elements of {1e3 * element_size:g} mm are too large: {n:.1f} go through its thinnest part "
        f"({1e3 * thickness.thinnest:.1f} mm at ({place}) mm), and the answer would hang on how they happen to lie; "
        f"use {1e3 * thickness.thinnest / 3.0:.2g} mm"
    ]


def _spread(corners: Array, area: Array, n: int) -> tuple[Array, IntArray]:
    """Return points (n, 3) of triangles (k, 3, 3), evenly by their ``area`` (k,), and whose triangles they are."""
    rng = np.random.default_rng(0)
    total = np.cumsum(area)
    of = np.searchsorted(total, (np.arange(n) + 0.5) / n * total[-1])
    a, b = rng.uniform(size=(2, n))
    a, b = np.where(a + b > 1.0, 1.0 - a, a), np.where(a + b > 1.0, 1.0 - b, b)
    weights = np.column_stack([1.0 - a - b, a, b])
    return np.einsum("nc,nci->ni", weights, corners[of]), of


def _through(starts: Array, inner: Array, corners: Array, cross: Array, normals: Array) -> Array:
    """Return the distances (r,) m from ``starts`` (r, 3) on the surface, whose normals are ``inner`` (r, 3) there,
    inwards to the next side, inf where that does not face it; ``cross`` (k, 3): normals as long as twice the areas.

    Moeller & Trumbore 1997, whose triple products of a ray and a triangle are sums of products of what belongs to
    either: all rays meet all triangles in a few products of matrices.
    """
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    away, moment = -inner, np.cross(starts, -inner)
    determinant = inner @ cross.T
    safe = np.where(np.abs(determinant) < 1e-300, 1.0, determinant)
    u = (moment @ ac.T - away @ np.cross(ac, a).T) / safe
    w = (-moment @ ab.T - away @ np.cross(a, ab).T) / safe
    far = (starts @ cross.T - (a * cross).sum(axis=1)) / safe
    hit = (determinant < -1e-300) & (u >= 0.0) & (w >= 0.0) & (u + w <= 1.0) & (far > 0.0)
    far = np.where(hit, far, np.inf)
    nearest = np.argmin(far, axis=1)
    faces = (normals[nearest] * away).sum(axis=1) > FACING
    return np.asarray(np.where(faces, far[np.arange(len(far)), nearest], np.inf))
