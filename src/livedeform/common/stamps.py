"""Stamps that cannot be right: from another year, far from the message's receive time, or out of line with their
neighbours. One bad stamp costs one message."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum, auto
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import RecordingError

NS = 1_000_000_000
MOST_SECONDS = 2**31  # a builtin_interfaces/Time has an int32
APART_NS = 3600 * NS  # after so long, what is alone has a wrong stamp, and what are several may have
PAUSE_NS = 7 * 24 * 3600 * NS  # nobody lets a recording wait for longer than that: before it, no clock was set
RARE = 0.1  # share of the stamps: what is more than that is no exception
STRETCH = 3  # so many messages in a row are no single fault of a stamp
OFFSET_NS = NS  # by which receive time minus stamp may jump, and
MANY = 10.0  # times as much as it usually changes from one message to the next
GATE_NS = 60 * NS  # a jump that long, live, waits for the next stamp
SLOWER = 2  # times the interval before: a stream that slow becomes slower
JUMP_NS = NS // 2  # a stamp so far from the one before is looked at again when the next one comes

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

    Those that are few beyond a gap of `APART_NS`, save for several that a pause explains, and those whose distance
    from the receive time jumps by over `OFFSET_NS` from one message to the next and back.
    """
    stamps = np.asarray(stamps_ns, np.int64)
    offsets = np.asarray(received_ns, np.int64) - stamps
    bad = np.zeros(len(stamps), bool)
    if len(stamps) < 3:
        return bad
    cluster = _clusters(stamps, APART_NS)
    sizes = np.bincount(cluster)
    main = int(sizes.argmax())
    for k in np.flatnonzero(sizes <= max(1, RARE * len(stamps))):
        bad[cluster == k] = k != main and not _after_a_pause(stamps, offsets, cluster == k, cluster == main)
    kept = np.flatnonzero(~bad)
    if len(kept) >= 3:
        steps = np.diff(offsets[kept])
        there, back = steps[:-1], steps[1:]
        usual = max(OFFSET_NS, MANY * float(np.median(np.abs(steps))))
        jumps = (np.minimum(np.abs(there), np.abs(back)) > usual) & (there * np.sign(back) < 0)
        bad[kept[1:-1]] = jumps & (np.abs(there + back) < 0.5 * np.abs(there))
    return bad


def long_pauses(stamps_ns: Sequence[int]) -> int:
    """Return how many pauses of over `APART_NS` there are between stamps."""
    return int((np.diff(np.sort(np.asarray(stamps_ns, np.int64))) > APART_NS).sum())


def in_stretches(bad: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which (n,) of the ``bad`` (n,) are `STRETCH` or more in a row, in the order in which they came."""
    run = np.cumsum(np.diff(bad, prepend=False))
    return np.asarray(bad & (np.bincount(run, minlength=1)[run] >= STRETCH))


def _clusters(stamps: NDArray[np.int64], apart_ns: int) -> NDArray[np.int64]:
    """Return the number (n,) of each stamp's cluster: from one to the next there are more than ``apart_ns``."""
    order = np.argsort(stamps, kind="stable")
    out = np.empty(len(stamps), np.int64)
    out[order] = np.cumsum(np.diff(stamps[order], prepend=stamps[order[0]]) > apart_ns)
    return out


def _after_a_pause(
    stamps: NDArray[np.int64], offsets: NDArray[np.int64], few: NDArray[np.bool_], most: NDArray[np.bool_]
) -> bool:
    """Tell whether a pause lies between the ``few`` and ``most`` (n,) of the stamps: several messages that came as long
    after their stamps as the others, so that both clocks say it, and no longer away than a recording may wait."""
    together = _clusters(stamps, PAUSE_NS)
    alike = abs(float(np.median(offsets[few])) - float(np.median(offsets[most]))) < 0.5 * APART_NS
    return bool(few.sum() > 1 and alike and together[few][0] == together[most][0])


class StampKind(Enum):
    """Tells what a stamp is to those before it in its stream."""

    NEXT = auto()  # not earlier than the one before
    LATE = auto()  # earlier, and nothing shows yet that the clock was set
    UNMASKS = auto()  # it shows that the one before, which had jumped ahead, was wrong
    SET = auto()  # it shows that the clock was set back


class StampClock:
    """Follows the stamps of one stream, which grow, save for one that is wrong, and where the clock is set.

    A stamp that jumped ahead by more than ``ahead_ns`` was wrong if the next one is back in line. Stamps that went back
    by more than `JUMP_NS` are those of a clock that was set as soon as two follow each other, or, as a `StampGate` has
    asked that, if they went back by more than `GATE_NS`. ``last_ns`` is the last stamp that holds (None before any),
    ``jumped`` tells that it is one that the next may show to be wrong, and ``n_set`` how often the clock was set back.
    """

    def __init__(self, ahead_ns: int = JUMP_NS) -> None:
        self.last_ns: int | None = None
        self.jumped = False
        self.n_set = 0
        self._ahead_ns, self._before_ns = ahead_ns, 0
        self._back_ns: int | None = None  # the stamp before, where that went back

    def take(self, stamp_ns: int) -> StampKind:
        """Take the next stamp and tell what it is."""
        if self.last_ns is None or stamp_ns >= self.last_ns:
            return self._goes_on(stamp_ns, StampKind.NEXT)
        if self.jumped and self._before_ns <= stamp_ns:
            self.last_ns = self._before_ns
            return self._goes_on(stamp_ns, StampKind.UNMASKS)
        by, follows = self.last_ns - stamp_ns, self._back_ns is not None and stamp_ns > self._back_ns
        if by > GATE_NS or (by > JUMP_NS and follows):
            self.n_set, self.last_ns = self.n_set + 1, None
            return self._goes_on(stamp_ns, StampKind.SET)
        self._back_ns = stamp_ns
        return StampKind.LATE

    def sure_of(self, stamp_ns: int) -> bool:
        """Tell whether what the stream says of a moment up to its last stamp stays: not of one before a stamp that
        jumped ahead, until the next one comes."""
        return not self.jumped or stamp_ns <= self._before_ns or stamp_ns == self.last_ns

    def _goes_on(self, stamp_ns: int, step: StampKind) -> StampKind:
        self.jumped = self.last_ns is not None and stamp_ns - self.last_ns > self._ahead_ns
        self._before_ns = stamp_ns if self.last_ns is None else self.last_ns
        self.last_ns, self._back_ns = stamp_ns, None
        return step


class StampOrder(Generic[Item]):
    """Gives the items of one stream for what cannot go back in time, and should not go ahead of it: a body that ages.

    An item whose stamp goes back is left out. One whose stamp jumped ahead by over `JUMP_NS` more than time passed
    until it came (told by when it was ``received_ns``, which a recording need not tell), and by more than a slow
    stream's interval, is held back until the next one shows which of them is wrong. ``refused`` counts what is left
    out.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._clock = StampClock()
        self._held: list[Item] = []  # one at most
        self._interval_ns = self._received_ns = 0

    def admit(self, stamp_ns: int, item: Item, received_ns: int | None = None) -> list[Item]:
        """Return the items that can be taken now, in the order of their stamps."""
        last_ns = self._clock.last_ns
        if self._held and stamp_ns == last_ns:  # the same again tells nothing
            self.refused += 1
            return []
        kind = self._clock.take(stamp_ns)
        if kind is StampKind.LATE:
            self.refused += 1
            return []
        step_ns = stamp_ns - last_ns if last_ns is not None and kind is StampKind.NEXT else 0
        passed_ns = step_ns if received_ns is None else received_ns - self._received_ns
        ahead = step_ns - passed_ns > JUMP_NS and step_ns > SLOWER * self._interval_ns
        self._interval_ns, self._received_ns = step_ns, received_ns or 0
        held, self._held = self._held, [item] if ahead else []
        self.refused += 0 if kind is StampKind.NEXT else len(held)
        return [*(held if kind is StampKind.NEXT else []), *([] if ahead else [item])]

    def end(self) -> list[Item]:
        """Return what is held back, as nothing comes any more that could show it to be wrong."""
        held, self._held = self._held, []
        return held


class StampGate(Generic[Item]):
    """Lets messages of a live stream through as they come, save those whose stamp is far from the others.

    A stamp that jumps by more than `GATE_NS`, and by more than a slow stream's interval, is held back until the next
    one tells: if that follows the jump, the clock was set, and both pass; else the held message is dropped. ``refused``
    counts those.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._last: int | None = None
        self._interval = 0
        self._held: tuple[int, Item] | None = None

    def admit(self, stamp_ns: int, item: Item) -> list[Item]:
        """The messages that pass now, in the order in which they came."""
        step = 0 if self._last is None else stamp_ns - self._last
        if -GATE_NS <= step <= max(GATE_NS, SLOWER * self._interval):
            self.refused += self._held is not None
            return self._passed(stamp_ns, step, [item])
        if self._held is not None:
            held_ns, held = self._held
            jump, step = held_ns - (self._last or 0), stamp_ns - held_ns
            if 0 < step <= max(GATE_NS, -jump, SLOWER * jump):
                return self._passed(stamp_ns, step, [held, item])
            self.refused += 1
        self._held = stamp_ns, item
        return []

    def end(self) -> list[Item]:
        """Return the message that is held back, as nothing comes any more that could show its stamp to be wrong."""
        held, self._held = self._held, None
        return [] if held is None else [held[1]]

    def _passed(self, stamp_ns: int, interval: int, items: list[Item]) -> list[Item]:
        self._last, self._interval, self._held = stamp_ns, interval, None
        return items


class SetBacks:
    """Counts in ``n`` how often the clock of a stream was set back, as `StampClock` tells behind a `StampGate`: one
    wrong stamp is not a clock that was set."""

    def __init__(self) -> None:
        self._gate, self._clock = StampGate[int](), StampClock()

    @property
    def n(self) -> int:
        return self._clock.n_set

    def take(self, stamp_ns: int) -> None:
        """Take the next stamp, in the order in which they came."""
        for admitted in self._gate.admit(stamp_ns, stamp_ns):
            self._clock.take(admitted)


def times_set_back(stamps_ns: Sequence[int]) -> int:
    """Return how often a clock was set back between stamps in the order in which they came; repeats do not count."""
    found = SetBacks()
    for stamp_ns in dict.fromkeys(stamps_ns):
        found.take(stamp_ns)
    return found.n
