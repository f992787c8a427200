"""Middles of square tags: the picture of the whole code, which is known once it was read, fitted to the grey values.

    I(p) = Q (W P + B (1 - P)) + s^2 grad(W - B) . grad P,     W, B: planes, the light on white and black; Q: its curves
    P(p) = sum_ij c_ij f_j(X) f_i(Y),     f_j(X) = Phi((X - x_j) / (s |grad X|)) - Phi((X - x_{j+1}) / (s |grad X|))
    p = H(X, Y) + q1 X^2 + q2 X Y + q3 Y^2, (X, Y) modules from the tag's middle;     c_ij: 1 where the code is white

The last term is what a blur of s px makes of uneven light: it moves all edges towards the light. Where the edges of the
two directions are not square to each other, P has s^2 (grad X . grad Y) f' f' besides. The q are bends of a tag on a
curved body, about nothing within ``BEND``. The middle is the picture of (0, 0) under any perspective. Corners alone are
poor: each is one place, blurred, and where the tag is small its neighbours pull it.

What lies within the tag's outer edge is fitted first: nobody knows how wide the white around it is, and what is beyond.
Where the picture shows that it is wide enough, the outer edge takes part.

What is left beyond the pixels' noise (edges that were drawn in whole pixels, wear, a crease) is alike along an edge of
a module, and counts as often as there are pixels of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.stereo_node.detect.picture import Picture
from livedeform.stereo_node.detect.tags.model import beyond, blurred_code, derivatives
from livedeform.stereo_node.detect.tags.robust import fit_robustly

N_ITERATIONS, N_BLURRED = 25, 3  # at most; steps after which edges are found also from afar
SETTLED = 0.1  # sigmas, a step of the middle after which it stays where it is
LONGEST_STEP, FARTHEST = 0.3, 0.7  # modules: of the middle's step; from where the tag was found
LEAST_STEP = 8.0  # grey values between black and white
RIM = 2.5  # blurs: as near to its outer edge the border shows what is beyond
MOST_PIXELS = 1600  # of larger tags every second row and column takes part, or every third
BLURRED, LEAST_BLUR, MOST_BLUR = 0.35, 0.3, 0.8  # modules at first; px, a pixel's own; modules, when no code is read
MODEL_SIGMA = 0.003  # px, what the model itself is off by: measured on rendered tags with a noise of half a grey value
MIDDLE = [2, 5]  # the rows of the middle (x, y) in the homography's numbers
ALIKE = 1.0  # blurs beside an edge that differ alike where it is not where it should be
WHITE = 0.03  # of the contrast (rms): so evenly white is the surround that takes part
FLAT = 0.1  # of ``BEND``: so flat are the flattest
BEND = 0.02  # of a tag's side, at its sides: of 20 mm on a ball of 60 mm radius, seen from 30 degrees beside
N_SHAPE, N_LIGHT = 15, 9  # homography, blur and bends; two planes and the light's curves


def tag_middles(picture: Picture, quads: Array, codes: Array, noise: float) -> tuple[Array, Array]:
    """Measure the middles (n, 2) px of tags with corners about ``quads`` (n, 4, 2), clockwise from the code's first,
    with the modules ``codes`` (n, m, m), 1 white and 0 black with their border; and covariances (n, 2, 2) px2; NaN
    where the code does not show. ``noise``: of the pixels, grey values."""
    centres, covariances = np.full((len(quads), 2), np.nan), np.full((len(quads), 2, 2), np.nan)
    for k, (quad, code) in enumerate(zip(quads, codes, strict=True)):
        patch = _cut_out(picture, quad, code)
        found = None if patch is None else _fit(patch, noise)
        if patch is not None and found is not None:
            centres[k], covariances[k] = patch.origin + found[0], found[1] + np.eye(2) * MODEL_SIGMA**2
    return centres, covariances


@dataclass(frozen=True)
class _TagPixels:
    """The pixels about a tag: places ``at`` (k, 2) px from ``origin`` (2,), ``grey`` values (k,), the ``code``
    (m + 2, m + 2) with the white around, ``half`` its side in modules, the homography's numbers ``start`` (8,) by which
    it was found, and the size of a ``module`` px."""

    at: Array
    grey: Array
    code: Array
    half: float
    origin: Array
    start: Array
    module: float


@dataclass(frozen=True)
class _BlurredCode:
    """The blurred code at pixels (k,): places ``at`` (k, 2) px from the patch's origin, ``grey`` values, and what
    `blurred_code` ``told`` (7, k) of them."""

    at: Array
    grey: Array
    told: Array

    def derivatives(self, light: Array, s: float) -> Array:
        """Return the derivatives (k, 24) of the greys by shape and light, in a ``light`` (9,), with a blur of ``s``
        px."""
        J = np.empty((len(self.at), N_SHAPE + N_LIGHT))
        derivatives(self.at, self.told, light, s, J)
        return J


def _cut_out(picture: Picture, quad: Array, code: Array) -> _TagPixels | None:
    """Cut out the pixels about ``quad`` (4, 2) px; None where it has no perspective."""
    origin, half = np.round(quad.mean(axis=0)), 0.5 * len(code)
    square = np.array([[-half, -half], [half, -half], [half, half], [-half, half]], np.float32)
    H = cv2.getPerspectiveTransform(square, (quad - origin).astype(np.float32))
    x, y = quad.T
    module = float(np.sqrt(0.5 * abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)))) / len(code)
    if not np.isfinite(H).all():
        return None
    low = np.maximum(np.floor(quad.min(axis=0) - module), 0).astype(int)
    high = np.minimum(np.ceil(quad.max(axis=0) + module) + 1, picture.shape[::-1]).astype(int)
    step = int(np.ceil(np.sqrt((high - low).prod() / MOST_PIXELS)))
    v, u = np.mgrid[low[1] : high[1] : step, low[0] : high[0] : step].reshape(2, -1)
    at = np.stack([u, v], axis=1) - origin
    start, around = np.asarray(H.ravel()[:8], float), np.ones((len(code) + 2, len(code) + 2))
    around[1:-1, 1:-1] = code
    return _TagPixels(at, picture[v, u].astype(float), around, half, origin, start, module)


@dataclass(frozen=True)
class _Tag:
    """Hold what is fitted: ``shape`` (15,) and ``light`` (9,); with the ``middle_covariance`` (2, 2) px2 and the
    residuals' ``variance``; ``bent``: px per square module, the spread of the bends."""

    shape: Array
    light: Array
    middle_covariance: Array
    variance: float
    bent: float


def _fit(patch: _TagPixels, noise: float) -> tuple[Array, Array] | None:
    """Return the middle (2,) px from the patch's origin and its covariance (2, 2) px2; None where no tag shows."""
    shape = np.concatenate([patch.start, [max(BLURRED * patch.module, LEAST_BLUR)], np.zeros(6)])
    start = _Tag(shape, np.zeros(N_LIGHT), np.zeros((2, 2)), 0.0, 2 * BEND * patch.module / patch.half)
    pattern = _pattern(patch, shape, _within(patch, shape, 0.0))
    planes = pattern.derivatives(start.light, 0.0)[:, N_SHAPE:-3]
    start.light[:-3] = np.linalg.lstsq(planes, pattern.grey, rcond=None)[0]
    tag = _descend(patch, start, -RIM, start.bent)
    if tag is None:
        return None
    whole = _descend(patch, tag, RIM, start.bent)
    tag = whole if whole is not None and _white_around(patch, whole) else tag
    alike = 1 + ALIKE * tag.shape[8] * patch.module * max(1 - noise**2 / tag.variance, 0.0)
    return tag.shape[MIDDLE], alike * tag.middle_covariance


def _descend(patch: _TagPixels, tag: _Tag, reach: float, most_bent: float) -> _Tag | None:
    """Go by Gauss-Newton steps, each with the light (linear) solved anew, with pixels as far as ``reach`` blurs beyond
    the outer edge; None where it runs away, or shows no step from black to white."""
    used, bent, least = np.zeros(0, bool), most_bent, N_BLURRED if reach < 0 else 1
    for iteration in range(N_ITERATIONS):
        if iteration <= least:  # then the same, so that steps become small
            used = _within(patch, tag.shape, reach)
        pattern = _pattern(patch, tag.shape, used)
        if len(pattern.grey) < 2 * (N_SHAPE + N_LIGHT):
            return None
        tight = np.zeros(N_SHAPE + N_LIGHT)
        tight[9:N_SHAPE] = bent**-2
        J, C = pattern.derivatives(tag.light, tag.shape[8]), np.empty((len(tight), len(tight)))
        x = -np.append(tag.shape, tag.light)  # what is known
        variance = fit_robustly(J, pattern.grey, tight, x, C)
        if not np.isfinite(x).all():
            return None
        move = float(np.abs(x[MIDDLE]).max())
        shape = tag.shape + min(1.0, LONGEST_STEP * patch.module / max(move, 1e-12)) * x[:N_SHAPE]
        shape[8] = np.clip(shape[8], LEAST_BLUR, MOST_BLUR * patch.module)
        told = 6 - float(np.trace(C[9:N_SHAPE, 9:N_SHAPE])) / bent**2  # of six numbers
        if iteration:
            bent = float(np.clip(np.sqrt(shape[9:] @ shape[9:] / max(told, 1e-3)), FLAT * most_bent, most_bent))
        tag = _Tag(shape, x[N_SHAPE:], C[np.ix_(MIDDLE, MIDDLE)], variance, bent)
        if move < SETTLED * np.sqrt(C[MIDDLE, MIDDLE].sum()) and iteration >= least:
            apart = float(np.abs((shape[:8] - patch.start)[MIDDLE]).max())
            return tag if tag.light[0] - tag.light[3] >= LEAST_STEP and apart < FARTHEST * patch.module else None
    return None


def _white_around(patch: _TagPixels, tag: _Tag) -> bool:
    """Tell whether what is beyond the outer edge is as white as the light on the tag says."""
    pattern = _pattern(patch, tag.shape, _within(patch, tag.shape, RIM))
    beyond = np.abs(pattern.told[4:6]).max(axis=0) > patch.half
    r = (pattern.grey - pattern.derivatives(tag.light, tag.shape[8])[:, N_SHAPE:] @ tag.light)[beyond]
    limit = np.hypot(WHITE * (tag.light[0] - tag.light[3]), np.sqrt(2 * tag.variance))
    return bool(len(r) and np.sqrt((r**2).mean()) < limit)


def _within(patch: _TagPixels, shape: Array, reach: float) -> NDArray[np.bool_]:
    """Tell which pixels (k,) lie as far as ``reach`` blurs beyond the tag's outer edge, or farther in."""
    out = np.empty(len(patch.at))
    beyond(patch.at, shape, _inverse(shape), patch.half, out)
    told: NDArray[np.bool_] = out < reach
    return told


def _pattern(patch: _TagPixels, shape: Array, used: NDArray[np.bool_]) -> _BlurredCode:
    """Return the blurred code at the pixels that are ``used`` (k,)."""
    at = patch.at[used]
    out = np.empty((7, len(at)))
    blurred_code(at, shape, _inverse(shape), patch.code, out)
    return _BlurredCode(at, patch.grey[used], out)


def _inverse(shape: Array) -> Array:
    """Return the inverse (3, 3) of the homography's matrix."""
    return np.linalg.inv(np.append(shape[:8], 1.0).reshape(3, 3))
