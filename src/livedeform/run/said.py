"""Gather what the stereo node said of its own measurement, from a run's recording: whichever process it ran in."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.types import decode
from livedeform.common.checks.finding import Finding
from livedeform.common.errors import RecordingError

OK = 0  # diagnostic_msgs/DiagnosticStatus
FRAMES = (t.STEREO_STATUS, t.STEREO_MARKERS)  # their numbers; without pictures only troubles have a status
MOST = 5  # kinds that are written down
SHARE, HALF = 0.1, 0.5  # of the frames: beyond it what is said is a doubt; where the probe hides markers


@dataclass
class Said:
    """``n`` frames and other things that something can be said of; how many ``times`` each kind of warning or error was
    said, and its last ``text``. Texts that differ in their numbers alone are of one kind. ``few``: the kind that says
    only how few markers were found."""

    n: int = 0
    times: Counter[str] = field(default_factory=Counter)
    text: dict[str, str] = field(default_factory=dict)
    few: set[str] = field(default_factory=set)

    def add(self, status: Any) -> None:
        """Take one diagnostic_msgs/DiagnosticStatus."""
        if status.level in (OK, bytes([OK])):
            return
        kind = "".join(c for c in status.message if not c.isdigit())
        self.times[kind] += 1
        self.text[kind] = status.message
        values = {pair.key: pair.value for pair in status.values}
        if status.message == f"{values.get('n_identified')} of {values.get('n_markers')} markers":
            self.few.add(kind)

    @property
    def reasons(self) -> dict[str, int]:
        """Return how often the most frequent kinds were said, by their last texts."""
        return {self.text[kind]: n for kind, n in self.times.most_common(MOST)}

    @property
    def findings(self) -> list[Finding]:
        """Doubt what was measured where that was said of more than a tenth of it, whatever the errors are; that markers
        are few, as where the probe hides them, of more than half."""
        wrong = Counter({kind: n for kind, n in self.times.items() if kind not in self.few})
        few = [kind for kind in self.few if self.times[kind] > HALF * self.n]
        often = [kind for kind, n in wrong.items() if n > SHARE * self.n]
        said = [
            self._said(kind, self.times[kind]) for kind in sorted([*often, *few], key=lambda kind: -self.times[kind])
        ]
        if not often and wrong.total() > SHARE * self.n:
            most, n = wrong.most_common(1)[0]
            said.append(
                self._said(most, min(wrong.total(), self.n), f"{len(wrong)} kinds of faults, most often ({n}): ")
            )
        return [Finding("WARN", text, doubts=True) for text in said]

    def _said(self, kind: str, n: int, about: str = "") -> str:
        return f"stereo_node says of {n} of {self.n} frames: {about}{self.text[kind]}"


def stereo_said(bag_path: Path) -> Said:
    """Read every ``/stereo/status`` of a run's recording; one that is damaged says nothing."""
    said = Said()
    with read_bag(bag_path) as bag:
        said.n = max((bag.topics[name].count for name in FRAMES if name in bag.topics), default=0)
        for raw in bag.messages([t.STEREO_STATUS]) if t.STEREO_STATUS in bag.topics else ():
            try:
                statuses = decode(raw).status
            except RecordingError:
                continue
            for status in statuses:
                said.add(status)
    return said
