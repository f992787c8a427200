"""Dark and light round markers in one picture, with sub-pixel centres and their covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.stereo_node.detect.blob_fit import fit_blobs, start_parameters, surrounded
from livedeform.stereo_node.detect.moments import ink_moments
from livedeform.stereo_node.detect.picture import Picture, grey, noise_level

__all__ = ["Blobs", "DetectorSettings", "Picture", "detect_blobs", "find_candidates", "grey", "noise_level"]


MARGIN_PX = (
    4.0  # around the outline; with 3 px the background's slope is less sure and the centre 10 % worse, 5 px cost time
)


@dataclass(frozen=True)
class DetectorSettings:
    """How markers look. Lengths in pixels, grey values in 0..255."""

    type: str = "blob"  # blob | circle_grid | checkerboard | aruco | apriltag
    polarity: str = "both"  # dark | light | both: the markers against what is around them
    min_radius: float = 2.0
    max_radius: float = 20.0
    min_contrast: float = 12.0
    max_aspect: float = 4.0  # long over short axis: a disc seen 75 degrees from its normal has 3.9
    min_rim: float = 0.6  # share of the rim that must be seen
    max_misfit: float = 0.12  # residual of the fit over its contrast, beyond the noise
    min_signal: float = 5.0  # contrast over residual
    max_sigma: float = 0.5  # px, of the centre
    marker: str = "painted"  # painted: a disc that follows the body's curvature | flat: a stiff one | ball
    centre: str = "fit"  # fit: blurred ellipses | moments: the centroid, for markers of another outline
    levels: int = 3  # thresholds at which spots are looked for: on a textured ground a low one joins marker and texture
    surroundings: tuple[float, ...] = (3.0, 1.0)  # half widths, in max_radius, of what a spot must stand out from: the
    # wide one bears uneven shapes of ground, the narrow one finds a marker on a small bright plate before a black wall
    most: int = 0  # candidates that are measured, the most prominent first; 0: all
    search_step: int = 1  # 2: spots are looked for in the picture at half size (and measured at full size)
    dictionary: str = ""  # of aruco and apriltag
    board: str = ""  # of circle_grid and checkerboard, as 9x6

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> DetectorSettings:
        """From ``stereo.detector`` of an experiment; unknown keys and impossible values are an ``InputError``."""
        known = {field.name: field.default for field in fields(cls)}
        read: dict[str, Any] = {}
        for key, value in values.items():
            if key not in known:
                raise InputError(
                    f"unknown key '{key}'", where="stereo.detector", remedy=f"use one of {', '.join(sorted(known))}"
                )
            read[key] = _checked(key, value, known[key])
        settings = cls(**read)
        if settings.min_radius >= settings.max_radius:
            raise InputError(
                f"min_radius {settings.min_radius:g} is not below max_radius {settings.max_radius:g}",
                where="stereo.detector",
                remedy="give the smallest and the largest radius of a marker's picture, px",
            )
        return settings


CHOICES = {
    "type": ("blob", "circle_grid", "checkerboard", "aruco", "apriltag"),
    "polarity": ("dark", "light", "both"),
    "marker": ("painted", "flat", "ball"),
    "centre": ("fit", "moments"),
}


def _checked(key: str, value: Any, default: Any) -> Any:
    """A setting of the type of its default, or ``InputError``."""
    where = f"stereo.detector.{key}"
    if key in CHOICES and value not in CHOICES[key]:
        raise InputError(f"'{value}' is unknown", where=where, remedy=f"use one of {', '.join(CHOICES[key])}")
    if isinstance(default, str):
        return str(value)
    wanted = value if isinstance(default, tuple) else [value]
    whole = isinstance(default, int)
    if not isinstance(wanted, list | tuple) or not wanted or not all(_is_number(v, whole) for v in wanted):
        kind = "a list of numbers" if isinstance(default, tuple) else "a whole number" if whole else "a number"
        raise InputError(f"{value!r} is not {kind} of 0 or more", where=where, remedy=f"the default is {default}")
    return tuple(float(v) for v in wanted) if isinstance(default, tuple) else int(value) if whole else float(value)


def _is_number(value: Any, whole: bool) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return bool(np.isfinite(value) and value >= 0 and not (whole and value != int(value)))


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
    n_candidates: int = 0
    rejected: Mapping[str, int] | None = None
    codes: NDArray[np.int64] | None = None  # identities that were read from the picture, -1 for none

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def radii(self) -> Array:
        """(n,) px: radius of the circle of the same area."""
        return 1 / np.sqrt(np.maximum(np.linalg.det(self.shapes), 1e-12))

    def take(self, rows: NDArray[Any]) -> Blobs:
        """The blobs of these rows."""
        arrays = ("centres", "covariances", "shapes", "contrasts", "blur_px", "residuals")
        taken = {name: getattr(self, name)[rows] for name in arrays}
        for name in ("codes", "skewness_px"):
            whole = getattr(self, name)
            taken[name] = None if whole is None else whole[rows]
        return replace(self, **taken)


def find_candidates(picture: Picture, settings: DetectorSettings) -> tuple[Array, Array, Array, Array]:
    """Connected spots that stand out from the local mean: centres (n, 2), half axes (n, 2), background, contrast (n,).

    With ``search_step`` 2 it works on the picture at half size: the fit looks at the full picture later.
    """
    step = settings.search_step
    small = cv2.resize(picture, None, fx=1 / step, fy=1 / step, interpolation=cv2.INTER_AREA) if step > 1 else picture
    wide = small
    if step == 1:
        small = cv2.GaussianBlur(small, (3, 3), 0)
    found = []
    for width in settings.surroundings:
        block = 2 * int(np.ceil(width * settings.max_radius / step)) + 1
        mean = cv2.boxFilter(wide, -1, (block, block), borderType=cv2.BORDER_REFLECT_101)
        for sign, name in ((-1, "dark"), (1, "light")):
            if settings.polarity not in (name, "both"):
                continue
            difference: Any = cv2.subtract(mean, small) if sign < 0 else cv2.subtract(small, mean)
            for level in range(settings.levels):
                threshold = max(settings.min_contrast / 2, 3.0) * 3.0**level
                if threshold < 128:
                    found.append((threshold, _components(difference, small, mean, sign, step, threshold, settings)))
    # the highest threshold separates best: its spots go first, and lower ones at the same place are left out
    parts = [part for _, part in sorted(found, key=lambda f: -f[0])]
    centres, axes, background, contrast = (np.concatenate(part) for part in zip(*parts, strict=True))
    keep = surrounded(picture, centres, axes, 0.5 * settings.min_contrast)
    if settings.levels * len(settings.surroundings) > 1:
        keep &= _first_at_place(centres, axes.mean(axis=1), np.sign(contrast), keep)
    rows = np.flatnonzero(keep)
    if settings.most and len(rows) > settings.most:
        rows = rows[np.sort(np.argsort(-np.abs(contrast[rows]))[: settings.most])]
    return centres[rows], axes[rows], background[rows], contrast[rows]


def _first_at_place(centres: Array, radii: Array, signs: Array, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Leaves out spots whose place an earlier one that counts has taken (a dark spot on a light plate is another)."""
    out = np.ones(len(centres), bool)
    if not len(centres):
        return out
    for i, j in cKDTree(centres).query_pairs(float(radii.max())):  # i < j
        if keep[i] and signs[i] == signs[j] and np.hypot(*(centres[i] - centres[j])) < max(radii[i], 2.0):
            out[j] = False
    return out


def _components(
    difference: Picture, small: NDArray[Any], mean: NDArray[Any], sign: int, step: int, threshold: float,
    settings: DetectorSettings,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    _, mask = cv2.threshold(difference, threshold, 255, cv2.THRESH_BINARY)
    _, _, stats, centroids = cv2.connectedComponentsWithStats(mask, connectivity=4, ltype=cv2.CV_32S)
    stats, centroids = stats[1:], centroids[1:]
    left, top, width, height, area = (stats[:, i].astype(float) for i in range(5))
    equivalent = step * np.sqrt(area / np.pi)
    aspect = np.maximum(width, height) / np.maximum(np.minimum(width, height), 1)
    rows, cols = small.shape[:2]
    good = (
        (equivalent > 0.6 * settings.min_radius)
        & (equivalent < 1.3 * settings.max_radius)
        & (aspect < settings.max_aspect)
        & (area / (width * height) > 0.4)
        & (left > 0)
        & (top > 0)
        & (left + width < cols)
        & (top + height < rows)
    )
    centroids, width, height = centroids[good], width[good], height[good]
    at = np.round(centroids).astype(int).T[::-1]
    background = mean[tuple(at)].astype(float)
    contrast = sign * difference[tuple(at)].astype(float)
    # the middle of a pixel of the half picture lies half a pixel away from the middle of the full one's
    centres = (centroids + 0.5) * step - 0.5
    return centres, step * np.stack([width, height], axis=1) / 2, background, contrast


def detect_blobs(picture: Picture, settings: DetectorSettings, noise: float | None = None) -> Blobs:
    """All round markers of a grey picture (h, w)."""
    centres, axes, background, contrast = find_candidates(picture, settings)
    return fit_candidates(picture, start_parameters(centres, axes, background, contrast), settings, noise)


def fit_candidates(picture: Picture, start: Array, settings: DetectorSettings, noise: float | None = None) -> Blobs:
    """Fits the candidates ``start`` (n, 10) of ``blob_fit`` and keeps those that look like a marker."""
    noise = noise_level(picture) if noise is None else noise
    if settings.centre == "moments":
        fit = ink_moments(picture, start, noise)
    else:
        fit = fit_blobs(picture, start, MARGIN_PX, 0.5 * noise, 25)
    shapes = fit[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    axes = 1 / np.maximum(np.linalg.eigvalsh(shapes), 1e-6) if len(fit) else np.zeros((0, 2))
    radius = np.sqrt(axes[:, 0] * axes[:, 1])
    size, residual = np.abs(fit[:, 9]), fit[:, 13]
    excess = np.sqrt(np.maximum(residual**2 - noise**2, 0))
    dark = fit[:, 9] < 0
    tests = {
        "fit did not converge": fit[:, 15] > 0,
        "radius": (radius >= settings.min_radius) & (radius <= settings.max_radius),
        "polarity": (settings.polarity == "both") | (dark if settings.polarity == "dark" else ~dark),
        "contrast": (size >= settings.min_contrast) & (size >= settings.min_signal * residual),
        # a fit whose contrast is far beyond what the picture shows there has traded it for blur
        "contrast is not there": size <= 2.0 * np.abs(start[:, 9]) + settings.min_contrast,
        "aspect": axes[:, 0] <= settings.max_aspect * axes[:, 1],
        "shape": excess <= settings.max_misfit * size,
        "rim hidden": fit[:, 14] >= settings.min_rim,
        "blurred away": fit[:, 5] < np.maximum(radius, 1.0),
        "uncertain centre": (fit[:, 10] + fit[:, 12] < 2 * settings.max_sigma**2) & (fit[:, 10] > 0) & (fit[:, 12] > 0),
    }
    keep = np.ones(len(fit), bool)
    rejected: dict[str, int] = {}
    for reason, passed in tests.items():
        lost = int((keep & ~passed).sum())
        if lost:
            rejected[reason] = lost
        keep &= passed
    keep &= ~_twins(fit[:, :2], residual / np.maximum(size, 1e-9), radius, keep)
    return Blobs(
        centres=fit[keep, :2],
        covariances=fit[keep][:, [10, 11, 11, 12]].reshape(-1, 2, 2),
        shapes=shapes[keep],
        contrasts=fit[keep, 9],
        blur_px=fit[keep, 5],
        residuals=residual[keep],
        skewness_px=fit[keep, 17],
        n_candidates=len(start),
        rejected=rejected,
    )


def _twins(centres: Array, badness: Array, radius: Array, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Marks the worse of two fits that went to the same spot."""
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
