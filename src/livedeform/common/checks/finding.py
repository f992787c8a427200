"""One line about what is odd or wrong in an input."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from livedeform.common.errors import RecordingError

Severity = Literal["ERROR", "WARN", "NOTE"]


@dataclass(frozen=True)
class Finding:
    """``level`` ERROR: nothing can be concluded from it; WARN: it may be wrong; NOTE: worth knowing. ``remedy`` says
    what to do. A finding that ``doubts`` keeps a verdict from being sure: one ``of_forces``, which a diagnosis fits and
    no number of a run reads, only that of a diagnosis; one that is ``mended`` there, only that of a run."""

    level: Severity
    text: str
    remedy: str = ""
    doubts: bool = False
    of_forces: bool = False
    mended: bool = False


def refuse_errors(findings: Iterable[Finding], where: str) -> None:
    """Raises ``RecordingError`` for the first finding that is an error."""
    for finding in findings:
        if finding.level == "ERROR":
            raise RecordingError(finding.text, where=where, remedy=finding.remedy or "look at it with livedeform info")
