"""The scale of a rig against lengths that did not enter its calibration.

A calibration takes its unit from the declared square; a wrong square gives perfect pictures and wrong lengths. Only
another length shows it: a second board, a caliper, markers at known distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

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
    def total_sigma(self) -> float:
        """One sigma of both together."""
        return float(np.hypot(self.sigma, self.sigma_calibration))

    @property
    def agrees(self) -> bool:
        """Return whether 1 lies in the 95 % interval."""
        return abs(self.scale - 1) < 1.96 * self.total_sigma

    @property
    def sentence(self) -> str:
        """The result in one sentence for people."""
        percent, margin = 100 * (self.scale - 1), 196 * self.total_sigma
        verdict = "agrees with" if self.agrees else "contradicts"
        return (
            f"the independent length {verdict} the scale: measured lengths are {percent:+.3f} +- {margin:.3f} % off "
            f"({self.n_lengths} lengths in {self.n_views} views)"
        )


def check_lengths(measured: Sequence[Array], true: Sequence[Array]) -> ScaleCheck:
    """Estimate the scale of measured against true lengths, m; one array per view, since errors within a view are common
    to its lengths."""
    per_view = np.array([(m @ t) / (t @ t) for m, t in zip(measured, true, strict=True)])
    weights = np.array([t @ t for t in true])
    scale = float(weights @ per_view / weights.sum())
    if len(per_view) > 1:
        sigma = float(
            np.sqrt(weights**2 @ (per_view - scale) ** 2) / weights.sum() * np.sqrt(len(per_view) / (len(per_view) - 1))
        )
    else:  # one view: from the scatter of its lengths, which is too optimistic about what they share
        m, t = measured[0], true[0]
        sigma = (
            float(np.sqrt(((m - scale * t) ** 2).sum() / max(len(t) - 1, 1) / (t @ t))) if len(t) > 1 else float("nan")
        )
    return ScaleCheck(scale, sigma, int(sum(len(t) for t in true)), len(per_view))


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
    """Check the rig on another board: the distances of all its points from their mean, view by view."""
    measured, true = [], []
    for pair in pairs:
        rows = np.intersect1d(pair.left.rows, pair.right.rows)
        left = pair.left.pixels[np.searchsorted(pair.left.rows, rows)]
        right = pair.right.pixels[np.searchsorted(pair.right.rows, rows)]
        X, P = triangulate(rig, left, right).points, board.points[rows]
        given = np.isfinite(X).all(axis=1)  # a lens need not give every pixel
        X, P = X[given], P[given]
        measured.append(np.linalg.norm(X - X.mean(axis=0), axis=1))
        true.append(np.linalg.norm(P - P.mean(axis=0), axis=1))
    return check_lengths(measured, true)
