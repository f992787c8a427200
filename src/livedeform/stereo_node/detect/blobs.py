"""Dark and light round markers in one picture, with sub-pixel centres and their covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from livedeform.common.types import Array
from livedeform.stereo_node.detect.blob_fit import fit_blobs, start_parameters
from livedeform.stereo_node.detect.candidates import find_candidates
from livedeform.stereo_node.detect.centroid import ink_moments
from livedeform.stereo_node.detect.cuts import TINY
from livedeform.stereo_node.detect.picture import Picture, noise_level
from livedeform.stereo_node.detect.settings import DetectorSettings

MARGIN_PX = (
    4.0  # around the outline; with 3 px the background's slope is less sure and the centre 10 % worse, 5 px cost time
)
CHORD = 3.0  # displacement of the centre of a disc that a chord cuts, per skewness of what is left
NOISY = 14.0  # variances of a centre: what noise makes of a tiny disc's half axes beside ten others and of its skewness
NEIGHBOURS = 10  # whose outlines tell what that of a tiny disc should be
MOST_SKEWED = 0.06  # of the radius: bodies stretch discs less unevenly; of one that is half covered it is 0.07 to 0.2


@dataclass(frozen=True)
class Blobs:
    """Round markers of one picture.

    ``centres`` (n, 2) px, raw; ``covariances`` (n, 2, 2) px2; ``shapes`` (n, 2, 2): symmetric M of the outline
    |M (p - centre)| = 1, 1/px; ``contrasts`` (n,) grey values (negative: dark); ``blur_px`` (n,); ``residuals`` (n,)
    grey values.
    """

    centres: Array
    covariances: Array
    shapes: Array
    contrasts: Array
    blur_px: Array
    residuals: Array
    skewness_px: Array | None = None  # (n,): how far the outline is from an ellipse (``blob_fit``)
    rejected: Mapping[str, int] | None = None
    codes: NDArray[np.int64] | None = None  # identities that were read from the picture, -1 for none

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def radii(self) -> Array:
        """(n,) px: radius of the circle of the same area."""
        return np.asarray(1 / np.sqrt(np.maximum(np.linalg.det(self.shapes), 1e-12)))

    def take(self, rows: NDArray[Any]) -> Blobs:
        """Return the blobs of these rows."""
        arrays = ("centres", "covariances", "shapes", "contrasts", "blur_px", "residuals")
        taken = {name: getattr(self, name)[rows] for name in arrays}
        for name in ("codes", "skewness_px"):
            whole = getattr(self, name)
            taken[name] = None if whole is None else whole[rows]
        return replace(self, **taken)


def detect_blobs(picture: Picture, settings: DetectorSettings, noise: float | None = None) -> Blobs:
    """Detect all round markers of a grey picture (h, w)."""
    centres, axes, background, contrast = find_candidates(picture, settings)
    return fit_candidates(picture, start_parameters(centres, axes, background, contrast), settings, noise)


def fit_candidates(picture: Picture, start: Array, settings: DetectorSettings, noise: float | None = None) -> Blobs:
    """Fit the candidates ``start`` (n, 10) of ``blob_fit`` and keep those that look like a marker."""
    noise = noise_level(picture) if noise is None else noise
    if settings.centre == "moments":
        fit = ink_moments(picture, start, noise)
    else:
        fit = fit_blobs(picture, start, MARGIN_PX, 0.5 * noise, 25)
    shapes = fit[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    axes = 1 / np.maximum(np.linalg.eigvalsh(shapes), 1e-6) if len(fit) else np.zeros((0, 2))
    radius = np.sqrt(axes[:, 0] * axes[:, 1])
    keep = np.ones(len(fit), bool)
    rejected: dict[str, int] = {}
    for reason, passed in _tests(fit, start, axes, radius, settings, noise).items():
        lost = int((keep & ~passed).sum())
        if lost:
            rejected[reason] = lost
        keep &= passed
    keep &= ~_twins(fit[:, :2], fit[:, 13] / np.maximum(np.abs(fit[:, 9]), 1e-9), radius, keep)
    covariances = fit[keep][:, [10, 11, 11, 12]].reshape(-1, 2, 2)
    if settings.centre != "moments":
        covariances = covariances + _untold_cuts(fit[keep], shapes[keep], radius[keep])
    return Blobs(
        centres=fit[keep, :2],
        covariances=covariances,
        shapes=shapes[keep],
        contrasts=fit[keep, 9],
        blur_px=fit[keep, 5],
        residuals=fit[keep, 13],
        skewness_px=fit[keep, 17],
        rejected=rejected,
    )


def _tests(
    fit: Array, start: Array, axes: Array, radius: Array, settings: DetectorSettings, noise: float
) -> dict[str, NDArray[np.bool_]]:
    """Test (n,) by reason of rejection: which fits look like a marker. ``axes`` (n, 2) px, ``radius`` (n,) px."""
    size, residual = np.abs(fit[:, 9]), fit[:, 13]
    excess = np.sqrt(np.maximum(residual**2 - noise**2, 0))
    dark = fit[:, 9] < 0
    return {
        "fit did not converge": fit[:, 15] > 0,
        "radius": (radius >= settings.min_radius) & (radius <= settings.max_radius),
        "polarity": (settings.polarity == "both") | (dark if settings.polarity == "dark" else ~dark),
        "contrast": (size >= settings.min_contrast) & (size >= settings.min_signal * residual),
        # a fit whose contrast is far beyond what the picture shows there has traded it for blur
        "contrast is not there": size <= 2.0 * np.abs(start[:, 9]) + settings.min_contrast,
        "aspect": axes[:, 0] <= settings.max_aspect * axes[:, 1],
        "shape": excess <= settings.max_misfit * size,
        "outline cut off": fit[:, 17] <= MOST_SKEWED * radius,
        "rim hidden": fit[:, 14] >= settings.min_rim,
        "blurred away": fit[:, 5] < np.maximum(radius, 1.0),
        "uncertain centre": (fit[:, 10] + fit[:, 12] < 2 * settings.max_sigma**2) & (fit[:, 10] > 0) & (fit[:, 12] > 0),
    }


def _untold_cuts(fits: Array, shapes: Array, radius: Array) -> Array:
    """Return (n, 2, 2) px2: where the middles of discs may be if something as light as the ground cuts them.

    A cut that is too light to be told by evidence skews the outline, and moves its middle by about as much. Where a
    third of a picture's outlines are skewed, as painted or stretched ones are, that says nothing.

    What is left of a tiny disc is an ellipse, as of one that is tilted: its middle may lie off by as much as its half
    axes differ from those of its neighbours on the surface, and by more where its skewness shows, less what noise makes
    of that.
    """
    out, tiny = np.zeros((len(radius), 2, 2)), np.flatnonzero(radius < TINY)
    if len(radius) and np.quantile(fits[:, 17], 2 / 3) == 0.0:
        out += (fits[:, 17] ** 2)[:, None, None] * np.eye(2)
    if len(tiny):
        flattened = _flattened(shapes)
        own = np.linalg.norm(flattened[tiny] - _of_neighbours(fits[:, :2], flattened, tiny), axis=1)
        variance = (2.0 * radius[tiny] * np.sinh(own)) ** 2 + (CHORD * fits[tiny, 17]) ** 2
        variance = np.maximum(variance - NOISY * 0.5 * (fits[tiny, 10] + fits[tiny, 12]), 0.0)
        out[tiny] = variance[:, None, None] * np.eye(2)
    return out


def _flattened(shapes: Array) -> Array:
    """Return half the logarithm of the axes' ratio (n, 2) by twice their direction: the same for all discs of a plane
    that a distant camera sees, whatever their size."""
    values, vectors = np.linalg.eigh(shapes)
    size = 0.5 * np.log(np.maximum(values[:, 1], 1e-12) / np.maximum(values[:, 0], 1e-12))
    angle = 2.0 * np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0])
    return np.asarray(size[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))


def _of_neighbours(centres: Array, flattened: Array, rows: NDArray[np.intp]) -> Array:
    """Predict what is ``flattened`` (n, 2) at some ``rows`` from their neighbours: linear in the picture, by absolute
    deviations (iterated weights), since some of them may be cut as well. Of fewer than six nothing (0) is known."""
    n = min(NEIGHBOURS, len(centres) - 1)
    if n < 6:
        return np.zeros((len(rows), 2))
    near = cKDTree(centres).query(centres[rows], n + 1)[1][:, 1:]
    away = centres[near] - centres[rows, None]
    scale = np.linalg.norm(away, axis=2).max(axis=1)[:, None, None]
    columns = np.concatenate([np.ones((len(rows), n, 1)), away / scale], axis=2)
    weight, found = np.ones((len(rows), n)), np.zeros((len(rows), 3, 2))
    for _ in range(10):
        normal = np.einsum("rni,rn,rnj->rij", columns, weight, columns) + 1e-9 * np.eye(3)
        found = np.linalg.solve(normal, np.einsum("rni,rn,rnj->rij", columns, weight, flattened[near]))
        weight = 1.0 / np.maximum(np.linalg.norm(flattened[near] - columns @ found, axis=2), 1e-3)
    return np.asarray(found[:, 0])


def _twins(centres: Array, badness: Array, radius: Array, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark the worse of two fits that went to the same spot."""
    out = np.zeros(len(centres), bool)
    rows = np.flatnonzero(keep)
    if len(rows) < 2:
        return out
    distance = np.linalg.norm(centres[rows, None] - centres[None, rows], axis=2)
    near = distance < 0.7 * np.maximum(radius[rows, None], radius[None, rows])
    worse = (badness[rows, None] > badness[None, rows]) | (
        (badness[rows, None] == badness[None, rows]) & (rows[:, None] > rows[None, :])
    )
    np.fill_diagonal(near, False)
    out[rows] = (near & worse).any(axis=1)
    return out
