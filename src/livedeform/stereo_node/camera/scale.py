"""The scale of a rig against lengths that did not enter its calibration.

A calibration takes its unit from the declared square; a wrong square gives perfect pictures and wrong lengths. Only
another length shows it: a second board, a caliper, markers at known distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from livedeform.common.errors import CalibrationError
from livedeform.common.frames import apply, fit_rigid, make_a_frame
from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import Board, Pair
from livedeform.stereo_node.calibrate.bundle import Bundle
from livedeform.stereo_node.camera.calibration_uncertainty import STEP, principal_axes
from livedeform.stereo_node.camera.rig import StereoRig
from livedeform.stereo_node.camera.triangulate import triangulate

__all__ = ["ScaleCheck", "check_calibration", "check_lengths", "check_scale"]


@dataclass(frozen=True)
class ScaleCheck:
    """The scale in measured = scale x true, from ``n_lengths`` lengths of ``n_views`` views; ``sigma`` from the scatter
    between views, ``sigma_calibration`` what the calibration's own pictures leave open, which no number of views
    lessens."""

    scale: float
    sigma: float
    n_lengths: int
    n_views: int
    sigma_calibration: float = 0.0

    @property
    def margin(self) -> float:
        """Half of the 95 % interval: Student's for the scatter between few views, with what the calibration leaves
        open."""
        n = self.n_views if self.n_views > 1 else self.n_lengths
        return float(np.hypot(student.ppf(0.975, max(n - 1, 1)) * self.sigma, 1.96 * self.sigma_calibration))

    @property
    def agrees(self) -> bool:
        """Return whether 1 lies in the 95 % interval."""
        return abs(self.scale - 1) < self.margin

    @property
    def sentence(self) -> str:
        """The result in one sentence for people."""
        percent, margin = 100 * (self.scale - 1), 100 * self.margin
        verdict = "agrees with" if self.agrees else "contradicts" if np.isfinite(margin) else "does not judge"
        return (
            f"the independent length {verdict} the scale: measured lengths are {percent:+.3f} +- {margin:.3f} % off "
            f"({self.n_lengths} lengths in {self.n_views} views)"
        )


def check_lengths(measured: Sequence[Array], true: Sequence[Array]) -> ScaleCheck:
    """Estimate the scale of measured against true lengths, m; one array per view, since errors within a view are common
    to its lengths."""
    per_view = np.array([(m @ t) / (t @ t) for m, t in zip(measured, true, strict=True)])
    weights = np.array([t @ t for t in true])
    misfit = float(((measured[0] - per_view[0] * true[0]) ** 2).sum())
    return _pooled(per_view, weights, int(sum(len(t) for t in true)), misfit)


def _pooled(per_view: Array, weights: Array, n_lengths: int, misfit: float) -> ScaleCheck:
    """Return the mean of the scales ``per_view`` (n,) with ``weights`` (n,) m2; ``misfit`` m2: the sum of squares that
    the first one leaves of its lengths, from which alone one view has its sigma, too small by what they share."""
    n, scale = len(per_view), float(weights @ per_view / weights.sum())
    if n > 1:
        sigma = float(np.sqrt(weights**2 @ (per_view - scale) ** 2 * n / (n - 1)) / weights.sum())
    else:
        sigma = float(np.sqrt(misfit / (n_lengths - 1) / weights[0])) if n_lengths > 1 else float("nan")
    return ScaleCheck(scale, sigma, n_lengths, n)


def check_calibration(bundle: Bundle, size: tuple[int, int], pairs: Sequence[Pair], board: Board) -> ScaleCheck:
    """Check a calibration of pictures of ``size`` (width, height) on another board, with what the calibration's
    covariance makes of the scale."""
    check = check_scale(bundle.rig(size), pairs, board)
    changes = []
    for axis in principal_axes(bundle.covariance).T:
        moved = [
            check_scale(bundle.with_values(bundle.values + sign * STEP * axis).rig(size), pairs, board).scale
            for sign in (1, -1)
        ]
        changes.append((moved[0] - moved[1]) / (2 * STEP))
    return replace(check, sigma_calibration=float(np.linalg.norm(changes)))


def check_scale(rig: StereoRig, pairs: Sequence[Pair], board: Board) -> ScaleCheck:
    """Check the rig on another board: how far all its points are from their mean along where they should be, view by
    view. (Distances in all directions would be too long by what the depths scatter.)

    ``CalibrationError`` where no view shows three points of it to both cameras.
    """
    found = []
    for pair in pairs:
        rows = np.intersect1d(pair.left.rows, pair.right.rows)
        left = pair.left.pixels[np.searchsorted(pair.left.rows, rows)]
        right = pair.right.pixels[np.searchsorted(pair.right.rows, rows)]
        X, P = triangulate(rig, left, right).points, board.points[rows]
        given = np.isfinite(X).all(axis=1)  # a lens need not give every pixel
        X, P = X[given], P[given]
        if not make_a_frame(P):
            continue
        should = apply(fit_rigid(P, X), P)
        should, X = should - should.mean(axis=0), X - X.mean(axis=0)
        weight = float((should**2).sum())
        scale = float((should * X).sum()) / weight
        found.append((scale, weight, len(P), float(((X - scale * should) ** 2).sum()) / 3))
    if not found:
        raise CalibrationError(
            f"none of {len(pairs)} views shows three points of the board, not on a line, to both cameras",
            where="--check-left, --check-right",
            remedy="take pictures that show most of the board to both",
        )
    scales, weights, counts, misfits = zip(*found, strict=True)
    return _pooled(np.array(scales), np.array(weights), sum(counts), misfits[0])
