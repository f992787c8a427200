"""Numbers and names as text on a page."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np

from livedeform.compare_node.metrics import Statistic

MM = 1e3
MOST_DIGITS = 15  # of a number: a float has no more
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


def decimals(*values: float, least: int = 2, most: int = 6) -> int:
    """Return how many decimals (mm) lengths in m need, so that the smallest but zero has two significant ones."""
    sizes = [abs(v) * MM for v in values if np.isfinite(v) and v != 0.0]
    return int(np.clip(1 - np.floor(np.log10(min(sizes))), least, most)) if sizes else least


def significant(size: float, width: float, least: int) -> int:
    """Return how many significant digits numbers up to ``size`` need, so that what is ``width`` has two of them."""
    if not 0.0 < width < np.inf or not 0.0 < size < np.inf:
        return least
    return int(np.clip(2 + np.ceil(np.log10(size / width)), least, MOST_DIGITS))


def words(name: str) -> str:
    """An effect's name as it reads in a sentence."""
    return name.replace("_", " ")


def date(stamp_ns: int) -> str:
    """The day and minute of a stamp as the beginning of a sentence; empty where the clock was not set."""
    if stamp_ns < EARLIEST_NS:
        return ""
    return datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC).strftime("recorded %Y-%m-%d %H:%M UTC; ")
