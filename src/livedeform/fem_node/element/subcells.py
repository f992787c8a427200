"""Integrate a factor that jumps within elements: more finely than by the points at which strains are taken.

A tetrahedron of 14 mm has four of these. A layer of 5 mm holds none, one, two or three of them, by how the element
lies, and seems up to a fifth thicker than it is. So the factor is taken at the middles of many equal parts of each
element; the points get the values of the linear function of place that is nearest to those (least squares). The rule of
four points then has the factor's integral right, and that of the factor times place: what stretches and bends. A field
may give its mean over each part (`SubCells`), as one whose layer is thinner than they are must.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.fem_node.element.element import shape_values

PART = 0.004  # m, edge of a part: a few times the ramp over which factors jump (`fem_node.physics.fields.BLUR`)
MOST_SPLITS = 2  # of an element into eight: 64 parts

# an octahedron's four parts round its diagonal 0-5, as mid-edges in `_split`'s order
_ROUND = (1, 2, 4, 3)


def splits(size: float) -> int:
    """Return how often elements with edges of ``size`` m are split into eight."""
    return int(np.clip(np.ceil(np.log2(size / PART)), 1, MOST_SPLITS))


@lru_cache(maxsize=4)
def corners(times: int) -> Array:
    """Return the corners (8^times, 4, 4), in barycentric coordinates, of a tetrahedron's parts of equal volume."""
    parts = np.eye(4)[None]
    for _ in range(times):
        parts = np.concatenate([_split(part) for part in parts])
    return parts


@lru_cache(maxsize=4)
def middles(times: int) -> Array:
    """Return the middles (8^times, 4), in barycentric coordinates, of a tetrahedron's parts of equal volume."""
    return np.asarray(corners(times).mean(axis=1))


@dataclass(frozen=True)
class SubCells:
    """The parts of elements whose nodes are at ``places`` (e, a, 3) m, each split ``times``; numbered element by
    element (`fem_node.physics.record.Parts`)."""

    places: Array
    times: int
    quadratic: bool

    @property
    def n(self) -> int:
        """Parts of each element."""
        return len(middles(self.times))

    @cached_property
    def middles(self) -> Array:
        """Their middles (p, 3) m."""
        values = shape_values(middles(self.times), quadratic=self.quadratic)
        return np.asarray(values @ self.places).reshape(-1, 3)

    @cached_property
    def reach(self) -> Array:
        """No point of a part is farther (p,) m from its middle: of a straight element, whose longest edge bounds it."""
        edges = np.linalg.norm(self.places[:, :4, None] - self.places[:, None, :4], axis=3).max(axis=(1, 2))
        away = np.abs(corners(self.times) - middles(self.times)[:, None]).sum(axis=2).max(axis=1)
        return np.outer(edges, 0.5 * away).ravel()

    def corners(self, which: NDArray[np.int64]) -> Array:
        """Return the corners (n, 4, 3) m of some of them, by their numbers (n,)."""
        values = shape_values(corners(self.times).reshape(-1, 4), quadratic=self.quadratic).reshape(self.n, 4, -1)
        return np.asarray(values[which % self.n] @ self.places[which // self.n])

    def split(self, parts: Array) -> Array:
        """Return the corners (n, 8, 4, 3) m of the eight pieces of each of some parts, by their own (n, 4, 3) m."""
        return np.asarray(corners(1) @ parts[:, None])


def _split(corners: Array) -> Array:
    """Split a tetrahedron (4, d) into eight (8, 4, d): one at each corner, and the octahedron between in four."""
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    mid = np.array([0.5 * (corners[i] + corners[j]) for i, j in pairs])
    at_corners = [np.concatenate([corners[[i]], mid[[k for k, p in enumerate(pairs) if i in p]]]) for i in range(4)]
    inside = [mid[[0, 5, a, b]] for a, b in pairwise((*_ROUND, _ROUND[0]))]
    return np.array([*at_corners, *inside])


@lru_cache(maxsize=16)
def _weights(points: bytes, times: int) -> Array:
    at, parts = np.frombuffer(points).reshape(-1, 4), middles(times)
    if len(at) == 1:
        return np.full((1, len(parts)), 1.0 / len(parts))
    return np.asarray(at @ np.linalg.solve(parts.T @ parts, parts.T))


def averaged(factor: Array, points: Array, weights: Array) -> Array:
    """Return the factor (e, q) at the ``points`` (q, 4), in barycentric coordinates, with ``weights`` (q,) that add up
    to one, by its values ``factor`` (e, s) at the `middles`.

    A strong jump asks for less than the least of these somewhere: then that is taken, and the others are less by as
    much, so that the integral stays.
    """
    times = round(np.log2(factor.shape[1]) / 3)
    least = factor.min(axis=1, keepdims=True)
    over = np.maximum(factor @ _weights(np.ascontiguousarray(points).tobytes(), times).T - least, 0.0)
    whole, right = over @ weights, factor.mean(axis=1) - least[:, 0]
    share = np.divide(right, whole, out=np.ones_like(whole), where=whole > 0.0)
    return np.asarray(least + over * share[:, None])
