"""Report the progress of the closed loop while it works."""

from __future__ import annotations

from collections.abc import Callable

Tell = Callable[[str, float | None], None]  # a text, and the fraction that is done if known


def silent(text: str, fraction: float | None = None) -> None:
    """Show no progress."""
