"""Interpolate predictions to a measured stamp, and tell by how much that can be wrong.

Between two predictions at t0 <= t <= t1 a marker moves on the straight line

    x(t) = x0 + a (x1 - x0),   a = (t - t0) / (t1 - t0),

whose remainder is |x''| (t - t0)(t1 - t) / 2 with x'' somewhere in between (Newton's interpolation formula). One
neighbour gives a mean of x'' (the second divided difference), which says little of a marker that the probe has just
touched. Both do: a coordinate whose velocities v0, v1, v2 before, between and after change in one direction lies
between the line and the lines of its neighbours going on, so that it is off by no more than

    min(|v1 - v0| (t - t0), |v2 - v1| (t1 - t)).

Where they change to and fro, as of a marker that is still, moves and is still again, it may follow either line and then
change over: the larger distance counts, as long as the marker can still change over at five times its mean speed. Where
only one neighbour is known, its remainder is an estimate and no bound. A neighbour is at least half as far away as the
bracket is long: the velocity over a shorter time is mostly noise, which the bracket would make as many times larger as
it is longer.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from livedeform.common.types import Array, Ids, PredictedMarkers
from livedeform.compare_node.metrics import p95, rmse

__all__ = ["Interpolated", "InterpolationBound", "interpolate", "neighbour", "remainder"]

QUICK = 4.0  # of a marker's change of velocity: by how much it is faster at most, within a bracket, than on average
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
    return _largest((before, first, second, None), stamp_ns)


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
    """Say by how much (m) interpolation can have been wrong: ``largest`` in any frame, over the markers, and ``judged``
    in what is judged of all frames, their rmse and 95th percentile, the larger of the two; NaN where no frame was
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
        self._bounds = array("d")
        self._waiting: list[tuple[Bracket, int]] = []

    @property
    def found(self) -> Interpolated:
        """Return what is known of all frames so far."""
        bounds = np.array(self._bounds)
        if not np.isfinite(self.value):
            return Interpolated()
        return Interpolated(self.value, max(rmse(bounds), p95(bounds)))

    def add_exact(self) -> None:
        """Take a frame that has a prediction of its own."""
        self._bounds.append(0.0)

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
        bound = _largest((*bracket, after), stamp_ns)
        if np.isfinite(bound):
            self.value = float(np.fmax(self.value, bound))
            self._bounds.append(bound)


def _largest(
    four: tuple[PredictedMarkers | None, PredictedMarkers, PredictedMarkers, PredictedMarkers | None], stamp_ns: int
) -> float:
    """Return by how much the line between the second and third of ``four`` predictions can be wrong at a stamp (m),
    over the markers that are in all; NaN without a neighbour that converged."""
    known = [p if p is not None and p.converged else None for p in four]
    there = [p for p in known if p is not None]
    ids = there[0].ids
    for p in there[1:]:
        ids = np.intersect1d(ids, p.ids)
    if len(there) < 3 or len(ids) == 0:
        return float("nan")
    t = [(p.stamp_ns - four[1].stamp_ns) * 1e-9 for p in there]
    x = [_rows(p, ids) for p in there]
    velocity = [(x[k + 1] - x[k]) / (t[k + 1] - t[k]) for k in range(len(there) - 1)]
    s, left = (stamp_ns - four[1].stamp_ns) * 1e-9, (four[2].stamp_ns - stamp_ns) * 1e-9
    off = [np.abs(velocity[k + 1] - velocity[k]) / (t[k + 2] - t[k]) * s * left for k in range(len(velocity) - 1)]
    out = np.maximum(off[0], off[-1])
    if len(there) == 4:
        before, after = velocity[1] - velocity[0], velocity[2] - velocity[1]
        one_way = np.minimum(np.abs(before) * s, np.abs(after) * left)
        to_and_fro = np.maximum(np.abs(before) * min(s, QUICK * left), np.abs(after) * min(left, QUICK * s))
        out = np.where(before * after >= 0.0, one_way, to_and_fro)
    return float(np.nanmax(np.linalg.norm(out, axis=1)))


def _rows(prediction: PredictedMarkers, ids: Ids) -> Array:
    order = np.argsort(prediction.ids)
    return prediction.points[order[np.searchsorted(prediction.ids, ids, sorter=order)]]
