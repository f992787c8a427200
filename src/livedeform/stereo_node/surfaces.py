"""Keep the surfaces that the model predicts, and give the one of a moment."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from livedeform.common.types import Array
from livedeform.stereo_node.effects import Surface

LONGEST_NS = 500_000_000  # between predictions that are interpolated, and from the nearest one to a moment beside them
KEPT_NS = 2_000_000_000
APART_NS = 5_000_000  # predictions that follow each other faster are not all kept


class PredictedSurfaces:
    """Surfaces of ``/fem/surface``, with the triangles of ``/fem/mesh``: that is published now and then, for viewers.

    The surface at a moment lies on the straight line between the predictions before and after it. A surface that is
    older by the time between two of them is off by as much as the body moved, and what is seen through it by a part of
    that. Before the first prediction the mesh counts: that of the body at rest.
    """

    def __init__(self) -> None:
        self._said: deque[tuple[int, Array]] = deque()
        self._mesh: tuple[int, Surface] | None = None
        self._triangles: NDArray[np.int64] | None = None  # as rows of the predicted points

    def add_mesh(self, stamp_ns: int, mesh: Surface | None) -> None:
        """Take ``/fem/mesh``, whose triangles are those of all predictions; None where it is deleted."""
        if mesh is not None:
            self._mesh = stamp_ns, mesh
            self._learn()

    def add(self, stamp_ns: int, points: Array) -> None:
        """Take the points (m, 3) m of a prediction, NaN where it did not converge."""
        if self._said and len(points) != len(self._said[-1][1]):  # another body
            self._said.clear()
            self._triangles = None
        while self._said and self._said[-1][0] >= stamp_ns:  # a clock was set back
            self._said.pop()
        if len(self._said) > 1 and stamp_ns - self._said[-2][0] < APART_NS:
            self._said.pop()
        self._said.append((stamp_ns, points))
        while self._said[0][0] < stamp_ns - KEPT_NS:
            self._said.popleft()
        self._learn()

    def _learn(self) -> None:
        """Find the mesh's corners among the points that were published with it; the triangles stay the same."""
        if self._triangles is not None or self._mesh is None:
            return
        stamp_ns, (corners, triangles) = self._mesh
        for said_ns, points in self._said:
            if said_ns == stamp_ns and np.isfinite(points).all():
                self._triangles = np.asarray(KDTree(points).query(corners)[1], np.int64)[triangles]

    def awaited(self, stamp_ns: int) -> bool:
        """Tell whether the surface at a moment may still come: predictions have not reached it, and have not ended."""
        if not self._said or self._triangles is None:
            return True
        newest = self._said[-1][0]
        return newest < stamp_ns <= newest + LONGEST_NS

    def at(self, stamp_ns: int) -> Surface | None:
        """Return the surface at a moment; None where no prediction is near, or it did not converge."""
        if not self._said or self._triangles is None:
            return None if self._mesh is None else self._mesh[1]
        k = bisect_left(self._said, stamp_ns, key=lambda said: said[0])
        ends = [self._said[i] for i in (k - 1, k) if 0 <= i < len(self._said)]
        if ends[-1][0] == stamp_ns:
            ends = ends[-1:]
        nearest = min(abs(said_ns - stamp_ns) for said_ns, _ in ends)
        if max(ends[-1][0] - ends[0][0], nearest) > LONGEST_NS or not all(np.isfinite(p).all() for _, p in ends):
            return None
        (first_ns, first), (last_ns, last) = ends[0], ends[-1]
        share = (stamp_ns - first_ns) / (last_ns - first_ns) if last_ns > first_ns else 0.0
        return first + share * (last - first), self._triangles
