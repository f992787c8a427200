"""Grey pictures and their noise."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from livedeform.common.compiled import njit
from livedeform.common.errors import InputError

Picture = NDArray[np.uint8]


def grey(pixels: NDArray[Any], encoding: str = "mono8") -> Picture:
    """Return the grey picture (h, w) uint8 of a mono8, bgr8 or rgb8 picture; ``InputError`` for others."""
    if pixels.dtype != np.uint8 or encoding not in ("mono8", "bgr8", "rgb8", "8UC1", "8UC3"):
        raise InputError(
            f"a picture of {encoding} ({pixels.dtype}) cannot be measured",
            remedy="have the camera driver publish mono8, bgr8 or rgb8",
        )
    if pixels.ndim == 2 or pixels.shape[2] == 1:
        return np.ascontiguousarray(pixels.reshape(pixels.shape[:2]))
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY if encoding == "rgb8" else cv2.COLOR_BGR2GRAY)  # type: ignore[return-value]


def noise_level(picture: Picture) -> float:
    """Estimate the standard deviation of the pixel noise, grey values: median of the Laplacian's modulus (Immerkaer
    1996, median instead of the mean, so that edges do not count) on every eighth block of rows."""
    counts = _laplacians(picture)
    # the median of |integer values| is coarse: interpolate within its bin
    share = np.cumsum(counts) / counts.sum()
    median = float(np.interp(0.5, np.concatenate([[0.0], share]), np.arange(len(share) + 1) - 0.5))
    return max(median / 0.6745 / 6.0, 0.29)  # 0.29: rounding to whole grey values


@njit(cache=True)
def _laplacians(picture):
    """Return how often (2041,) the Laplacian's modulus has each value, in six rows of every 64."""
    counts = np.zeros(2041, np.int64)
    rows, cols = picture.shape
    for first in range(0, max(rows - 8, 1), 64):
        for v in range(first + 1, min(first + 7, rows - 1)):
            above, row, below = picture[v - 1], picture[v], picture[v + 1]
            for u in range(1, cols - 1):
                corners = np.int64(above[u - 1]) + above[u + 1] + below[u - 1] + below[u + 1]
                sides = np.int64(above[u]) + below[u] + row[u - 1] + row[u + 1]
                counts[abs(corners - 2 * sides + 4 * np.int64(row[u]))] += 1
    return counts


def spread(picture: Picture) -> tuple[float, float]:
    """Return the first and the last percentile of every eighth pixel of every eighth row, grey values."""
    share = np.cumsum(np.bincount(picture[::8, ::8].ravel(), minlength=256))
    low, high = np.searchsorted(share, (0.01 * share[-1], 0.99 * share[-1]))
    return float(low), float(high)


def extremes(picture: Picture) -> tuple[float, float]:
    """Return the darkest and the lightest grey value of more than a few pixels: however small the share of the picture
    is that markers cover, and without single pixels that are stuck or noisy."""
    small = cv2.resize(cv2.medianBlur(picture, 3), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return float(small.min()), float(small.max())
