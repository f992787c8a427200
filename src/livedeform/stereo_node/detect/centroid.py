"""Centres of flat markers of any outline (squares, stars, worn discs): the centroid of the share of ink in every pixel.

Where the outline is an ellipse the fit of ``blob_fit`` is better; where it is not, the fit is wrong and this is right.

Of an outline that nobody knows, what covers a part of it shows by one thing alone: discs, squares and stars are as
before when turned by half a turn about their middles, and what is left of them is not. By how much their ink differs
from itself turned so, tells how far the middle may be from where it was: it is in the covariance, and what is half
covered is refused as uncertain. (What is left of a square that is cut along its side is a rectangle: that does not
show.)
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.stereo_node.detect.blob_fit import N_RESULTS
from livedeform.stereo_node.detect.picture import Picture

MARGIN = 4  # px around the spot
# of the middle, in radii, by the share of the ink that differs when turned, and by its square: of discs that are cut
# off along a chord it moves by 0.018 for a share of 0.025, 0.086 for 0.075, 0.43 for 0.179
SHIFT, STEEPER = 0.5, 9.0


def ink_moments(picture: Picture, start: Array, noise: float) -> Array:
    """Measure centres and shapes of the spots ``start`` (n, 10) of ``blob_fit``, in the columns of its results (n,
    N_RESULTS).

    share s = (I - background) / contrast, 1 well inside (wear and reflexions there do not count), 0 well outside; the
    centre is sum(s x) / sum(s), the shape that of the ellipse with the same second moments, the covariance the pixel
    noise's.
    """
    out = np.zeros((len(start), N_RESULTS))
    for k, row in enumerate(start):
        out[k] = _one(picture, row, noise)
    return out


def _one(picture: Picture, start: Array, noise: float) -> Array:
    """Measure the spot ``start`` (10,): a row (N_RESULTS,), all zero beside the start where it shows no marker."""
    out = np.zeros(N_RESULTS)
    out[:10] = start
    half = np.ceil(1.3 / np.maximum([start[2], start[4]], 1e-3)).astype(int) + MARGIN + 2
    x0, y0 = np.round(start[:2]).astype(int) - half
    x1, y1 = np.round(start[:2]).astype(int) + half + 1
    if x0 < 0 or y0 < 0 or x1 > picture.shape[1] or y1 > picture.shape[0]:
        return out
    patch = picture[y0:y1, x0:x1].astype(float)
    sign = np.sign(start[9]) or -1.0
    core = _core(patch, half, start[6], sign)
    if core.sum() < 6 or core[0].any() or core[-1].any() or core[:, 0].any() or core[:, -1].any():
        return out
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * MARGIN - 3, 2 * MARGIN - 3))
    near = cv2.dilate(core, kernel).astype(bool)
    deep = cv2.erode(core, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))).astype(bool)
    v, u = np.mgrid[0 : patch.shape[0], 0 : patch.shape[1]].astype(float)
    plane = _background(patch, ~near, u - half[0], v - half[1], noise)
    background = plane[0] + plane[1] * (u - half[0]) + plane[2] * (v - half[1])
    contrast = float(np.median((patch - background)[deep if deep.any() else core.astype(bool)]))
    if contrast * sign <= 0:
        return out
    share = np.where(near, np.clip((patch - background) / contrast, -0.2, 1.2), 0.0)
    share[deep] = 1.0
    total = share.sum()
    cx, cy = (share * u).sum() / total, (share * v).sum() / total
    M = _shape(share, u - cx, v - cy)
    if M is None:
        return out
    edge = near & ~deep
    du, dv = (u - cx)[edge], (v - cy)[edge]
    gain = (noise / (contrast * total)) ** 2
    out[:10] = [cx + x0, cy + y0, M[0, 0], M[0, 1], M[1, 1], 1.0, plane[0], plane[1], plane[2], contrast]
    out[10:13] = gain * (du**2).sum(), gain * (du * dv).sum(), gain * (dv**2).sum()
    shifted = _shifted(share, (cx, cy), noise / abs(contrast) * edge.sum() / total) / np.sqrt(np.linalg.det(M))
    out[10] += shifted**2
    out[12] += shifted**2
    out[13:17] = max(noise, 1e-3), 1.0, 1.0, near.sum()
    return out


def _core(patch: Array, half: NDArray[np.int64], background: float, sign: float) -> Picture:
    """Return the pixels (h, w) that are more ink than ground, of the spot in the middle, without holes."""
    inside = patch[half[1] - 1 : half[1] + 2, half[0] - 1 : half[0] + 2].mean()
    level = 0.5 * (inside + background)
    core = ((patch - level) * sign > 0).astype(np.uint8)
    _, labels = cv2.connectedComponents(core, connectivity=4)
    label = labels[half[1], half[0]]
    return _filled((labels == label).astype(np.uint8) if label else np.zeros_like(core))


def _background(patch: Array, ring: NDArray[np.bool_], du: Array, dv: Array, noise: float) -> Array:
    """Fit the ground's grey and slopes (3,) to the pixels of ``ring``; what is not ground is taken out."""
    A = np.stack([np.ones(ring.sum()), du[ring], dv[ring]], axis=1)
    plane = np.linalg.lstsq(A, patch[ring], rcond=None)[0]
    for _ in range(2):  # a neighbour, a scratch
        r = patch[ring] - A @ plane
        good = np.abs(r) < 2.5 * max(np.median(np.abs(r)) * 1.48, noise)
        plane = np.linalg.lstsq(A[good], patch[ring][good], rcond=None)[0]
    return np.asarray(plane, float)


def _shifted(share: Array, middle: tuple[float, float], noise: float) -> float:
    """Return how far (in radii) the ``middle`` (x, y) of a ``share`` (h, w) of ink may be off, as the ink differs from
    itself turned by half a turn about it by more than ``noise``, its standard deviation in all."""
    v, u = np.mgrid[0 : share.shape[0], 0 : share.shape[1]]
    x, y = (2 * middle[0] - u).astype(np.float32), (2 * middle[1] - v).astype(np.float32)
    turned = cv2.remap(share.astype(np.float32), x, y, cv2.INTER_CUBIC)
    differs = 0.5 * float(np.abs(share - turned).sum() / share.sum())
    by_noise = noise / np.sqrt(np.pi)  # the mean modulus of half the difference of two
    more = np.sqrt(max(differs**2 - 0.5 * by_noise**2, 0.0))  # which may have hidden some of it
    return float(SHIFT * more + STEEPER * more**2)


def _shape(share: Array, du: Array, dv: Array) -> Array | None:
    """Return M (2, 2) of the ellipse with the second moments of ``share``; None where there is no area."""
    off = (share * du * dv).sum()
    S = np.array([[(share * du * du).sum(), off], [off, (share * dv * dv).sum()]]) / share.sum()
    values, axes = np.linalg.eigh(4 * S - np.eye(2) / 3)  # minus the pixels' own second moment
    if values[0] <= 0.1:
        return None
    M: Array = axes @ np.diag(values**-0.5) @ axes.T
    return M


def _filled(mask: Picture) -> Picture:
    """Return the mask without holes."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros_like(mask), contours, -1, 1, cv2.FILLED)  # type: ignore[return-value]
