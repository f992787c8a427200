"""Which spot of the left picture is which spot of the right one: epipolar geometry with uncertainty, then
assignment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from livedeform_common.types import Array
from stereo_node.camera import StereoRig, undistort
from stereo_node.detect import Blobs
from stereo_node.triangulate import Triangulated, triangulate

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class MatchSettings:
    """Gates of the matching."""

    epipolar_sigma_px: float = 0.25  # what the calibration leaves, beside the centres' own noise
    epipolar_gate: float = 4.0  # sigmas
    min_depth: float = 0.05  # m
    max_depth: float = 3.0  # m
    max_radius_ratio: float = 1.6


@dataclass(frozen=True)
class Pairs:
    """Possible pairs: rows of the left and right blobs (k,), their points, and the signed epipolar error (k,) px with
    its standard deviation (k,). One blob may be in several pairs."""

    left: Rows
    right: Rows
    points: Triangulated
    epipolar_px: Array
    epipolar_sigma_px: Array

    def __len__(self) -> int:
        return len(self.left)

    def take(self, rows: NDArray[np.generic]) -> Pairs:
        """The pairs of these rows."""
        return Pairs(
            self.left[rows],
            self.right[rows],
            self.points.take(rows),
            self.epipolar_px[rows],
            self.epipolar_sigma_px[rows],
        )


def epipolar_error(rig: StereoRig, left: Blobs, right: Blobs) -> tuple[Array, Array]:
    """Signed distance (n_left, n_right) px of every pair from meeting, and its standard deviation from the centres'
    covariances.

    Sampson's first-order distance x_r^T E x_l / |gradient| (Hartley & Zisserman 11.4.3), with the gradient taken with
    respect to raw pixels, so that it is in pixels also for distorted pictures.
    """
    a, A = undistort(rig.left, left.centres)
    b, B = undistort(rig.right, right.centres)
    a1 = np.hstack([a, np.ones((len(a), 1))])
    b1 = np.hstack([b, np.ones((len(b), 1))])
    lines_right = a1 @ rig.essential.T  # (n_left, 3)
    lines_left = b1 @ rig.essential  # (n_right, 3)
    value = lines_right @ b1.T
    g_left = np.einsum("ri,lij->lrj", lines_left[:, :2], A)
    g_right = np.einsum("li,rij->lrj", lines_right[:, :2], B)
    slope2 = (g_left**2).sum(axis=2) + (g_right**2).sum(axis=2)
    variance = np.einsum("lri,lij,lrj->lr", g_left, left.covariances, g_left)
    variance += np.einsum("lri,rij,lrj->lr", g_right, right.covariances, g_right)
    slope = np.sqrt(np.maximum(slope2, 1e-30))
    # divided by |gradient| the distance is split over both pictures; times sqrt(2) it is what one picture shows
    return np.sqrt(2) * value / slope, np.sqrt(2 * variance) / slope


def candidate_pairs(rig: StereoRig, left: Blobs, right: Blobs, settings: MatchSettings) -> Pairs:
    """All pairs that meet within the epipolar gate, look alike, and lie in front of the cameras."""
    error, sigma = epipolar_error(rig, left, right)
    total = np.hypot(sigma, settings.epipolar_sigma_px)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = left.radii[:, None] / right.radii[None]
    alike = (ratio < settings.max_radius_ratio) & (ratio > 1 / settings.max_radius_ratio)
    alike &= np.sign(left.contrasts)[:, None] == np.sign(right.contrasts)[None]
    if left.codes is not None and right.codes is not None:
        alike = left.codes[:, None] == right.codes[None]
    rows, cols = np.nonzero((np.abs(error) < settings.epipolar_gate * total) & alike)
    points = triangulate(rig, left.centres[rows], right.centres[cols], left.covariances[rows], right.covariances[cols])
    pairs = Pairs(rows, cols, points, error[rows, cols], total[rows, cols])
    z = points.points[:, 2]
    return pairs.take(np.flatnonzero((z > settings.min_depth) & (z < settings.max_depth)))


def assign(cost: Array, limit: float) -> tuple[Rows, Rows]:
    """Rows and columns of the assignment of least total cost; leaving a row alone costs ``limit``, inf forbids a
    pair.
    """
    n, m = cost.shape
    if n == 0 or m == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    square = np.full((n, m + n), np.inf)
    square[:, :m] = np.where(cost < limit, cost, np.inf)
    square[np.arange(n), m + np.arange(n)] = limit
    rows, cols = linear_sum_assignment(square)
    real = cols < m
    return rows[real], cols[real]


def best_pairs(
    pairs: Pairs, n_left: int, n_right: int, expected_sigma: float = 0.0, depth: float | None = None
) -> Pairs:
    """One-to-one pairs of least total epipolar error (and distance from the expected ``depth``, m, if given)."""
    cost = (pairs.epipolar_px / pairs.epipolar_sigma_px) ** 2
    if depth is not None and expected_sigma > 0:
        cost = cost + ((pairs.points.points[:, 2] - depth) / expected_sigma) ** 2
    table = np.full((n_left, n_right), np.inf)
    table[pairs.left, pairs.right] = cost
    index = np.full((n_left, n_right), -1)
    index[pairs.left, pairs.right] = np.arange(len(pairs))
    rows, cols = assign(table, 100.0)
    return pairs.take(index[rows, cols])
