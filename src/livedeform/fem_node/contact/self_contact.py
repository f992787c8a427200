"""Tell whether a body passes through itself: contact of a body with itself is not modelled, and nothing else keeps the
walls of a cavity, a slit or a fold apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.fem_node.element.element import Space
from livedeform.fem_node.mesh.repair.crossings import crossing_pairs

_QUARTERS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])  # a quadratic facet as four flat triangles


@dataclass(frozen=True)
class FacingParts:
    """The ``triangles`` (k, 3) of a body's surface that look at one another, by rows of its ``nodes`` (m,);
    ``crossed`` (p, 2): pairs of them that cross in the scanned shape already, as far as a mesh that was given may."""

    nodes: NDArray[np.int64]
    triangles: NDArray[np.int64]
    crossed: NDArray[np.int64]

    @classmethod
    def of(cls, space: Space) -> FacingParts | None:
        """Return those of a body; None where no part of it looks at another one, as in most bodies."""
        rows = space.mesh.facing_triangles
        if not len(rows):
            return None
        facets = space.facets[rows]
        triangles = facets[:, _QUARTERS].reshape(-1, 3) if space.quadratic else facets
        used, numbers = np.unique(triangles, return_inverse=True)
        numbers = numbers.reshape(-1, 3)
        return cls(used, numbers, crossing_pairs(space.nodes[used], numbers))

    def touching(self, positions: Array) -> Array | None:
        """Return where (3,) m parts of the body that has its nodes at the ``positions`` (n, 3) m have gone through one
        another; None where none have."""
        places = positions[self.nodes]
        pairs = crossing_pairs(places, self.triangles)
        if len(self.crossed) and len(pairs):
            known = {tuple(pair) for pair in self.crossed.tolist()}
            pairs = np.array([pair for pair in pairs.tolist() if tuple(pair) not in known]).reshape(-1, 2)
        if not len(pairs):
            return None
        return np.asarray(places[self.triangles[pairs[0]].reshape(-1)].mean(axis=0))
