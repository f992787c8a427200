"""Where a body will be at the next pose of the probe: on the line through its last two solutions.

A solution is the better a start the nearer it is. Along a probe's path the line through two solutions errs by the
square of the poses' distance, the last solution itself by the distance; contact pressures go on likewise. Only a start
is foretold: what it leads to is solved as exactly as from anywhere, and where it leads nowhere, the solver goes the
usual way.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.items.protocol import Moment

LEVER = 0.02  # m, about the size of a probe's face: what a turn counts
FURTHEST = 2.0  # times the last step
OFF_LINE = 0.5  # of the way: more than this beside the line, and the line says too little


class Foreseen(NamedTuple):
    """A start: unknowns ``x`` (n_dof,) and the contact's ``multiplier`` (q,) Pa."""

    x: Array
    multiplier: Array

    def put_right(self, expected: Foreseen | None, found: Foreseen | None) -> Foreseen:
        """With the error of what was ``expected`` a moment before, where ``found`` was found."""
        if expected is None or found is None:
            return self
        pressed = np.maximum(self.multiplier + found.multiplier - expected.multiplier, 0.0)
        multiplier = np.where(self.multiplier > 0.0, pressed, 0.0)
        return Foreseen(self.x + found.x - expected.x, multiplier)


class _Solved(NamedTuple):
    moment: Moment
    x: Array
    multiplier: Array


class Foresight:
    """Remembers the last two solutions with a probe."""

    def __init__(self) -> None:
        self._known: list[_Solved] = []

    def note(self, moment: Moment, x: Array, multiplier: Array) -> None:
        """A solution was accepted."""
        if moment.pose is None:
            self._known.clear()
        else:
            self._known = [*self._known[-1:], _Solved(moment, x, multiplier)]

    def back_to(self, x: Array) -> None:
        """The body was put back to the solution ``x``: unless that is the last one, nothing is known of its way."""
        if self._known and self._known[-1].x is not x:
            self._known.clear()

    def at(self, moment: Moment) -> Foreseen | None:
        """A start for ``moment``; None where the last two solutions do not lead there."""
        if len(self._known) < 2 or moment.pose is None:
            return None
        first, last = self._known
        if not (_same_loads(first.moment, last.moment) and _same_loads(last.moment, moment)):
            return None
        before, now, then = (_points(m) for m in (first.moment, last.moment, moment))
        step, way = now - before, then - now
        squared = float(step @ step)
        if squared == 0.0:
            return None
        f = float(way @ step) / squared
        if abs(f) > FURTHEST or np.linalg.norm(way - f * step) > OFF_LINE * np.linalg.norm(way):
            return None
        pressed = np.maximum(last.multiplier + f * (last.multiplier - first.multiplier), 0.0)
        return Foreseen(last.x + f * (last.x - first.x), np.where(last.multiplier > 0.0, pressed, 0.0))


def _points(moment: Moment) -> Array:
    """Points of the probe (12,) m that tell its place and its turn."""
    if moment.pose is None:
        return np.zeros(12)
    return np.concatenate([moment.pose[:3, 3], LEVER * moment.pose[:3, :3].ravel()])


def _same_loads(a: Moment, b: Moment) -> bool:
    return a.load == b.load and np.array_equal(a.gravity, b.gravity)
