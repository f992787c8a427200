"""Tell whether what goes on while nothing else moves is predicted: creep, relaxation, drying.

A drift is small beside a motion, so all that a motion's model may get wrong covers it, and a share of the whole
evidence hardly counts it. It is told by itself: the change over each stretch in which the body is held, by a straight
line through the markers, against the noise of that line alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Run
from livedeform.closed_loop.settings import Settings
from livedeform.common.types import Array

LEAST_OF_A_LINE = 5  # moments of a stretch: a drift, and the scatter about it


@dataclass(frozen=True)
class HeldDrift:
    """The drift of held-out markers: that of the ``marker`` that drifts most, ``measured``, ``left`` by the model (both
    m) and its ``sigma`` m; over all markers chi2 of what was measured (``there``) and of what is left (``missed``), of
    ``n`` coordinates."""

    marker: int
    measured: float
    left: float
    sigma: float
    there: float
    missed: float
    n: int

    @property
    def beyond_chance(self) -> float:
        """Return how much chi2 of what was measured is no noise."""
        return max(self.there - self.n, 0.0)

    def is_missed(self, settings: Settings) -> bool:
        """Tell whether there is one, and the model has too little of it."""
        if self.beyond_chance < settings.sampling.moved * np.sqrt(2.0 * self.n):
            return False
        return self.missed - self.n > (1.0 - settings.verdict.min_explained) * self.beyond_chance

    def sentence(self, matters: float) -> str:
        """Say it, beside the size that ``matters`` m."""
        less = f", less than the {1e3 * matters:.2g} mm that matter here" if self.measured < matters else ""
        return (
            f"What goes on while the body is held is not explained: marker {self.marker} drifts by "
            f"{1e3 * self.measured:.3f} +- {1e3 * self.sigma:.3f} mm, "
            f"of which {1e3 * self.left:.3f} mm are left{less}."
        )


def drift_of(observations: Sequence[Observation], runs: Sequence[Run]) -> HeldDrift | None:
    """Find the drift in the longest stretch of each recording in which the body is held, and what the ``runs`` of a
    model leave of it; None where there is no such stretch."""
    found = [part for o, run in zip(observations, runs, strict=True) if (part := _of_one(o, run)) is not None]
    if not found:
        return None
    ids = np.concatenate([ids for ids, *_ in found])
    measured, left, variances = (np.concatenate([part[k] for part in found]) for k in (1, 2, 3))
    seen = np.isfinite(variances)
    size = np.sqrt(np.sum(np.where(seen, measured, 0.0) ** 2, axis=1))
    most = int(np.argmax(size))
    return HeldDrift(
        marker=int(ids[most]),
        measured=float(size[most]),
        left=float(np.sqrt(np.nansum(left[most] ** 2))),
        sigma=float(np.sqrt(np.nansum(variances[most]))),
        there=float(np.sum(measured[seen] ** 2 / variances[seen])),
        missed=float(np.sum(left[seen] ** 2 / variances[seen])),
        n=int(seen.sum()),
    )


def _of_one(o: Observation, run: Run) -> tuple[np.ndarray, Array, Array, Array] | None:
    """Return ids (m,), measured and left change (m, 3) m over the longest held stretch and its variance (m, 3) m2."""
    held = longest(o.phases == "hold")
    if len(held) < LEAST_OF_A_LINE:
        return None
    t = o.seconds[held]
    measured, left = o.points[held], o.points[held] - run.points[held]
    variances = np.diagonal(o.covariances[held], axis1=2, axis2=3)
    weights = np.where(np.isfinite(measured) & np.isfinite(left), 1.0 / variances, 0.0)
    total = weights.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        x = t[:, None, None] - np.sum(weights * t[:, None, None], axis=0) / total
        spread = np.sum(weights * x**2, axis=0)
        lines = [_line(x, np.nan_to_num(y), weights, spread) for y in (measured, left)]
        scatter = np.maximum(1.0, np.maximum(lines[0][1], lines[1][1]))  # what still swings is no noise of the line
        variance = np.where(spread > 0.0, scatter * np.ptp(t) ** 2 / spread, np.nan)
    return np.asarray(o.ids), np.ptp(t) * lines[0][0], np.ptp(t) * lines[1][0], variance


def _line(x: Array, y: Array, weights: Array, spread: Array) -> tuple[Array, Array]:
    """Return the slope (m, 3) of lines through ``y`` (k, m, 3) over ``x``, and chi2 per datum about them (m, 3)."""
    mean = np.sum(weights * y, axis=0) / weights.sum(axis=0)
    slope = np.sum(weights * x * y, axis=0) / spread
    chi2 = np.sum(weights * (y - mean - slope * x) ** 2, axis=0)
    return slope, chi2 / np.maximum((weights > 0.0).sum(axis=0) - 2, 1)


def longest(true: np.ndarray) -> np.ndarray:
    """Return the indices of the longest unbroken stretch of ``true`` (k,) bool."""
    edges = np.flatnonzero(np.diff(np.r_[False, true, False].astype(int)))
    if not len(edges):
        return np.zeros(0, int)
    starts, ends = edges[::2], edges[1::2]
    i = int(np.argmax(ends - starts))
    return np.arange(starts[i], ends[i])
