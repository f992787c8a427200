"""Find markers that exchange their ids, as trackers do where markers cross or are hidden for a while.

One marker appears where another was and that one where the first was, each by a step that its own motion does not
make. A body that moves as a whole carries a marker to another's place as well, but not that one back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from livedeform.common.checks.finding import Finding
from livedeform.common.types import Array, MarkerFrame

WITHIN_NS = 10_000_000_000  # the two may be hidden for so long, and come back one after the other
OWN_STEPS = 6.0  # usual steps of a marker, beyond which one is no motion of its own
NEAR = 0.5  # of the way to the nearest neighbour, within which a marker comes to where another was
NAMED = 4  # exchanges that a sentence names


@dataclass(frozen=True)
class Exchange:
    """Markers ``ids`` have each other's id from ``stamp_ns`` on, or their own again."""

    ids: tuple[int, int]
    stamp_ns: int


@dataclass(frozen=True)
class _Step:
    """The marker ``id`` was last seen at ``left`` (3,) m at ``left_ns`` and is at ``reached`` (3,) m at ``reached_ns``;
    the next marker is usually ``spacing`` m away."""

    id: int
    left_ns: int
    reached_ns: int
    left: Array
    reached: Array
    spacing: float


def exchanges_in(frames: Sequence[MarkerFrame]) -> list[Exchange]:
    """Return the exchanges of ids in ``frames``, in the order of time."""
    steps = sorted(_unusual_steps(frames), key=lambda s: s.reached_ns)
    if not steps:
        return []
    left, reached = (np.array([getattr(s, name) for s in steps]) for name in ("left", "reached"))
    near = np.sqrt(2.0) * NEAR * np.array([s.spacing for s in steps])  # of both ends together
    other_way = cKDTree(np.hstack([left, reached])).query_ball_point(np.hstack([reached, left]), near)
    out = []
    for n, others in enumerate(other_way):
        for other in (steps[k] for k in sorted(others) if k > n):
            if _exchange(steps[n], other):
                ids = sorted((steps[n].id, other.id))
                out.append(Exchange((ids[0], ids[1]), other.reached_ns))
    return sorted(out, key=lambda e: e.stamp_ns)


def check_exchanged(frames: Sequence[MarkerFrame], start_ns: int) -> list[Finding]:
    """Say which markers exchange their ids, and when."""
    found = exchanges_in(frames)
    if not found:
        return []
    at: dict[tuple[int, int], list[str]] = {}
    for exchange in found:
        at.setdefault(exchange.ids, []).append(f"{1e-9 * (exchange.stamp_ns - start_ns):.2f}")
    said = [f"{i} and {j} at {', '.join(times[:NAMED])} s" for (i, j), times in list(at.items())[:NAMED]]
    more = f" and {len(at) - NAMED} more pairs" if len(at) > NAMED else ""
    text = f"markers exchange their ids: {'; '.join(said)}{more}"
    return [Finding("WARN", text, "correct the tracker's labels, or leave these markers out", doubts=True, mended=True)]


def _exchange(one: _Step, other: _Step) -> bool:
    """Tell whether each comes to where the other was, the ``other`` after the ``one`` or with it."""
    late = other.left_ns > one.reached_ns or other.reached_ns - one.reached_ns > WITHIN_NS
    if one.id == other.id or late:
        return False
    across = (np.linalg.norm(a.reached - b.left) for a, b in ((one, other), (other, one)))
    return bool(max(across) < NEAR * min(one.spacing, other.spacing))


def _unusual_steps(frames: Sequence[MarkerFrame]) -> list[_Step]:
    """Find the steps of each marker, from where it was seen last, that are much longer than it usually makes and than
    half the way to its nearest neighbour."""
    seen = [frame for frame in frames if len(frame.ids)]
    if len(seen) < 2:
        return []
    ids = np.concatenate([frame.ids for frame in seen]).astype(np.int64)
    points = np.concatenate([frame.points for frame in seen])
    stamps = np.repeat([frame.stamp_ns for frame in seen], [len(frame.ids) for frame in seen])
    numbers = np.unique(ids)
    rows = {int(i): np.flatnonzero(ids == i)[np.argsort(stamps[ids == i], kind="stable")] for i in numbers}
    usual = {i: np.median(points[r], axis=0) for i, r in rows.items()}
    nearest = dict.fromkeys(rows, np.inf)
    for i, j in combinations(rows, 2):
        apart = float(np.linalg.norm(usual[i] - usual[j]))
        nearest[i], nearest[j] = min(nearest[i], apart), min(nearest[j], apart)
    out = []
    for i, r in rows.items():
        length = np.linalg.norm(np.diff(points[r], axis=0), axis=1)
        if not len(length):
            continue
        for k in np.flatnonzero(length > max(OWN_STEPS * float(np.median(length)), NEAR * nearest[i])):
            a, b = r[k], r[k + 1]
            out.append(_Step(i, int(stamps[a]), int(stamps[b]), points[a], points[b], nearest[i]))
    return out
