"""Walks to one moment: do they end in one equilibrium?

A body may have several equilibria under a probe (on elements much larger than the probe's edges it has), and which one
a walk ends in then depends on its steps. The one that is meant is that of a path in steps that are short enough: two
walks must end there, the one in shorter steps than the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array

SAME_PLACE, SAME_REPORT = 5e-5, 0.01  # m, and share of what items report (N), where two walks end in one equilibrium


class SeveralEquilibria(ConvergenceError):
    """Walks to one moment ended in different equilibria."""


class End(NamedTuple):
    """The end of a walk: displacements (n, 3) m, and what the items ``report`` of them (k,) N, which is known to
    ``within`` N."""

    u: Array
    report: Array
    within: float

    def is_like(self, other: End) -> bool:
        """Tell whether two walks ended in the same equilibrium."""
        place, force = self._differences(other)
        return place <= SAME_PLACE and force <= max(SAME_REPORT * self._size, self.within, other.within)

    def apart(self, other: End) -> str:
        """Say how far apart they ended."""
        place, force = self._differences(other)
        return f"{1e3 * place:.2f} mm and {100.0 * force / max(self._size, 1e-300):.1f} % of the force apart"

    @property
    def _size(self) -> float:
        return float(np.linalg.norm(self.report))

    def _differences(self, other: End) -> tuple[float, float]:
        place = float(np.linalg.norm(self.u - other.u, axis=1).max())
        return place, float(np.linalg.norm(self.report - other.report))


def agree(ends: Sequence[End]) -> bool:
    """Return whether the last two walks ended alike."""
    return len(ends) > 1 and ends[-1].is_like(ends[-2])


def several(ends: Sequence[End]) -> SeveralEquilibria:
    """Return the error that says that walks have found more than one equilibrium."""
    return SeveralEquilibria(
        f"more than one equilibrium: walks in steps of different lengths end {ends[-1].apart(ends[-2])}",
        where="solver",
        remedy="move the probe in smaller steps, or refine the mesh under its edges",
    )
