"""Counts of messages by topic: sent, received, handled, and lost on the way."""

from __future__ import annotations

from collections import Counter


class Traffic:
    """Counts the messages that passed through one node.

    A publisher numbers its messages from 1 (DDS sequence numbers); a gap in the numbers is a loss. A number that goes
    back is a new publisher. What was published before the first message that arrived is counted as ``before``: the node
    was not there yet, or lost it.
    """

    def __init__(self) -> None:
        self.sent: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self.handled: Counter[str] = Counter()
        self.lost: Counter[str] = Counter()
        self.before: Counter[str] = Counter()
        self._last: dict[str, int] = {}

    @property
    def n_handled(self) -> int:
        """Count the messages that were handled, of all topics; also while another thread handles more."""
        return sum(list(self.handled.values()))

    def receive(self, topic: str, number: int | None) -> None:
        """Count a message with its publication number (None where the middleware gives none)."""
        self.received[topic] += 1
        self._count_gap(topic, number)

    def pass_over(self, topic: str, number: int | None) -> None:
        """Count a message as lost that has arrived, and is not worked on any more."""
        self.lost[topic] += 1
        self._count_gap(topic, number)

    def _count_gap(self, topic: str, number: int | None) -> None:
        if number is None:
            return
        last = self._last.get(topic, number)
        if number > last:
            self.lost[topic] += number - last - 1
        if topic not in self._last or number < last:
            self.before[topic] += number - 1
        self._last[topic] = number
