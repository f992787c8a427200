"""Grey pictures and their noise."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from livedeform_common.errors import InputError

Picture = NDArray[np.uint8]


def grey(pixels: NDArray[Any], encoding: str = "mono8") -> Picture:
    """(h, w) uint8 of a mono8, bgr8 or rgb8 picture; ``InputError`` for others."""
    if pixels.dtype != np.uint8 or encoding not in ("mono8", "bgr8", "rgb8", "8UC1", "8UC3"):
        raise InputError(
            f"a picture of {encoding} ({pixels.dtype}) cannot be measured",
            remedy="have the camera driver publish mono8, bgr8 or rgb8",
        )
    if pixels.ndim == 2 or pixels.shape[2] == 1:
        return np.ascontiguousarray(pixels.reshape(pixels.shape[:2]))
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY if encoding == "rgb8" else cv2.COLOR_BGR2GRAY)  # type: ignore[return-value]


def noise_level(picture: Picture) -> float:
    """Standard deviation of the pixel noise, grey values: median of the Laplacian's modulus (Immerkaer 1996, median
    instead of the mean, so that edges do not count) on every eighth block of rows."""
    strip = np.concatenate([picture[r : r + 8] for r in range(0, max(picture.shape[0] - 8, 1), 64)]).astype(np.int16)
    a = strip[:-2] + strip[2:]
    laplacian = (a[:, :-2] + a[:, 2:]) - 2 * (a[:, 1:-1] + strip[1:-1, :-2] + strip[1:-1, 2:]) + 4 * strip[1:-1, 1:-1]
    # the median of |integer values| is coarse: interpolate within its bin
    counts = np.bincount(np.abs(laplacian).ravel())
    share = np.cumsum(counts) / laplacian.size
    median = float(np.interp(0.5, np.concatenate([[0.0], share]), np.arange(len(share) + 1) - 0.5))
    return max(median / 0.6745 / 6.0, 0.29)  # 0.29: rounding to whole grey values
