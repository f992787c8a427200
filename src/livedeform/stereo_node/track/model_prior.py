"""Keep what the model last said about where the markers are, for pictures of about the same moment."""

from __future__ import annotations

from collections import deque

import numpy as np

from livedeform.common.types import Array, Ids, PredictedMarkers

KEPT = 50  # predictions


class ModelPrior:
    """Keeps the predictions of ``/fem/markers`` and gives the one that is nearest to a stamp."""

    def __init__(self, ids: Ids, most_apart_ns: int) -> None:
        """Take the ``ids`` (m,) of all markers and the time ``most_apart_ns`` between pictures and prediction."""
        self._row = {int(name): k for k, name in enumerate(ids)}
        self._most_apart_ns = most_apart_ns
        self._said: deque[tuple[int, Array]] = deque(maxlen=KEPT)

    def add(self, prediction: PredictedMarkers) -> None:
        """Take a prediction; markers that are not in it are unknown, and so are those that are not finite."""
        places = np.full((len(self._row), 3), np.nan)
        for name, point in zip(prediction.ids, prediction.points, strict=True):
            if int(name) in self._row and np.isfinite(point).all():
                places[self._row[int(name)]] = point
        self._said.append((prediction.stamp_ns, places))

    def at(self, stamp_ns: int) -> Array | None:
        """Return (m, 3) m in phantom, NaN where unknown; None without a prediction of about that moment."""
        if not self._said:
            return None
        nearest, places = min(self._said, key=lambda said: abs(said[0] - stamp_ns))
        return places if abs(nearest - stamp_ns) <= self._most_apart_ns else None
