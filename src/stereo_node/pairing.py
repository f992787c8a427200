"""Left and right pictures of one moment: paired by stamp within a tolerance, everything else counted."""

from __future__ import annotations

from collections import deque

import numpy as np

from livedeform_common.types import Image


class PicturePairs:
    """Streams of left and right pictures in, pairs out, in the order of their stamps.

    Cameras without a common trigger differ by an offset that is constant or drifts slowly; ``offset`` (s, right -
    left) is its median over the last pairs. A picture whose partner is not within ``tolerance_ns`` is dropped and
    counted.
    """

    def __init__(self, tolerance_ns: int = 5_000_000, capacity: int = 100) -> None:
        self.tolerance_ns = tolerance_ns
        self._waiting: tuple[deque[Image], deque[Image]] = (deque(maxlen=capacity), deque(maxlen=capacity))
        self._offsets: deque[float] = deque(maxlen=100)
        self.n_pairs = self.n_unpaired = 0

    @property
    def offset(self) -> float:
        """Median of right - left stamp (s); NaN before the first pair."""
        return float(np.median(self._offsets)) if self._offsets else float("nan")

    def add_left(self, image: Image) -> list[tuple[Image, Image]]:
        """A left picture; returns the pairs that are now complete."""
        return self._add(0, image)

    def add_right(self, image: Image) -> list[tuple[Image, Image]]:
        """A right picture; returns the pairs that are now complete."""
        return self._add(1, image)

    def _add(self, side: int, image: Image) -> list[tuple[Image, Image]]:
        queue = self._waiting[side]
        if len(queue) == queue.maxlen:
            self.n_unpaired += 1  # the deque drops its oldest
        queue.append(image)
        left, right = self._waiting
        pairs = []
        while left and right:
            difference = right[0].stamp_ns - left[0].stamp_ns
            if abs(difference) <= self.tolerance_ns:
                pairs.append((left.popleft(), right.popleft()))
                self._offsets.append(difference * 1e-9)
                self.n_pairs += 1
            else:  # the older one has no partner: stamps of a camera only grow
                (right if difference < 0 else left).popleft()
                self.n_unpaired += 1
        return pairs
