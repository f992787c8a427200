"""Find a clock that was set or that drifts while it was recorded, by when messages came.

How long after their stamps messages come changes alike in all topics where the recorder's own clock was set, or where
a recording was played at another speed. Where it changes in one topic and not in another, these two have no common time
any more, unless messages took longer to come. The messages' intervals tell which: where a clock was set the stamps are
uneven while messages come evenly, and where they took longer it is the other way round. Of pictures only some are read
(`common.bags.recording.spread`), whose intervals tell nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from livedeform.common import topics as t
from livedeform.common.bags.recording import PICTURES, Recording
from livedeform.common.checks.finding import Finding
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.surface import Surface
from livedeform.common.types import Array

OFFSET_DRIFT = 0.1  # s by which receive time minus stamp may change within a recording
PARTS = 10  # of the time, at most, of which each has its delay
LEAST = 3  # messages of a topic in a part
FASTEST, USUAL = 0.0, 0.5  # quantiles of a part's delays: a clock shifts both, a queue or a slow frame only the second
ENOUGH = 20_000  # messages of a topic, spread evenly: those of half an hour at 1 kHz tell no more
HALF = 0.5  # of the leap of a stamp: by less than that its message came early or late
MOST = 0.9  # of a topic's intervals: where so many are even, it is told which of them are not
REMEDY = "record again, with clocks that are kept together and that nobody sets"
SHORTLY = 3  # parts in a row; what lasts for one of them was a queue that was full for a while, and no clock
OF_THE_PROBE = (t.PROBE_POSE, t.PROBE_WRENCH)

Rows = NDArray[np.int64]  # (n, 2) ns: stamps and receive times of a topic


def check_clocks(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Check whether messages of one topic come as long after their stamps as before, beside those of another, where
    there is one."""
    arrivals = {
        name: np.array(each[:: -(-len(each) // ENOUGH) or 1], np.int64) for name, each in recording.arrivals.items()
    }
    used = {name: rows for name, rows in arrivals.items() if experiment.probe or name not in OF_THE_PROBE}
    found = _together({name: rows for name, rows in used.items() if name != t.PROBE_WRENCH})
    if t.PROBE_WRENCH not in used or any(finding.doubts for finding in found):
        return found
    return [replace(finding, of_forces=True) for finding in _together(used)] or found


def _together(used: Mapping[str, Rows]) -> list[Finding]:
    """Check topics beside each other, or one that is alone."""
    if len(used) < 2:
        return [finding for name, rows in used.items() for finding in _alone(name, rows)]
    even = {name: rows if name in PICTURES else _in_time(rows) for name, rows in used.items()}
    found = [
        (min(_change(used[a], used[b]), _change(even[a], even[b])), len(used) - k, a, b)
        for k, (a, b) in enumerate(combinations(used, 2))
    ]
    change, _, a, b = max(found)
    if change <= OFFSET_DRIFT:  # all shift alike, or none
        return [finding for name, rows in used.items() for finding in _alone(name, rows) if finding.doubts][:1]
    one, other = sorted((a, b), key=lambda name: -_change(used[name]))
    told = any(name not in PICTURES and _leaps(used[name])[0].any() for name in (a, b))
    text = f"receive time minus stamp of {one} changes by {change:.3f} s beside that of {other}: "
    text += "a clock was set or drifts" + ("" if told else ", or messages took longer to come")
    return [Finding("WARN", text, REMEDY, doubts=True)]


def _alone(name: str, rows: Rows) -> list[Finding]:
    """Check a topic beside which nothing tells whose clock it was: where stamps leap while messages come evenly, it was
    that of the stamps."""
    change = _change(rows)
    if change <= OFFSET_DRIFT:
        return []
    text = f"receive time minus stamp of {name} changes by {change:.3f} s"
    leaps = _leaps(rows)[0]
    if name in PICTURES or not leaps.any():
        return [Finding("WARN", f"{text}, and nothing beside it tells whether a clock was set or drifts")]
    at = 1e-9 * (rows[int(np.argmax(leaps)), 0] - rows[0, 0])
    return [Finding("WARN", f"{text}: its clock was set (after {at:.3g} s)", REMEDY, doubts=True)]


def _leaps(rows: Rows) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Tell of each interval (n - 1,) whether the stamp leaps while the message comes evenly, and whether it comes early
    or late, for long, while the stamps are even: such are none where stamps are uneven anyway."""
    steps = 1e-9 * np.diff(rows, axis=0)
    if not len(steps):
        return np.zeros(0, bool), np.zeros(0, bool)
    stamps, received = np.abs(steps - np.median(steps, axis=0)).T
    apart = np.abs(steps[:, 0] - steps[:, 1]) > OFFSET_DRIFT
    steady = np.quantile(stamps, MOST) < HALF * OFFSET_DRIFT
    return apart & (received < HALF * stamps), apart & (stamps < HALF * received) & steady


def _in_time(rows: Rows) -> Rows:
    """Return stamps and receive times as if no message had come late for long, or early after that."""
    late = _leaps(rows)[1]
    steps = np.diff(rows, axis=0)
    out = rows.copy()
    out[1:, 1] -= np.cumsum(np.where(late, steps[:, 1] - steps[:, 0], 0))
    return out


def _change(one: Rows, other: Rows | None = None) -> float:
    """Return by how much (s) the delay of a topic changes for longer than shortly, beside that of another where one is
    given: the lesser of the changes of the fastest and of the usual messages, in so many parts of the time as the
    slower topic has messages for; 0 where these are too few."""
    topics = [one] if other is None else [one, other]
    received = np.concatenate([rows[:, 1] for rows in topics])
    n_parts = min(PARTS, min(map(len, topics)) // (LEAST + 1))  # one more, lest a part of even messages has too few
    borders = np.linspace(received.min(), received.max(), max(n_parts, 1) + 1)
    courses = [_course(rows, borders) for rows in topics]
    course = courses[0] if other is None else courses[0] - courses[1]
    told = course[:, np.isfinite(course).all(axis=0)]
    if told.shape[1] < SHORTLY:
        return 0.0
    return float(np.ptp(median_filter(told, (1, SHORTLY), mode="nearest"), axis=1).min())


def _course(rows: Rows, borders: Array) -> Array:
    """Return how long (2, p) s after their stamps the fastest and the usual messages came in each part; NaN where there
    are too few."""
    part = (np.searchsorted(borders, rows[:, 1], side="right") - 1).clip(0, len(borders) - 2)
    delays = 1e-9 * (rows[:, 1] - rows[:, 0])
    each = [delays[part == k] for k in range(len(borders) - 1)]
    return np.array([np.quantile(d, [FASTEST, USUAL]) if len(d) >= LEAST else [np.nan] * 2 for d in each]).T
