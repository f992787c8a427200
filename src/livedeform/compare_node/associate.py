"""Associate predictions with measurements: by marker id and stamp, predictions interpolated to that stamp.

Between two predictions at t0 <= t <= t1 a marker moves on the straight line

    x(t) = x0 + a (x1 - x0),   a = (t - t0) / (t1 - t0),

whose remainder is at most |x''| (t - t0)(t1 - t) / 2 (Newton's interpolation formula); x'' is taken from the second
divided difference with the prediction before t0. Nothing is extrapolated, nothing is bridged over more than
``max_gap_ns``, and a prediction that did not converge matches nothing: each refusal is counted.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from livedeform.common.stamps import StampClock, StampKind
from livedeform.common.types import Array, Ids, MarkerFrame, PredictedMarkers
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
        self._waiting: deque[MarkerFrame] = deque()
        self._predictions: deque[PredictedMarkers] = deque()
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

    def flush(self) -> list[Residual]:
        """End the streams: what still waits lies after the last prediction and would be extrapolated."""
        residuals = self._drain(ended=True)
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
            # keep one prediction before the bracket: the curvature needs it
            while len(self._predictions) > 2 and self._predictions[2].stamp_ns < frame.stamp_ns:
                self._predictions.popleft()
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
            return self._residual(frame, second, 0.0)
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
        before = self._predictions[after - 2] if after >= 2 else None
        prediction = interpolate(first, second, frame.stamp_ns)
        return self._residual(frame, prediction, remainder(before, first, second, frame.stamp_ns))

    def _residual(self, frame: MarkerFrame, prediction: PredictedMarkers, bound: float) -> Residual | None:
        ids, rows, columns = np.intersect1d(frame.ids, prediction.ids, return_indices=True)
        usable = np.isfinite(frame.points[rows]).all(axis=1) & np.isfinite(prediction.points[columns]).all(axis=1)
        ids, rows, columns = ids[usable].astype(np.uint32), rows[usable], columns[usable]
        measured, predicted = frame.points[rows], prediction.points[columns]
        if len(ids) == 0:
            self.counts.frames_without_common_marker += 1
            return None
        self.counts.matched_frames += 1
        self.counts.matched_markers += len(ids)
        self.counts.measured_without_prediction += len(frame.ids) - len(ids)
        self.counts.predicted_without_measurement += len(prediction.ids) - len(ids)
        return Residual(frame.stamp_ns, ids, measured, predicted, frame.covariances[rows], bound)


def interpolate(first: PredictedMarkers, second: PredictedMarkers, stamp_ns: int) -> PredictedMarkers:
    """Return the markers of both predictions on the straight line between them at ``stamp_ns``."""
    ids, rows, columns = np.intersect1d(first.ids, second.ids, return_indices=True)
    a = (stamp_ns - first.stamp_ns) / (second.stamp_ns - first.stamp_ns)
    x0, x1 = first.points[rows], second.points[columns]
    return PredictedMarkers(stamp_ns, ids.astype(np.uint32), x0 + a * (x1 - x0))


def remainder(
    before: PredictedMarkers | None, first: PredictedMarkers, second: PredictedMarkers, stamp_ns: int
) -> float:
    """Return the largest |x''| (t - t0)(t1 - t) / 2 over the markers (m); NaN without one before t0."""
    if before is None or not before.converged:
        return float("nan")
    ids = np.intersect1d(np.intersect1d(before.ids, first.ids), second.ids)
    if len(ids) == 0:
        return float("nan")
    x = [_rows(p, ids) for p in (before, first, second)]
    t = [(p.stamp_ns - first.stamp_ns) * 1e-9 for p in (before, first, second)]
    s = (stamp_ns - first.stamp_ns) * 1e-9
    second_difference = ((x[2] - x[1]) / (t[2] - t[1]) - (x[1] - x[0]) / (t[1] - t[0])) / (t[2] - t[0])
    return float(np.nanmax(np.linalg.norm(second_difference, axis=1)) * s * (t[2] - s))


def _rows(prediction: PredictedMarkers, ids: Ids) -> Array:
    order = np.argsort(prediction.ids)
    return prediction.points[order[np.searchsorted(prediction.ids, ids, sorter=order)]]
