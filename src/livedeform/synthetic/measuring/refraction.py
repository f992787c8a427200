"""Find where points inside a transparent body seem to be.

Light takes the way of least optical length (Fermat): it leaves the surface at the place s where
|eye - s| + index |s - p| is least. The surface is known at many places, and is a quadratic patch between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import root

from livedeform.common.types import Array

PATCH = 0.006  # m, its radius
ALIKE = 0.8  # cosine between normals of one patch: a block's sides are none of its top's
ROUNDS = 12  # patches that are laid one after the other, at most
SETTLED = 1e-7  # m, between the places on two of them
GRAZING = 0.2  # cosine: less steep light is not seen, nor are markers on the surface


@dataclass(frozen=True)
class BodySurface:
    """A body's surface: ``places`` (k, 3) m on it, some 2 mm apart, and outward ``normals`` (k, 3) there."""

    places: Array
    normals: Array

    def facing(self, eye: Array) -> BodySurface:
        """Return what is turned to the ``eye`` (3,)."""
        faces = ((eye - self.places) * self.normals).sum(axis=1) > 0.0
        return BodySurface(self.places[faces], self.normals[faces])


def refracted(points: Array, surface: BodySurface, eye: Array, index: float) -> Array:
    """Return where ``points`` (n, 3) m behind the surface of a body with this refractive ``index`` seem to be from
    ``eye`` (3,) m: on the ray that leaves the surface, as far away as the point. NaN where no light comes from there,
    as from behind a dome's horizon, or only along the surface."""
    seen, out = surface.facing(eye), points.copy()
    for i, p in enumerate(points):
        place, steep = _leaves(p, seen, eye, index)
        ray = place - eye
        out[i] = eye + ray * np.linalg.norm(p - eye) / np.linalg.norm(ray) if steep > GRAZING else np.nan
    return out


def _leaves(p: Array, surface: BodySurface, eye: Array, index: float) -> tuple[Array, float]:
    """Return where (3,) on the surface light from ``p`` (3,) to ``eye`` (3,) leaves, and the cosine of its angle to the
    normal; 0 where the shortest way is none that light takes."""
    way = np.linalg.norm(surface.places - eye, axis=1) + index * np.linalg.norm(surface.places - p, axis=1)
    first = int(np.argmin(way))
    s, normal = surface.places[first], surface.normals[first]
    for _ in range(ROUNDS):
        patch = _Patch.at(s, normal, surface)
        there = root(lambda ab, patch=patch: patch.slope(ab, p, eye, index), np.zeros(2)).x
        there *= min(1.0, 0.5 * PATCH / max(float(np.linalg.norm(there)), 1e-12))
        before, (s, along) = s, patch.place(there)
        normal = np.cross(*along) / np.linalg.norm(np.cross(*along))
        if np.linalg.norm(s - before) < SETTLED:
            return s, float((eye - s) @ normal / np.linalg.norm(eye - s))
    return s, 0.0


@dataclass(frozen=True)
class _Patch:
    """The surface near ``origin`` (3,): h(a, b) along the third of the ``axes`` (3, 3), by the coefficients ``c`` (6,)
    of 1, a, b, a^2, a b, b^2."""

    origin: Array
    axes: Array
    c: Array

    @classmethod
    def at(cls, origin: Array, normal: Array, surface: BodySurface) -> _Patch:
        """Fit it to the places of the ``surface`` that are near, the nearer the more."""
        side = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        side /= np.linalg.norm(side)
        axes = np.stack([side, np.cross(normal, side), normal])
        away = np.linalg.norm(surface.places - origin, axis=1)
        near = (away < PATCH) & (surface.normals @ normal > ALIKE)
        a, b, h = ((surface.places[near] - origin) @ axes.T).T
        weight = np.sqrt((1.0 - (away[near] / PATCH) ** 3) ** 3)
        terms = np.column_stack([np.ones_like(a), a, b, a * a, a * b, b * b])
        return cls(origin, axes, np.linalg.lstsq(weight[:, None] * terms, weight * h, rcond=None)[0])

    def place(self, ab: Array) -> tuple[Array, Array]:
        """Return the place (3,) at ``ab`` (2,) and the directions (2, 3) of the surface there along a and b."""
        (a, b), c = ab, self.c
        h = c @ np.array([1.0, a, b, a * a, a * b, b * b])
        rise = np.array([c[1] + 2.0 * c[3] * a + c[4] * b, c[2] + c[4] * a + 2.0 * c[5] * b])
        along = self.axes[:2] + rise[:, None] * self.axes[2]
        return self.origin + np.array([a, b, h]) @ self.axes, along

    def slope(self, ab: Array, p: Array, eye: Array, index: float) -> Array:
        """Return the derivatives (2,) of the optical length along a and b."""
        s, along = self.place(ab)
        out: Array = along @ ((s - eye) / np.linalg.norm(s - eye) + index * (s - p) / np.linalg.norm(s - p))
        return out
