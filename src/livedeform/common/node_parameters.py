"""Declare what a node's parameters may be: fields of a dataclass with the ends of their range. Needs no ROS."""

from __future__ import annotations

from dataclasses import field
from typing import Any

from livedeform.common.stamps import MOST_SECONDS, NS

LATEST_NS = MOST_SECONDS * NS - 1  # of a stamp


def within(default: Any, low: float, high: float) -> Any:
    """Return a field of a parameter dataclass whose values are from ``low`` to ``high``."""
    return field(default=default, metadata={"within": (low, high)})
