"""Find a clock that was set or that drifts while it was recorded, by when messages came.

How long after their stamps messages come changes alike in all topics where the recorder's own clock was set, or where
a recording was played at another speed. Where it changes in one topic and not in another, these two have no common time
any more.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from livedeform.common import topics as t
from livedeform.common.bags.recording import Recording
from livedeform.common.checks.finding import Finding
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.surface import Surface
from livedeform.common.types import Array

OFFSET_DRIFT = 0.1  # s by which receive time minus stamp may change within a recording
PARTS = 10  # of the recording, of which each has its delay
LEAST = 3  # messages of a topic in a part
USUAL = 0.25  # quantile of a part's delays: more than half of its messages may be late
SHORTLY = 3  # parts in a row; what lasts for one of them was a queue that was full for a while, and no clock


def check_clocks(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Check whether messages of one topic come as long after their stamps as before, beside those of another."""
    arrivals = {name: np.array(each, np.int64) for name, each in recording.arrivals.items()}
    used = {name: rows for name, rows in arrivals.items() if name != t.PROBE_POSE or experiment.probe}
    if len(used) < 2:
        return []
    received = np.concatenate([rows[:, 1] for rows in used.values()])
    borders = np.linspace(received.min(), received.max(), PARTS + 1)
    courses = {name: _course(rows, borders) for name, rows in used.items()}
    found = [(_change(courses[a] - courses[b]), a, b) for a, b in combinations(courses, 2)]
    change, a, b = max(found)
    if change <= OFFSET_DRIFT:
        return []
    one, other = sorted((a, b), key=lambda name: -_change(courses[name]))
    text = (
        f"receive time minus stamp of {one} changes by {change:.3f} s beside that of {other}: a clock was set or drifts"
    )
    return [Finding("WARN", text, "record again, with clocks that are kept together and that nobody sets", doubts=True)]


def _course(rows: NDArray[np.int64], borders: Array) -> Array:
    """Return how long (p,) s after their stamps messages came in each part; NaN where there are too few."""
    part = (np.searchsorted(borders, rows[:, 1], side="right") - 1).clip(0, len(borders) - 2)
    delays = 1e-9 * (rows[:, 1] - rows[:, 0])
    each = [delays[part == k] for k in range(len(borders) - 1)]
    return np.array([np.quantile(d, USUAL) if len(d) >= LEAST else np.nan for d in each])


def _change(course: Array) -> float:
    """Return by how much (s) a course changes for longer than shortly."""
    told = course[np.isfinite(course)]
    if not len(told):
        return 0.0
    return float(np.ptp(median_filter(told, SHORTLY, mode="nearest") if len(told) >= SHORTLY else told))
