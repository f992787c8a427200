"""Known lengths on pictures that were not used: what a calibration measures them as, and its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import Board, Pair
from livedeform.stereo_node.calibrate.bundle import Bundle
from livedeform.stereo_node.camera.calibration_uncertainty import parameter_sensitivity
from livedeform.stereo_node.camera.known_field import known_field
from livedeform.stereo_node.camera.triangulate import triangulate

UNSEEN = float(stdtrit(3, 0.975) / 1.96) ** 2
"""What rays that miss each other say of the motion along them, which no ray shows: as much, but known from the three
numbers of a rigid motion that they do show (Student's factor)."""


@dataclass(frozen=True)
class Length:
    """A known length on a picture pair that was not used: ``n_squares`` long, nominal and measured m, and ``printed``
    m, what the other pictures say of this board's own print (nominal if the board was not released); the predicted
    standard deviations from the corners' noise and from the calibration, distance m and tilt rad of the board."""

    pair: str
    n_squares: int
    true: float
    printed: float
    measured: float
    sigma_noise: float
    sigma_calibration: float
    distance: float
    tilt: float
    outlier: bool

    @property
    def error(self) -> float:
        """measured - true, m."""
        return self.measured - self.true

    @property
    def sigma(self) -> float:
        """Both parts together, m."""
        return float(np.hypot(self.sigma_noise, self.sigma_calibration))


def known_lengths(
    points: Array, pairs: Sequence[Pair], kept: NDArray[np.int64], final: Bundle, without: Sequence[Bundle],
    board: Board, size: tuple[int, int],
) -> tuple[list[Length], float, int]:  # fmt: skip
    """Measure lengths of every number of squares on each pair by the rig that the other pairs give: ``without`` (in the
    order of ``kept``), or ``final`` for pairs that are not among the ``kept``; and return the rms epipolar error px of
    the pairs left out, and how many corners lie where the other pairs do not tell the lens. Intervals are by the
    covariance of ``final``, of one pair fewer."""
    lengths: list[Length] = []
    squares: list[float] = []
    n_beyond = 0
    position = {int(row): k for k, row in enumerate(kept)}
    fewer = final.covariance * len(kept) / max(len(kept) - 1, 1)
    for i, pair in enumerate(pairs):
        bundle = replace(without[position[i]], covariance=fewer) if i in position else final
        common = np.intersect1d(pair.left.rows, pair.right.rows)
        left = pair.left.pixels[np.searchsorted(pair.left.rows, common)]
        right = pair.right.pixels[np.searchsorted(pair.right.rows, common)]
        lengths += lengths_of(pair.name, points, common, left, right, bundle, board, size, i not in position)
        known = told(bundle, size, left, right)
        n_beyond += int((~known).sum())
        if i in position and known.any():
            error = triangulate(bundle.rig(size), left[known], right[known]).reprojection_error_px
            squares += list(
                2 * error**2
            )  # four residuals of one degree of freedom: both rays' share of the epipolar distance
    return lengths, float(np.sqrt(np.mean(squares))) if squares else float("nan"), n_beyond


def told(bundle: Bundle, size: tuple[int, int], left: Array, right: Array) -> NDArray[np.bool_]:
    """Tell which (n,) of the pixels ``left``, ``right`` (n, 2) give a point: a lens need not give every pixel, and is
    not known everywhere."""
    finite = np.isfinite(triangulate(bundle.rig(size), left, right).points).all(axis=1)
    return finite & known_field(bundle, size).holds(left, right)


def lengths_of(
    name: str, points: Array, rows: NDArray[np.int64], left: Array, right: Array, bundle: Bundle, board: Board,
    size: tuple[int, int], outlier: bool,
) -> list[Length]:  # fmt: skip
    """Measure the lengths among the points ``rows`` (n,) of a board seen at ``left``, ``right`` (n, 2) px; those of
    points that the calibration does not tell are left out."""
    rig = bundle.rig(size)
    seen = told(bundle, size, left, right)
    rows, left, right = rows[seen], left[seen], right[seen]
    if len(rows) < 3:
        return []
    measured = triangulate(rig, left, right, sigma_px=bundle.sigma_px)
    blur, motion = _excess(points[rows], measured.reprojection_error_px, left - rig.project(measured.points)[0], bundle)
    X, J = measured.points, parameter_sensitivity(bundle, size, left, right)
    a, b, n = _spans(points[rows], board.square)
    difference = X[a] - X[b]
    length = np.linalg.norm(difference, axis=1)
    unit = difference / length[:, None]
    noise = np.einsum("ki,kij,kj->k", unit, measured.covariances[a] + measured.covariances[b], unit)
    # a motion varies linearly over the board: neighbours share it, and it is of opposite sign at the two ends
    apart = np.linalg.norm(points[rows[a]] - points[rows[b]], axis=1)
    noise *= 1.0 + blur + motion * (2 * apart / np.linalg.norm(np.ptp(points[rows], axis=0))) ** 2
    d = np.einsum("ki,kip->kp", unit, J[a] - J[b])
    systematic = np.einsum("kp,pq,kq->k", d, bundle.covariance, d)
    centre = X.mean(axis=0)
    tilt = _tilt(X, centre)
    true = np.linalg.norm(points[rows[a]] - points[rows[b]], axis=1)
    shaped = points + bundle.shape
    printed = np.linalg.norm(shaped[rows[a]] - shaped[rows[b]], axis=1)
    distance = float(np.linalg.norm(centre))
    numbers = zip(n, true, printed, length, np.sqrt(noise), np.sqrt(systematic), strict=True)
    return [
        Length(name, int(k), float(a), float(b), float(c), float(d), float(e), distance, tilt, outlier)
        for k, a, b, c, d, e in numbers
    ]


def _excess(places: Array, error_px: Array, missed: Array, bundle: Bundle) -> tuple[float, float]:
    """Return by how much a pair is worse than the others, in variances of a corner, as its rays that do not meet show:
    from corner to corner (blur), and linearly over the board (a hand that moved between the exposures).

    ``places`` (n, 3) m on the board; ``error_px`` (n,) and ``missed`` (n, 2) px: how far the rays miss, and whither.
    """
    miss = np.sqrt(2.0) * error_px * np.sign(missed[:, 1])
    A = np.column_stack([np.ones(len(places)), places[:, :2]])
    smooth = A @ np.linalg.lstsq(A, miss, rcond=None)[0]
    rough = float(((miss - smooth) ** 2).sum()) / max(len(places) - 3, 1)
    blur = max(rough / bundle.sigma_px**2 - 1.0, 0.0)
    motion = max((float((smooth**2).mean()) - 3 * rough / len(places)) / bundle.sigma_px**2, 0.0)
    return blur, UNSEEN * motion


def _tilt(X: Array, centre: Array) -> float:
    """Return the angle (rad) between the board's normal and the line of sight to its ``centre``."""
    normal = np.linalg.svd(X - centre)[2][2]
    return float(np.arccos(min(abs(normal @ centre) / np.linalg.norm(centre), 1.0)))


def _spans(points: Array, square: float) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return all pairs of points on a common row or column of the board, and how many squares they are apart."""
    a, b = np.triu_indices(len(points), 1)
    step = np.abs(points[a] - points[b]) / square
    straight = (step[:, 0] < 1e-6) | (step[:, 1] < 1e-6)
    return a[straight], b[straight], np.round(step.sum(axis=1)[straight]).astype(np.int64)
