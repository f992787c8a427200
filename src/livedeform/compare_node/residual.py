"""The error of one moment: measured - predicted, marker by marker, in the frame ``phantom``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livedeform.common.types import Array, Ids

__all__ = ["Residual", "ResidualTable", "tabulate"]


@dataclass(frozen=True)
class Residual:
    """Markers that were both measured and predicted at one measured stamp.

    ``measured`` and ``predicted`` (n, 3) m for ``ids`` (n,), ascending; ``covariances`` (n, 3, 3) m2 of the
    measurement, NaN where the tracker gives none. ``interpolation_bound`` (m) is what the linear interpolation of the
    predictions in time adds to any marker, as far as those up to then show (`interpolation.remainder`); NaN where there
    were too few to say.
    """

    stamp_ns: int
    ids: Ids
    measured: Array
    predicted: Array
    covariances: Array
    interpolation_bound: float = 0.0

    @property
    def errors(self) -> Array:
        """error = measured - predicted (n, 3) m."""
        return self.measured - self.predicted

    @property
    def distances(self) -> Array:
        """Euclidean length of the error (n,) m."""
        return np.asarray(np.linalg.norm(self.errors, axis=1))


@dataclass(frozen=True)
class ResidualTable:
    """All residuals of a recording in one table, one row per marker and frame.

    ``stamps_ns`` (n,), ``frame`` (n,) index of the frame, ``ids`` (n,), ``measured``, ``predicted`` and ``errors``
    (n, 3) m, ``distances`` (n,) m, ``variances`` (n,) m2 trace of the measurement's covariance, NaN without one.
    """

    stamps_ns: np.ndarray
    frame: np.ndarray
    ids: Ids
    measured: Array
    predicted: Array
    variances: Array

    @property
    def errors(self) -> Array:
        """error = measured - predicted (n, 3) m."""
        return self.measured - self.predicted

    @property
    def distances(self) -> Array:
        """Euclidean length of the error (n,) m."""
        return np.asarray(np.linalg.norm(self.errors, axis=1))


def tabulate(residuals: list[Residual]) -> ResidualTable:
    """Return one table of many residuals, in their order; an empty list gives an empty table."""
    counts = [len(r.ids) for r in residuals]

    def stack(parts: list[Array], empty: tuple[int, ...]) -> Array:
        return np.concatenate(parts) if parts else np.empty(empty)

    return ResidualTable(
        stamps_ns=np.repeat(np.array([r.stamp_ns for r in residuals], dtype=np.int64), counts),
        frame=np.repeat(np.arange(len(residuals)), counts),
        ids=np.concatenate([r.ids for r in residuals]) if residuals else np.empty(0, np.uint32),
        measured=stack([r.measured for r in residuals], (0, 3)),
        predicted=stack([r.predicted for r in residuals], (0, 3)),
        variances=stack([r.covariances.trace(axis1=1, axis2=2) for r in residuals], (0,)),
    )
