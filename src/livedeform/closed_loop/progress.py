"""Report the progress of the closed loop while it works, and keep it to its time."""

from __future__ import annotations

import time
from collections.abc import Callable

Tell = Callable[[str, float | None], None]  # a text, and the fraction that is done if known


def silent(text: str, fraction: float | None = None) -> None:
    """Show no progress."""


class TimeBudget:
    """Wall time that a diagnosis may take in ``seconds`` from now on; None: as much as it needs.

    What is begun is finished: a run of the model is not cut. What was ``left_out`` for want of time is noted.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self.seconds = seconds
        self.left_out: list[str] = []
        self._kept_for_later: set[str] = set()
        self._began = time.monotonic()

    def allows(self, what: str, share: float = 1.0) -> bool:
        """Return whether there is time for ``what`` within a ``share`` of all; if not it is noted as left out."""
        if self.seconds is None or time.monotonic() - self._began < share * self.seconds:
            return True
        if what not in self.left_out:
            self.left_out.append(what)
        if share < 1.0:
            self._kept_for_later.add(what)
        return False

    @property
    def notes(self) -> list[str]:
        """Return what to know of it, in at most a line."""
        if not self.left_out:
            return []
        in_part = self._kept_for_later.issuperset(self.left_out)
        state = "is kept in part for what comes last" if in_part else "was used up"
        return [f"the time budget of {self.seconds:g} s {state}; not done: {', '.join(self.left_out)}"]
