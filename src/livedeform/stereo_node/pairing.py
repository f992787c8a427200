"""Left and right pictures of one moment: paired by stamp within a tolerance, everything else counted."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from itertools import pairwise, zip_longest

import numpy as np

from livedeform.common.stamps import StampClock, StampKind
from livedeform.common.types import Image

__all__ = ["PicturePairs", "Pictures", "recorded_pairs"]

Pictures = list[tuple[Image, Image]]
"""Pairs of a left and a right picture."""

LATE = 5  # pictures of one camera without any of the other
SAY_EVERY_NS = 1_000_000_000
PERIOD_SHARE = 0.4  # of a camera's period, by which a pair may differ at most: from half on another picture is nearer
UNLIMITED = 10**6  # pictures that wait: what one camera recorded before the other


class PicturePairs:
    """Takes streams of left and right pictures and gives pairs, in the order of their stamps.

    Cameras without a common trigger differ by an offset that is constant or drifts slowly; ``offset`` (s, right -
    left) is its median over the last pictures, paired or not. A picture whose partner is not within ``tolerance_ns`` of
    ``expected_ns`` after it, or within `PERIOD_SHARE` of the shorter period of both cameras where that is less, is
    dropped and counted: so a picture never gets another moment's, whichever ones were lost.
    """

    def __init__(self, tolerance_ns: int = 5_000_000, capacity: int = 100, expected_ns: int = 0) -> None:
        self.tolerance_ns, self.expected_ns = tolerance_ns, expected_ns
        self._waiting: tuple[deque[Image], deque[Image]] = (deque(maxlen=capacity), deque(maxlen=capacity))
        self._clocks = StampClock(), StampClock()
        self._offsets: deque[float] = deque(maxlen=100)
        self._stamps: tuple[deque[int], deque[int]] = (deque(maxlen=50), deque(maxlen=50))
        self._alone = [0, 0]  # pictures of each camera since the other's last
        self._unpaired_in_a_row = 0
        self._said_ns = 0
        self._was_lone = False
        self.n_pairs = self.n_unpaired = 0

    @property
    def offset(self) -> float:
        """Median of right - left stamp (s); NaN before the first pair, or the first pictures of both cameras."""
        if self._offsets and self._unpaired_in_a_row < 2 * LATE:
            return float(np.median(self._offsets))
        left, right = (np.array(stamps) for stamps in self._stamps)
        if not len(left) or not len(right):
            return float("nan")
        apart = right[None] - left[:, None]
        return 1e-9 * float(np.median(np.take_along_axis(apart, np.abs(apart).argmin(axis=1)[:, None], axis=1)))

    @property
    def trouble(self) -> str:
        """One line about why no pairs come; empty while they do."""
        for side, other, n in (("left", "right", self._alone[0]), ("right", "left", self._alone[1])):
            if n >= LATE:
                return f"{n} {side} pictures came without a {other} one; check that the {other} camera publishes"
        if self._unpaired_in_a_row >= 2 * LATE:
            apart = f"{self.offset * 1e3:+.1f} ms apart and the tolerance is {self.tolerance_ns * 1e-6:g} ms"
            remedy = "trigger the cameras together, or set pair_offset (stamps that are off) or pair_tolerance (s)"
            if (limit := self._limit_ns()) is not None and limit < self.tolerance_ns:
                apart += f", or {limit * 1e-6:.2g} ms so soon after each other"
                remedy = "trigger the cameras together, or set pair_offset (s, stamps that are off)"
            return f"left and right stamps are {apart}; {remedy}"
        return ""

    def counts(self) -> dict[str, float]:
        """Return what became of the pictures, and how far (s) right ones are behind left ones, for the status."""
        return {"pairs": self.n_pairs, "unpaired": self.n_unpaired, "offset": self.offset}

    def news_of_trouble(self, stamp_ns: int) -> str:
        """Return the `trouble`, once a second (of stamps)."""
        trouble = self.trouble
        if not trouble or 0 <= stamp_ns - self._said_ns < SAY_EVERY_NS:
            return ""
        self._said_ns = stamp_ns
        return trouble

    def add_left(self, image: Image) -> Pictures:
        """Take a left picture and return the pairs that are now complete."""
        return self._add(0, image)

    def add_right(self, image: Image) -> Pictures:
        """Take a right picture and return the pairs that are now complete."""
        return self._add(1, image)

    def _add(self, side: int, image: Image) -> Pictures:
        queue = self._waiting[side]
        self._alone[side], self._alone[1 - side] = self._alone[side] + 1, 0
        self._stamps[side].append(image.stamp_ns)
        step = self._clocks[side].take(image.stamp_ns)
        if step is StampKind.LATE:
            self._unpaired(1)
            return []
        if step is StampKind.UNMASKS and queue and queue[-1].stamp_ns > image.stamp_ns:
            queue.pop()
            self._unpaired(1)
        elif step is StampKind.SET:
            self._forget(side)
        if len(queue) == queue.maxlen:
            self._drop(queue)
        queue.append(image)
        return self._complete()

    def flush(self) -> Pictures:
        """End the streams: return the pair that waited for the cameras' period to show."""
        return self._complete(ended=True)

    def lone(self) -> Pictures:
        """Return the first pair if it waited for the cameras' period at the last call, too: no other picture came."""
        waits = self._limit_ns() is None and all(self._waiting)
        pairs = self._complete(ended=True) if waits and self._was_lone else []
        self._was_lone = waits and not pairs
        return pairs

    def _complete(self, ended: bool = False) -> Pictures:
        left, right = self._waiting
        pairs = []
        while left and right:
            apart = right[0].stamp_ns - left[0].stamp_ns - self.expected_ns
            limit = self._limit_ns()
            if limit is None and 0 < abs(apart) <= self.tolerance_ns and not ended:
                break  # the next picture tells whether that may be another moment's
            if abs(apart) <= (self.tolerance_ns if limit is None else limit):
                pairs.append((left.popleft(), right.popleft()))
                self._offsets.append((apart + self.expected_ns) * 1e-9)
                self.n_pairs += 1
                self._unpaired_in_a_row = 0
                continue
            older, newer = (right, left) if apart < 0 else (left, right)
            if len(newer) == 1 and self._clocks[newer is right].jumped and not ended:
                break  # the next one tells whether its stamp is wrong
            self._drop(older)  # it has no partner: stamps of a camera only grow
        return pairs

    def _limit_ns(self) -> float | None:
        """Return by how much a pair's stamps may differ; None before a camera's second picture."""
        periods = []
        for stamps in self._stamps:
            if steps := sorted(b - a for a, b in pairwise(stamps) if b > a):
                periods.append(steps[len(steps) // 4])  # so many pictures may be lost: most steps may be longer
        return min(self.tolerance_ns, PERIOD_SHARE * min(periods)) if periods else None

    def _drop(self, queue: deque[Image]) -> None:
        queue.popleft()
        self._unpaired(1)

    def _forget(self, side: int) -> None:
        """Drop what waits by a clock that was set back, and, unless it was set before, by the other camera's."""
        own, other = self._clocks[side], self._clocks[1 - side]
        for queue in self._waiting if other.n_set < own.n_set else (self._waiting[side],):
            self._unpaired(len(queue))
            queue.clear()

    def _unpaired(self, n: int) -> None:
        self.n_unpaired += n
        self._unpaired_in_a_row += n


def recorded_pairs(left: Iterable[Image], right: Iterable[Image]) -> Iterator[tuple[Image, Image]]:
    """Pair the pictures of a recording, each side in the order of its stamps, as `PicturePairs` does."""
    pairing = PicturePairs(capacity=UNLIMITED)
    for a, b in zip_longest(left, right):
        if a is not None:
            yield from pairing.add_left(a)
        if b is not None:
            yield from pairing.add_right(b)
    yield from pairing.flush()
