"""Candidates for markers: spots that stand out from what is around them, at several thresholds."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.stereo_node.detect.picture import Picture
from livedeform.stereo_node.detect.settings import DetectorSettings


def find_candidates(picture: Picture, settings: DetectorSettings) -> tuple[Array, Array, Array, Array]:
    """Find connected spots that stand out from the local mean: centres (n, 2), half axes (n, 2), background, contrast
    (n,).

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
    """Leave out spots whose place an earlier one that counts has taken (a dark spot on a light plate is another)."""
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


@njit(cache=True, fastmath=True, error_model="numpy")
def surrounded(picture, centres, axes, least):
    """Tell (n,) whether the spots (half axes (n, 2) px) differ from most of a ring around them, all in the same sense.

    A saddle between markers, a streak or an edge does not; the fit need not look at it.
    """
    n = centres.shape[0]
    out = np.zeros(n, np.bool_)
    rows, cols = picture.shape
    for k in range(n):
        x = int(np.rint(centres[k, 0]))
        y = int(np.rint(centres[k, 1]))
        if x < 1 or y < 1 or x >= cols - 1 or y >= rows - 1:
            continue
        middle = 0.0
        for v in range(y - 1, y + 2):
            for u in range(x - 1, x + 2):
                middle += picture[v, u] / 9.0
        lighter = 0
        darker = 0
        count = 0
        for a in range(16):
            angle = 2.0 * math.pi * a / 16.0
            u = int(np.rint(centres[k, 0] + (1.4 * axes[k, 0] + 1.5) * math.cos(angle)))
            v = int(np.rint(centres[k, 1] + (1.4 * axes[k, 1] + 1.5) * math.sin(angle)))
            if 0 <= u < cols and 0 <= v < rows:
                count += 1
                if picture[v, u] > middle + least:
                    lighter += 1
                elif picture[v, u] < middle - least:
                    darker += 1
        out[k] = max(lighter, darker) >= 0.6 * count and count >= 10
    return out
