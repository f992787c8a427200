"""Interpolate predictions to a measured stamp, and tell by how much that can be wrong.

Between two predictions at t0 <= t <= t1 a marker moves on the straight line

    x(t) = x0 + a (x1 - x0),   a = (t - t0) / (t1 - t0),

whose remainder is |x''| (t - t0)(t1 - t) / 2 with x'' somewhere in between (Newton's interpolation formula). One
neighbour gives a mean of x'' (the second divided difference), which says little of a marker that the probe has just
touched. Both do: a coordinate whose velocities v0, v1, v2 before, between and after change in one direction lies
between the line and the lines of its neighbours going on, so that it is off by no more than

    min(|v1 - v0| (t - t0), |v2 - v1| (t1 - t)).

Where they change to and fro, as of a marker that is still, moves and is still again, it may follow either line and then
change over: the larger distance counts, as long as the marker can still change over at five times its mean speed, and
no change counts as more than four times the other, which is noise where a velocity stays. Where only one neighbour is
known, its remainder is an estimate and no bound. A neighbour is at least half as far away as the bracket is long: the
velocity over a shorter time is mostly noise, which the bracket would make as many times larger as it is longer.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from livedeform.common.types import Array, Ids, PredictedMarkers

__all__ = ["Interpolated", "InterpolationBound", "interpolate", "neighbour", "remainder"]

QUICK = 4.0  # by how much faster a marker is at most within a bracket than its change of velocity, and by how much the
# change on one side of a bracket is larger at most than that on the other
# m: nothing, and classes one percent wide, of which a percentile is told for hours on end
EDGES = np.concatenate([[0.0], np.geomspace(1e-9, 10.0, 2304)])
Bracket = tuple[PredictedMarkers | None, PredictedMarkers, PredictedMarkers]
"""Two predictions, and a neighbour before them where one is known."""


def interpolate(first: PredictedMarkers, second: PredictedMarkers, stamp_ns: int) -> PredictedMarkers:
    """Return the markers of both predictions on the straight line between them at ``stamp_ns``."""
    ids, rows, columns = np.intersect1d(first.ids, second.ids, return_indices=True)
    a = (stamp_ns - first.stamp_ns) / (second.stamp_ns - first.stamp_ns)
    x0, x1 = first.points[rows], second.points[columns]
    return PredictedMarkers(stamp_ns, ids.astype(np.uint32), x0 + a * (x1 - x0))


def remainder(
    before: PredictedMarkers | None, first: PredictedMarkers, second: PredictedMarkers, stamp_ns: int
) -> float:
    """Return the largest |x''| (t - t0)(t1 - t) / 2 over the markers (m); NaN without one before t0."""
    bounds = _bounds((before, first, second, None), stamp_ns)
    return float(bounds.max()) if len(bounds) else float("nan")


def neighbour(
    others: Iterable[PredictedMarkers], first: PredictedMarkers, second: PredictedMarkers
) -> PredictedMarkers | None:
    """Return the first of the ``others``, the nearest first, that is far enough from the bracket of two predictions to
    tell a velocity beside it; None if none is."""
    for other in others:
        away = max(first.stamp_ns - other.stamp_ns, other.stamp_ns - second.stamp_ns)
        if 2 * away >= second.stamp_ns - first.stamp_ns:
            return other
    return None


@dataclass(frozen=True)
class Interpolated:
    """Say by how much (m) interpolation can have been wrong: ``largest`` of any marker in any frame, and ``judged`` in
    what is judged of all of them, their rmse and 95th percentile, the larger of the two; NaN where no frame was
    interpolated, or nothing is known of it."""

    largest: float = float("nan")
    judged: float = float("nan")


class InterpolationBound:
    """Keep by how much interpolation can have been wrong so far, frame by frame.

    The prediction after a bracket often comes after its frames: those wait for it here, or for the end.
    """

    def __init__(self) -> None:
        self.value = float("nan")
        """The largest (m) over frames and markers; NaN where no frame was interpolated, or nothing is known of it."""
        self._squares = 0.0  # of every marker in every frame
        self._classes = np.zeros(len(EDGES) + 1, np.int64)  # how many of them are up to each of the EDGES, and beyond
        self._waiting: list[tuple[Bracket, int]] = []

    @property
    def found(self) -> Interpolated:
        """Return what is known of all frames so far."""
        if not np.isfinite(self.value):
            return Interpolated()
        up_to = np.cumsum(self._classes)
        p95 = EDGES[min(int(np.searchsorted(up_to, 0.95 * up_to[-1])), len(EDGES) - 1)]
        return Interpolated(self.value, float(max(np.sqrt(self._squares / up_to[-1]), p95)))

    def add_exact(self, n: int) -> None:
        """Take a frame of ``n`` markers that has a prediction of its own."""
        self._classes[0] += n

    def add(self, bracket: Bracket, later: Iterable[PredictedMarkers], stamp_ns: int) -> None:
        """Take a frame at ``stamp_ns`` that was interpolated in a ``bracket``, with what is known ``later`` than it."""
        after = neighbour(later, *bracket[1:])
        if after is None:
            self._waiting.append((bracket, stamp_ns))
        else:
            self._take(bracket, after, stamp_ns)

    def settle(self, after: PredictedMarkers | None) -> None:
        """Take a prediction that came ``after`` the last bracket; None: no more come."""
        waiting, self._waiting = self._waiting, []
        for bracket, stamp_ns in waiting:
            if after is None or neighbour([after], *bracket[1:]) is not None:
                self._take(bracket, after, stamp_ns)
            else:
                self._waiting.append((bracket, stamp_ns))

    def _take(self, bracket: Bracket, after: PredictedMarkers | None, stamp_ns: int) -> None:
        bounds = _bounds((*bracket, after), stamp_ns)
        if len(bounds):
            self.value = float(np.fmax(self.value, bounds.max()))
            self._squares += float(bounds @ bounds)
            np.add.at(self._classes, np.searchsorted(EDGES, bounds), 1)


def _bounds(
    four: tuple[PredictedMarkers | None, PredictedMarkers, PredictedMarkers, PredictedMarkers | None], stamp_ns: int
) -> Array:
    """Return by how much (m) the line between the second and third of ``four`` predictions can be wrong at a stamp, of
    the markers that are in all; none without a neighbour that converged."""
    known = [p if p is not None and p.converged else None for p in four]
    there = [p for p in known if p is not None]
    ids = there[0].ids
    for p in there[1:]:
        ids = np.intersect1d(ids, p.ids)
    if len(there) < 3 or len(ids) == 0:
        return np.empty(0)
    t = [(p.stamp_ns - four[1].stamp_ns) * 1e-9 for p in there]
    x = [_rows(p, ids) for p in there]
    velocity = [(x[k + 1] - x[k]) / (t[k + 1] - t[k]) for k in range(len(there) - 1)]
    s, left = (stamp_ns - four[1].stamp_ns) * 1e-9, (four[2].stamp_ns - stamp_ns) * 1e-9
    off = [np.abs(velocity[k + 1] - velocity[k]) / (t[k + 2] - t[k]) * s * left for k in range(len(velocity) - 1)]
    out = np.maximum(off[0], off[-1])
    if len(there) == 4:
        before, after = velocity[1] - velocity[0], velocity[2] - velocity[1]
        out = np.where(
            before * after >= 0.0,
            np.minimum(np.abs(before) * s, np.abs(after) * left),
            _to_and_fro(np.abs(before), np.abs(after), s, left),
        )
    lengths = np.linalg.norm(out, axis=1)
    return np.asarray(lengths[np.isfinite(lengths)])


def _to_and_fro(before: Array, after: Array, s: float, left: float) -> Array:
    """Return how far coordinates can be from the line, of changes of velocity (m, 3) m/s in opposite directions before
    and after it, ``s`` s after its beginning and with so many ``left``."""
    most = QUICK * np.minimum(before, after)
    before, after = np.minimum(before, most), np.minimum(after, most)
    return np.maximum(before * min(s, QUICK * left), after * min(left, QUICK * s))


def _rows(prediction: PredictedMarkers, ids: Ids) -> Array:
    order = np.argsort(prediction.ids)
    return prediction.points[order[np.searchsorted(prediction.ids, ids, sorter=order)]]
