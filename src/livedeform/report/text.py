"""Numbers and names as text on a page."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np

from livedeform.compare_node.metrics import Statistic

MM = 1e3
EARLIEST_NS = 10**17  # March 1973: a clock that shows less was never set


def mm(value: float, digits: int = 2) -> str:
    """A length in m as text in millimetres; a dash where there is none."""
    return f"{value * MM:.{digits}f}" if np.isfinite(value) else "–"


OF_THIS_RECORDING = "of this recording's mean; the next take differs by what is between takes as well"


WITH_PLACES = "; the stated uncertainty of the marker places is in it"


def interval(statistic: Statistic, digits: int = 2) -> str:
    """The 95 % interval of a length in millimetres: of this recording, see `OF_THIS_RECORDING`."""
    if not np.isfinite(statistic.low):
        return "too few frames for an interval"
    return f"95 % interval, this recording: {mm(statistic.low, digits)} to {mm(statistic.high, digits)}"


def less(share: float) -> str:
    """Return by how much an error has become less, or more, as text; a dash where that is not known."""
    if not np.isfinite(share):
        return "–"
    percent = f"{100.0 * abs(share):.{0 if abs(share) >= 0.0995 else 1}f} %"
    return f"{percent} {'more' if share < 0.0 else 'less'}"


def less_between(low: float, high: float) -> str:
    """Return from what to what an error has become less, as text."""
    ends = [less(low), less(high)]
    same = ends[0].split()[1:] == ends[1].split()[1:]
    return f"{ends[0].split()[0] if same else ends[0]} to {ends[1]}"


def words(name: str) -> str:
    """An effect's name as it reads in a sentence."""
    return name.replace("_", " ")


def date(stamp_ns: int) -> str:
    """The day and minute of a stamp as the beginning of a sentence; empty where the clock was not set."""
    if stamp_ns < EARLIEST_NS:
        return ""
    return datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC).strftime("recorded %Y-%m-%d %H:%M UTC; ")
