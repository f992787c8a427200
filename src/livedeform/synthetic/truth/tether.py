"""A string that pulls a patch of the truth's surface: an effect that no catalogue has."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livedeform.common.types import Array
from livedeform.synthetic.truth.hexmesh import IntArray


@dataclass(frozen=True)
class Tether:
    """Pull the middle of ``nodes`` (k,) to ``end`` (3,) m, ``stiffness`` N/m, once it is over ``length`` m off."""

    nodes: IntArray
    end: Array
    stiffness: float
    length: float

    @classmethod
    def on(cls, surface: IntArray, places: Array, tether: tuple[Array, float, Array, float, float]) -> Tether:
        """Tie a tether (place, radius m, end, stiffness N/m, slack m) to the nodes ``surface`` at ``places`` (n, 3)."""
        place, radius, end, stiffness, slack = tether
        near = surface[np.linalg.norm(places[surface] - place, axis=1) < radius]
        return cls(near, end, stiffness, float(np.linalg.norm(places[near].mean(0) - end) + slack))

    def pull(self, x: Array) -> tuple[Array, Array] | None:
        """Return the inner force (3,) N of each node at ``x`` (n, 3) m and its stiffness (3, 3) N/m; None while slack.

        The stiffness is each node's own block alone: a secant that converges, not the full rank-one tangent.
        """
        v = x[self.nodes].mean(0) - self.end
        length = float(np.linalg.norm(v))
        stretch = length - self.length
        if stretch <= 0.0:
            return None
        n, k = v / length, len(self.nodes)
        block = self.stiffness * (np.outer(n, n) + stretch / length * (np.eye(3) - np.outer(n, n))) / k
        return self.stiffness * stretch * n / k, block
