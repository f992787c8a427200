"""Associate predictions with measurements: by marker id and stamp, predictions interpolated to that stamp.

Nothing is extrapolated, nothing is bridged over more than ``max_gap_ns``, a prediction that did not converge matches
nothing, and of markers with one id in a frame none is known: each refusal is counted.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass, field, replace
from itertools import chain, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from livedeform.common.stamps import StampClock, StampKind
from livedeform.common.types import Ids, MarkerFrame, PredictedMarkers
from livedeform.compare_node.interpolation import InterpolationBound, interpolate, neighbour, remainder
from livedeform.compare_node.residual import Residual

__all__ = ["Associator", "Counts", "interpolate", "remainder"]


@dataclass
class Counts:
    """Counts of what became of every frame and marker; frames are counted once, under the first reason that applies."""

    measured_frames: int = 0
    predicted_frames: int = 0
    predicted_not_converged: int = 0
    matched_frames: int = 0
    refused_extrapolation: int = 0
    refused_gap: int = 0
    refused_not_converged: int = 0
    refused_out_of_order: int = 0
    predicted_out_of_order: int = 0
    frames_without_common_marker: int = 0
    dropped_waiting: int = 0
    matched_markers: int = 0
    measured_twice: int = 0
    measured_without_prediction: int = 0
    predicted_without_measurement: int = 0
    unknown_ids: set[int] = field(default_factory=set)
    never_measured_ids: set[int] = field(default_factory=set)

    def with_jumps(self, n_frames: int, n_predictions: int) -> Counts:
        """Return the counts with frames and predictions that did not get here, since their stamp was far off."""
        return replace(
            self,
            measured_frames=self.measured_frames + n_frames,
            predicted_frames=self.predicted_frames + n_predictions,
            predicted_out_of_order=self.predicted_out_of_order + n_predictions,
            refused_out_of_order=self.refused_out_of_order + n_frames + n_predictions,
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, for files."""
        return asdict(self) | {
            "unknown_ids": sorted(self.unknown_ids),
            "never_measured_ids": sorted(self.never_measured_ids),
        }


class Associator:
    """Takes streams of measured and predicted markers and gives residuals, in the order of the measured stamps.

    Parameters
    ----------
    max_gap_ns : int
        The longest span between two predictions that is interpolated.
    capacity : int
        How many measured frames may wait for a prediction; the oldest is dropped, and counted, beyond that.
    """

    def __init__(self, max_gap_ns: int = 500_000_000, capacity: int = 100_000) -> None:
        self.max_gap_ns, self.capacity = max_gap_ns, capacity
        self.counts = Counts()
        self.interpolation_bound = InterpolationBound()
        self._waiting: deque[MarkerFrame] = deque()
        self._predictions: deque[PredictedMarkers] = deque()
        self._passed: deque[PredictedMarkers] = deque()  # predictions that no frame will lie between
        self._measured_clock, self._predicted_clock = StampClock(max_gap_ns), StampClock(max_gap_ns)
        self._seen_measured: set[int] = set()
        self._seen_predicted: set[int] = set()

    def add_measured(self, frame: MarkerFrame) -> list[Residual]:
        """Take a measured frame and return the residuals that can be told now."""
        self.counts.measured_frames += 1
        self._seen_measured.update(frame.ids.tolist())
        step = self._measured_clock.take(frame.stamp_ns)
        if step is StampKind.UNMASKS and self._waiting and self._waiting[-1].stamp_ns > frame.stamp_ns:
            self._waiting.pop()
            self.counts.refused_out_of_order += 1
        elif step is StampKind.SET:
            self._forget(True, self._predicted_clock.n_set < self._measured_clock.n_set)
        if self._waiting and frame.stamp_ns < self._waiting[-1].stamp_ns:
            self.counts.refused_out_of_order += 1
            return []
        self._waiting.append(frame)
        if len(self._waiting) > self.capacity:
            self._waiting.popleft()
            self.counts.dropped_waiting += 1
        return self._drain()

    def add_predicted(self, prediction: PredictedMarkers) -> list[Residual]:
        """Take a prediction and return the residuals that can be told now."""
        self.counts.predicted_frames += 1
        self.counts.predicted_not_converged += not prediction.converged
        self._seen_predicted.update(prediction.ids.tolist())
        step = self._predicted_clock.take(prediction.stamp_ns)
        if step is StampKind.UNMASKS and self._predictions and self._predictions[-1].stamp_ns > prediction.stamp_ns:
            self._predictions.pop()
            self._count_out_of_order(1)
        elif step is StampKind.SET:
            self._forget(self._measured_clock.n_set < self._predicted_clock.n_set, True)
        if self._predictions and prediction.stamp_ns <= self._predictions[-1].stamp_ns:
            self._count_out_of_order(1)
            return []
        self._predictions.append(prediction)
        self.interpolation_bound.settle(prediction)
        return self._drain()

    def _count_out_of_order(self, n_predictions: int) -> None:
        self.counts.predicted_out_of_order += n_predictions
        self.counts.refused_out_of_order += n_predictions

    def _forget(self, frames: bool, predictions: bool) -> None:
        """Forget what waits by clocks before they were set back: it cannot be matched with what comes now."""
        if frames:
            self.counts.refused_out_of_order += len(self._waiting)
            self._waiting.clear()
        if predictions:
            self._count_out_of_order(len(self._predictions))
            self._predictions.clear()
            self._passed.clear()
            self.interpolation_bound.settle(None)

    @property
    def n_decided(self) -> int:
        """Count the measured frames that were compared or refused: the others wait for a prediction."""
        return self.counts.measured_frames - len(self._waiting)

    def flush(self) -> list[Residual]:
        """End the streams: what still waits lies after the last prediction and would be extrapolated."""
        residuals = self._drain(ended=True)
        self.interpolation_bound.settle(None)
        self.counts.refused_extrapolation += len(self._waiting)
        self._waiting.clear()
        self.refresh_ids()
        return residuals

    def refresh_ids(self) -> None:
        """Bring ``unknown_ids`` and ``never_measured_ids`` up to date."""
        if self._seen_predicted:
            self.counts.unknown_ids = self._seen_measured - self._seen_predicted
        if self._seen_measured:
            self.counts.never_measured_ids = self._seen_predicted - self._seen_measured

    def _drain(self, ended: bool = False) -> list[Residual]:
        """Return the residuals of all waiting frames up to the last prediction's stamp."""
        residuals = []
        while self._waiting and self._predictions and self._waiting[0].stamp_ns <= self._predictions[-1].stamp_ns:
            if not ended and not self._predicted_clock.sure_of(self._waiting[0].stamp_ns):
                break
            frame = self._waiting.popleft()
            # keep those about the bracket, and aside what tells by how much interpolation can be wrong there
            while len(self._predictions) > 2 and self._predictions[2].stamp_ns < frame.stamp_ns:
                self._passed.append(self._predictions.popleft())
            while len(self._passed) > 1 and self._passed[1].stamp_ns < frame.stamp_ns - 2 * self.max_gap_ns:
                self._passed.popleft()
            residual = self._match(frame)
            if residual is not None:
                residuals.append(residual)
        while len(self._predictions) > self.capacity:  # nothing is measured: do not grow without end
            self._predictions.popleft()
        return residuals

    def _match(self, frame: MarkerFrame) -> Residual | None:
        after = next(i for i, p in enumerate(self._predictions) if p.stamp_ns >= frame.stamp_ns)
        second = self._predictions[after]
        if second.stamp_ns == frame.stamp_ns:
            if not second.converged:
                self.counts.refused_not_converged += 1
                return None
            residual = self._residual(frame, second, 0.0)
            self.interpolation_bound.add_exact(0 if residual is None else len(residual.ids))
            return residual
        if after == 0:
            self.counts.refused_extrapolation += 1
            return None
        first = self._predictions[after - 1]
        if second.stamp_ns - first.stamp_ns > self.max_gap_ns:
            self.counts.refused_gap += 1
            return None
        if not (first.converged and second.converged):
            self.counts.refused_not_converged += 1
            return None
        nearest_first = chain((self._predictions[i] for i in range(after - 2, -1, -1)), reversed(self._passed))
        before, later = neighbour(nearest_first, first, second), islice(self._predictions, after + 1, None)
        self.interpolation_bound.add((before, first, second), later, frame.stamp_ns)
        prediction = interpolate(first, second, frame.stamp_ns)
        return self._residual(frame, prediction, remainder(before, first, second, frame.stamp_ns))

    def _residual(self, frame: MarkerFrame, prediction: PredictedMarkers, bound: float) -> Residual | None:
        once = _once(frame.ids)
        ids, rows, columns = np.intersect1d(frame.ids[once], prediction.ids, return_indices=True)
        rows = once[rows]
        usable = np.isfinite(frame.points[rows]).all(axis=1) & np.isfinite(prediction.points[columns]).all(axis=1)
        ids, rows, columns = ids[usable].astype(np.uint32), rows[usable], columns[usable]
        measured, predicted = frame.points[rows], prediction.points[columns]
        self.counts.measured_twice += len(frame.ids) - len(once)
        if len(ids) == 0:
            self.counts.frames_without_common_marker += 1
            return None
        self.counts.matched_frames += 1
        self.counts.matched_markers += len(ids)
        self.counts.measured_without_prediction += len(frame.ids) - len(ids)
        self.counts.predicted_without_measurement += len(prediction.ids) - len(ids)
        return Residual(frame.stamp_ns, ids, measured, predicted, frame.covariances[rows], bound)


def _once(ids: Ids) -> NDArray[np.int64]:
    """Return the rows of ``ids`` (n,) that are there once: of two markers with one id nobody knows which is which."""
    _, rows, times = np.unique(ids, return_index=True, return_counts=True)
    return np.asarray(rows[times == 1], np.int64)
