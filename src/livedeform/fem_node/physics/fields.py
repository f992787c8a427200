"""Fields by which effects multiply the modulus, as functions of the unloaded place X and of time.

A field that depends on the body's shape has ``bind(body) -> field``; the model calls it once it knows the unloaded body
(`fem_node.physics.record.bind_fields`). Fields jump over a distance no finite-element mesh resolves, so they are
smoothed over ``BLUR`` (a thinner layer over its thickness): their integrals, and thereby the fit, then depend smoothly
on the parameters. What ``jumps`` is averaged over parts of each element (`fem_node.element.subcells`); a skin may be
much thinner than these, and is cut out of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.fem_node.mesh.triangle_distance import TriangleTree, closest_features
from livedeform.fem_node.physics.record import BodyShape, ModulusField, Parts

BLUR = 0.001  # m, half width of the ramp from inside to outside


def inside_share(distance: Array, blur: float = BLUR) -> Array:
    """Return 1 deep inside (distance << 0), 0 outside, linear over +- ``blur`` m; the volume of a layer that is no
    thinner is kept."""
    return np.clip(0.5 - 0.5 * distance / blur, 0.0, 1.0)


@dataclass(frozen=True)
class Uniform(ModulusField):
    """One factor everywhere."""

    ratio: float

    def __call__(self, X: Array, t: float) -> Array:
        return np.full(len(X), self.ratio)


@dataclass(frozen=True)
class Drift(ModulusField):
    """exp(-rate t)."""

    rate: float

    @property
    def changes_with_time(self) -> bool:
        return self.rate != 0.0

    def at(self, t: float) -> Uniform:
        return Uniform(float(np.exp(-self.rate * t)))

    def __call__(self, X: Array, t: float) -> Array:
        return np.full(len(X), np.exp(-self.rate * t))


@dataclass(frozen=True)
class Ball(ModulusField):
    """``ratio`` inside a ball. Across the edge the modulus of a stiffer one changes by equal factors: by equal steps a
    ball of 20 mm, ten times as stiff, would do as much as one that is 0.4 mm larger in radius."""

    centre: tuple[float, float, float]
    radius: float
    ratio: float

    @property
    def jumps(self) -> bool:
        return True

    def __call__(self, X: Array, t: float) -> Array:
        distance = np.linalg.norm(X - np.array(self.centre), axis=1) - self.radius
        share = inside_share(distance)
        return np.asarray(self.ratio**share if self.ratio > 1.0 else 1.0 + (self.ratio - 1.0) * share)


@dataclass(frozen=True)
class HeightGradient(ModulusField):
    """1 + slope (z - H/2), z from the lowest point of the unloaded body, never below 0.02."""

    slope: float
    lowest: float = 0.0
    height: float = float("nan")

    def bind(self, body: BodyShape) -> HeightGradient:
        z = body.nodes[:, 2]
        return replace(self, lowest=float(z.min()), height=float(z.max() - z.min()))

    def __call__(self, X: Array, t: float) -> Array:
        return np.maximum(1.0 + self.slope * (X[:, 2] - self.lowest - 0.5 * self.height), 0.02)


@dataclass(frozen=True)
class Skin(ModulusField):
    """``ratio`` within ``thickness`` of the free surface."""

    thickness: float
    ratio: float
    corners: Array | None = None  # (k, 3, 3) m of the free triangles

    @property
    def jumps(self) -> bool:
        return True

    def bind(self, body: BodyShape) -> Skin:
        corners = np.ascontiguousarray(body.nodes[body.triangles[~body.held]])
        return Skin(self.thickness, self.ratio, corners)

    def __call__(self, X: Array, t: float) -> Array:
        if self.corners is None:
            raise ValueError("a skin needs the body's shape: bind it first")
        depth, _ = _depth(X, self.corners)
        return 1.0 + (self.ratio - 1.0) * inside_share(depth - self.thickness, min(BLUR, self.thickness))

    def over(self, parts: Parts, t: float) -> Array:
        """Return the mean factor (p,) over parts. The layer's inner face is taken for a plane in each; those of
        elements that are near several faces of the body are split once more."""
        if self.corners is None:
            raise ValueError("a skin needs the body's shape: bind it first")
        depth, inward = _depth(parts.middles, self.corners)
        share = (depth < self.thickness).astype(float)
        crossed = np.flatnonzero(np.abs(depth - self.thickness) < parts.reach)
        corners, bent = parts.corners(crossed), _bent(inward, parts.n)[crossed]
        depth, inward = depth[crossed], inward[crossed]
        share[crossed] = _share_of_layer(corners, depth, inward, self.thickness)
        pieces = parts.split(corners[bent]).reshape(-1, 4, 3)
        of_pieces = _share_of_layer(pieces, *_depth(pieces.mean(axis=1), self.corners), self.thickness)
        share[crossed[bent]] = of_pieces.reshape(-1, 8).mean(axis=1)
        return 1.0 + (self.ratio - 1.0) * share


def _share_of_layer(corners: Array, depth: Array, inward: Array, thickness: float) -> Array:
    """Return the share (n,) of tetrahedra ``corners`` (n, 4, 3) m in a layer ``thickness`` m thick, of which the
    middles are ``depth`` (n,) m deep and the unit vectors ``inward`` (n, 3) lead into the body."""
    away = corners - corners.mean(axis=1)[:, None]
    return share_below(depth[:, None] + (away @ inward[:, :, None])[..., 0], thickness)


def share_below(values: Array, level: float) -> Array:
    """Return the share (n,) of each tetrahedron's volume in which a linear function is below ``level``, by its
    ``values`` (n, 4) at the corners (Bloechl et al. 1994, appendix B)."""
    a, b, c, d = np.sort(values, axis=1).T
    x = np.clip(level, a, d)
    with np.errstate(divide="ignore", invalid="ignore"):
        low = (x - a) ** 3 / ((b - a) * (c - a) * (d - a))
        bent = ((c - a) + (d - b)) / ((c - b) * (d - b)) * (x - b) ** 3
        mid = ((b - a) ** 2 + 3.0 * (b - a) * (x - b) + 3.0 * (x - b) ** 2 - bent) / ((c - a) * (d - a))
        high = 1.0 - (d - x) ** 3 / ((d - a) * (d - b) * (d - c))
    share = np.select([level <= a, level >= d, x < b, x < c], [0.0, 1.0, low, mid], high)
    return np.asarray(share)


def _bent(inward: Array, n: int) -> NDArray[np.bool_]:
    """Return which parts (p,) are of an element that has at least one, of ``n``, near another face than the others."""
    straight = np.linalg.norm(inward.reshape(-1, n, 3).mean(axis=1), axis=1)
    return np.repeat(straight < 1.0 - 0.5 / n, n)


def _depth(points: Array, surface: Array) -> tuple[Array, Array]:
    """Return how deep (n,) m below the triangles ``surface`` (k, 3, 3) m points are, and the unit vectors (n, 3) from
    there inward."""
    away = points - _known_nearest(np.ascontiguousarray(points).tobytes(), surface.tobytes())
    depth = np.linalg.norm(away, axis=1)
    return depth, away / np.maximum(depth, np.finfo(float).tiny)[:, None]


@lru_cache(maxsize=8)
def _known_nearest(points: bytes, corners: bytes) -> Array:
    """Return the place (n, 3) m on the triangles ``corners`` that is nearest to each of ``points``, all by their
    arrays' bytes: skins of any thickness are asked for the same places again."""
    tree = TriangleTree.without_normals(np.frombuffer(corners).reshape(-1, 3, 3))
    nearest, _, _, _ = closest_features(tree, np.frombuffer(points).reshape(-1, 3))
    return nearest
