"""Fields by which effects multiply the modulus, as functions of the unloaded place X and of time.

A field that depends on the body's shape has ``bind(body) -> field``; the model calls it once it knows the unloaded body
(`fem_node.physics.record.bind_fields`). Fields jump over a distance no finite-element mesh resolves, so they are
smoothed over ``BLUR`` (a thinner layer over its thickness): their integrals, and thereby the fit, then depend smoothly
on the parameters. What ``jumps`` is averaged over parts of each element (`fem_node.element.subcells`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.mesh.triangle_distance import TriangleTree, closest_features
from livedeform.fem_node.physics.record import BodyShape, ModulusField

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
        depth = _known_depth(np.ascontiguousarray(X).tobytes(), self.corners.tobytes())
        return 1.0 + (self.ratio - 1.0) * inside_share(depth - self.thickness, min(BLUR, self.thickness))


@lru_cache(maxsize=8)
def _known_depth(points: bytes, corners: bytes) -> Array:
    """Return the distance (n,) m of ``points`` from the nearest of the triangles ``corners``, all by their arrays'
    bytes: skins of any thickness are asked for the same places at every moment."""
    tree = TriangleTree.without_normals(np.frombuffer(corners).reshape(-1, 3, 3))
    places = np.frombuffer(points).reshape(-1, 3)
    nearest, _, _, _ = closest_features(tree, places)
    return np.asarray(np.linalg.norm(places - nearest, axis=1))
