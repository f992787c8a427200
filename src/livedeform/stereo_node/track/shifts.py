"""Tells whether points may be those of the markers' neighbours: a pattern that moved by its own spacing between two
pictures looks as before, but for its front, where points are left over, and its rear, where markers are missing.

Between front and rear there is then a chain: the point left over is a marker's whose place the pattern's next point
took, that point is the next marker's, and so on, to a marker that is missing. What is new on a probe lies in the hole
of the markers that it hides, and no chain of markers that are seen leads from there to a missing one.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.stereo_node.track.match import Pairs, assign
from livedeform.stereo_node.track.near import distances

Rows = NDArray[np.int64]


def shifted(position: Array, spacing: Array, row_of: Rows, free: Rows, pairs: Pairs, reach: float) -> Iterator[Rows]:
    """Yield other rows (m,) of ``pairs`` that markers may have instead of ``row_of`` (m,), -1 for none.

    ``position`` (m, 3) m: where the markers are expected, ``spacing`` (m,) m: to their neighbours; ``free`` (k,): rows
    of points that are left over; ``reach`` m: the farthest that a marker may be from where it is expected.
    """
    chains = _chains(position, spacing, row_of, free, pairs.points.points, reach)
    moves = np.array([pairs.points.points[rows[0]] - position[markers[0]] for markers, rows in chains]).reshape(-1, 3)
    alike = distances(moves, moves) < 0.5 * np.median(spacing)
    covered = np.zeros(len(chains), bool)
    for first in np.argsort(-alike.sum(axis=1), kind="stable"):
        if covered[first]:
            continue
        members = np.flatnonzero(alike[first])
        covered[members] = True
        nearest_first = members[np.argsort(np.linalg.norm(moves[members] - moves[first], axis=1))]
        yield _joined(row_of, [chains[k] for k in nearest_first], pairs)
        # where a marker is hidden, chains break off: the whole pattern may have moved all the same
        places, rows = position + np.median(moves[members], axis=0), np.concatenate([row_of[row_of >= 0], free])
        yield filled(np.full(len(row_of), -1), places, spacing, rows, pairs)


def filled(row_of: Rows, places: Array, spacing: Array, free: Rows, pairs: Pairs) -> Rows:
    """Return ``row_of`` (m,) in which markers without a point have that of the ``free`` (k,) rows of ``pairs`` which
    lies at their ``places`` (m, 3) m, within half the ``spacing`` (m,) m."""
    out, missing = row_of.copy(), np.flatnonzero(row_of < 0)
    off = distances(places[missing], pairs.points.points[free])
    markers, columns = assign(off / spacing[missing][:, None], 0.5)
    out[missing[markers]] = free[columns]
    return out


def _chains(
    position: Array, spacing: Array, row_of: Rows, free: Rows, points: Array, reach: float
) -> list[tuple[Rows, Rows]]:
    """Return the chains from ``free`` points to missing markers, over one marker at least that has a point: the
    markers (n,) and the rows (n,) that would be theirs."""
    starts, current = np.nonzero((distances(points[free], position) < reach) & (row_of >= 0))
    move = points[free[starts]] - position[current]
    markers, rows, out = current[:, None], free[starts][:, None], []
    while len(current):
        freed = row_of[current]
        off = distances(points[freed] - move, position)
        current = off.argmin(axis=1)
        going = (off.min(axis=1) < 0.5 * spacing[current]) & (markers != current[:, None]).all(axis=1)
        current, freed = current[going], freed[going]
        markers = np.hstack([markers[going], current[:, None]])
        rows = np.hstack([rows[going], freed[:, None]])
        ended = row_of[current] < 0
        out += list(zip(markers[ended], rows[ended], strict=True))
        move = (points[freed] - position[current])[~ended]
        markers, rows, current = markers[~ended], rows[~ended], current[~ended]
    return out


def _joined(row_of: Rows, chains: list[tuple[Rows, Rows]], pairs: Pairs) -> Rows:
    """Return ``row_of`` (m,) with the ``chains`` that share neither a marker nor a spot with one before them."""
    out, used = row_of.copy(), np.zeros(len(row_of), bool)
    left, right = set[int](), set[int]()
    for markers, rows in chains:
        spots = int(pairs.left[rows[0]]), int(pairs.right[rows[0]])
        if used[markers].any() or spots[0] in left or spots[1] in right:
            continue
        out[markers], used[markers] = rows, True
        left.add(spots[0])
        right.add(spots[1])
    return out
