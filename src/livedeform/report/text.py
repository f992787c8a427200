"""Numbers and names as text on a page."""

from __future__ import annotations

import numpy as np

from livedeform.compare_node.metrics import Statistic

MM = 1e3


def mm(value: float, digits: int = 2) -> str:
    """A length in m as text in millimetres; a dash where there is none."""
    return f"{value * MM:.{digits}f}" if np.isfinite(value) else "–"


def interval(statistic: Statistic) -> str:
    """The 95 % interval of a length in millimetres."""
    if not np.isfinite(statistic.low):
        return "too few frames for an interval"
    return f"95 %: {mm(statistic.low)} to {mm(statistic.high)}"


def words(name: str) -> str:
    """An effect's name as it reads in a sentence."""
    return name.replace("_", " ")
