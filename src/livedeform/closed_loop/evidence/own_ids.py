"""Leave out markers while they have another's id."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from livedeform.closed_loop.evidence.track import Track
from livedeform.common.checks.exchanged import Exchange
from livedeform.common.types import Array


def with_own_ids(data: Track, exchanges: Sequence[Exchange], rest: Array) -> tuple[Track, list[str]]:
    """Leave out two markers where they have each other's id, and say so, a note each.

    Of the parts between ``exchanges`` these are the ones in which the two lie more like each other at ``rest`` (m, 3) m
    than in the others: a body may move further than its markers are apart.
    """
    points, notes = data.points.copy(), []
    column = {int(i): n for n, i in enumerate(data.ids)}
    for pair in sorted({e.ids for e in exchanges if column.keys() >= set(e.ids)}):
        at = np.sort([e.stamp_ns for e in exchanges if e.ids == pair])
        odd = np.searchsorted(at, data.stamps_ns, side="right") % 2 == 1
        i, j = (column[n] for n in pair)
        likeness = _apart(data.points[:, [i, j]], rest[[i, j]]) - _apart(data.points[:, [i, j]], rest[[j, i]])
        wrong = odd if _mean(likeness[odd]) > _mean(likeness[~odd]) else ~odd
        points[np.ix_(wrong, [i, j])] = np.nan
        share = f"{100.0 * wrong.mean():.0f} % of the frames"
        notes.append(f"markers {pair[0]} and {pair[1]} have each other's id in {share}, and are left out there")
    return replace(data, points=points), notes


def _apart(points: Array, places: Array) -> Array:
    """Return how far (f,) m the ``points`` (f, 2, 3) m are from ``places`` (2, 3) m, both together."""
    return np.asarray(np.linalg.norm(points - places, axis=2).sum(axis=1))


def _mean(x: Array) -> float:
    """Mean of what is known; minus infinity of nothing."""
    known = x[np.isfinite(x)]
    return float(known.mean()) if len(known) else -np.inf
