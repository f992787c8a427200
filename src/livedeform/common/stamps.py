"""Stamps that cannot be right: from another year, far from the message's receive time, or out of line with their
neighbours. One bad stamp costs one message."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import RecordingError

NS = 1_000_000_000
MOST_SECONDS = 2**31  # a builtin_interfaces/Time has an int32
APART_NS = 3600 * NS  # a pause that long within one recording is another recording, or a wrong clock
RARE = 0.1  # share of the stamps: what is more than that is no exception
OFFSET_NS = NS  # by which receive time minus stamp may jump, and
MANY = 10.0  # times as much as it usually changes from one message to the next
GATE_NS = 60 * NS  # a jump that long, live, waits for the next stamp

Item = TypeVar("Item")


def read_stamp(stamp: Any) -> int:
    """Return the nanoseconds of a builtin_interfaces/Time; ``RecordingError`` for one that no clock shows."""
    if not 0 <= stamp.nanosec < NS:
        raise RecordingError(
            f"a stamp has {stamp.nanosec} ns beside its seconds", remedy="set header.stamp as ROS does"
        )
    if not -MOST_SECONDS <= stamp.sec < MOST_SECONDS:
        raise RecordingError(f"a stamp has {stamp.sec} s", remedy="set header.stamp as ROS does")
    return int(stamp.sec) * NS + int(stamp.nanosec)


def bad_stamps(stamps_ns: Sequence[int], received_ns: Sequence[int]) -> NDArray[np.bool_]:
    """Return which (n,) of a topic's stamps cannot be right, looking back on a whole recording.

    Those beyond a pause of `APART_NS` with few of the stamps, and those whose distance from the receive time jumps by
    over `OFFSET_NS` from one message to the next and back.
    """
    stamps = np.asarray(stamps_ns, np.int64)
    offsets = np.asarray(received_ns, np.int64) - stamps
    bad = np.zeros(len(stamps), bool)
    if len(stamps) < 3:
        return bad
    order = np.argsort(stamps, kind="stable")
    cluster = np.empty(len(stamps), int)
    cluster[order] = np.cumsum(np.diff(stamps[order], prepend=stamps[order[0]]) > APART_NS)
    sizes = np.bincount(cluster)
    bad |= (sizes[cluster] <= max(1, RARE * len(stamps))) & (cluster != sizes.argmax())
    kept = np.flatnonzero(~bad)
    if len(kept) >= 3:
        steps = np.diff(offsets[kept])
        there, back = steps[:-1], steps[1:]
        usual = max(OFFSET_NS, MANY * float(np.median(np.abs(steps))))
        jumps = (np.minimum(np.abs(there), np.abs(back)) > usual) & (there * np.sign(back) < 0)
        bad[kept[1:-1]] = jumps & (np.abs(there + back) < 0.5 * np.abs(there))
    return bad


class StampGate(Generic[Item]):
    """Lets messages of a live stream through as they come, save those whose stamp is far from the others.

    A stamp that jumps by more than `GATE_NS` is held back until the next one tells: if that follows the jump, the clock
    was set, and both pass; else the held message is dropped. ``refused`` counts those.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._last: int | None = None
        self._held: tuple[int, Item] | None = None

    def admit(self, stamp_ns: int, item: Item) -> list[Item]:
        """The messages that pass now, in the order in which they came."""
        if self._last is None or abs(stamp_ns - self._last) <= GATE_NS:
            self.refused += self._held is not None
            self._last, self._held = stamp_ns, None
            return [item]
        if self._held is not None:
            held_ns, held = self._held
            if 0 < stamp_ns - held_ns <= max(GATE_NS, abs(held_ns - self._last)):
                self._last, self._held = stamp_ns, None
                return [held, item]
            self.refused += 1
        self._held = stamp_ns, item
        return []
