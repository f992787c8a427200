"""Match the spots of the left picture with those of the right one: epipolar geometry with uncertainty, then
assignment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.stereo_node.camera.rig import StereoRig, undistort
from livedeform.stereo_node.camera.triangulate import Triangulated, triangulate
from livedeform.stereo_node.detect.blobs import Blobs

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class MatchSettings:
    """Gates of the matching."""

    epipolar_sigma_px: float = 0.25  # what the calibration leaves, besides the centres' own noise
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
        """Return the pairs of these rows."""
        return Pairs(
            self.left[rows],
            self.right[rows],
            self.points.take(rows),
            self.epipolar_px[rows],
            self.epipolar_sigma_px[rows],
        )


def epipolar_error(rig: StereoRig, left: Blobs, right: Blobs) -> tuple[Array, Array]:
    """Compute the signed distance (n_left, n_right) px of every pair from meeting, and its standard deviation from the
    centres' covariances.

    Sampson's first-order distance x_r^T E x_l / |gradient| (Hartley & Zisserman 11.4.3), with the gradient taken with
    respect to raw pixels, so that it is in pixels also for distorted pictures.
    """
    a, A = undistort(rig.left, left.centres)
    b, B = undistort(rig.right, right.centres)
    error, sigma = _sampson(rig.essential, a, A, left.covariances, b, B, right.covariances)
    return error, sigma


@njit(cache=True, error_model="numpy")
def _sampson(E, a, A, left_cov, b, B, right_cov):
    """Compute ``epipolar_error`` from the ideal image points ``a``, ``b`` with derivatives ``A``, ``B``."""
    error, sigma = np.empty((len(a), len(b))), np.empty((len(a), len(b)))
    lines_left = np.empty((len(b), 3))
    for j in range(len(b)):
        for k in range(3):
            lines_left[j, k] = b[j, 0] * E[0, k] + b[j, 1] * E[1, k] + E[2, k]
    for i in range(len(a)):
        l0 = E[0, 0] * a[i, 0] + E[0, 1] * a[i, 1] + E[0, 2]
        l1 = E[1, 0] * a[i, 0] + E[1, 1] * a[i, 1] + E[1, 2]
        l2 = E[2, 0] * a[i, 0] + E[2, 1] * a[i, 1] + E[2, 2]
        for j in range(len(b)):
            value = l0 * b[j, 0] + l1 * b[j, 1] + l2
            p = lines_left[j, 0] * A[i, 0, 0] + lines_left[j, 1] * A[i, 1, 0]
            q = lines_left[j, 0] * A[i, 0, 1] + lines_left[j, 1] * A[i, 1, 1]
            r = l0 * B[j, 0, 0] + l1 * B[j, 1, 0]
            s = l0 * B[j, 0, 1] + l1 * B[j, 1, 1]
            variance = p * p * left_cov[i, 0, 0] + 2.0 * p * q * left_cov[i, 0, 1] + q * q * left_cov[i, 1, 1]
            variance += r * r * right_cov[j, 0, 0] + 2.0 * r * s * right_cov[j, 0, 1] + s * s * right_cov[j, 1, 1]
            slope = math.sqrt(max(p * p + q * q + r * r + s * s, 1e-30))
            # divided by |gradient| the distance is split over both pictures; times sqrt(2) it is what one picture shows
            error[i, j] = math.sqrt(2.0) * value / slope
            sigma[i, j] = math.sqrt(2.0 * variance) / slope
    return error, sigma


def candidate_pairs(rig: StereoRig, left: Blobs, right: Blobs, settings: MatchSettings) -> Pairs:
    """Find all pairs that meet within the epipolar gate, look alike, and lie in front of the cameras."""
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
    """Find rows and columns of the assignment of least total cost; leaving a row alone costs ``limit``, inf forbids a
    pair."""
    allowed = cost < limit
    choices, wanted = allowed.sum(axis=1), allowed.sum(axis=0)
    i = np.flatnonzero(choices == 1)
    j = allowed[i].argmax(axis=1) if cost.size else i
    i, j = i[wanted[j] == 1], j[wanted[j] == 1]
    choices[i] = wanted[j] = 0
    rows, cols = np.flatnonzero(choices), np.flatnonzero(wanted)  # what is contested
    n, m = len(rows), len(cols)
    if n == 0:
        return i, j
    at = np.ix_(rows, cols)
    square = np.full((n, m + n), np.inf)
    square[:, :m] = np.where(allowed[at], cost[at], np.inf)
    square[np.arange(n), m + np.arange(n)] = limit
    by, to = linear_sum_assignment(square)
    real = to < m
    i, j = np.append(i, rows[by[real]]), np.append(j, cols[to[real]])
    order = np.argsort(i)
    return i[order], j[order]
