"""Sub-pixel centres: the picture of a round marker (`blob_model`) fitted to the grey values around a spot.

Ten parameters: centre (2), M (3), s, b, g (2), c. Levenberg-Marquardt with weights that fall off beyond four residual
sigmas, so that a specular spot or an occluded rim pulls little. The covariance of the centre is the marginal of
s_r^2 (J^T W J + prior)^-1, s_r the robust residual (Shortis et al. 1994 compare centroids with such fits).


An outline that is no ellipse (egg-shaped, where the body stretches one end of a disc more than the other) shows by the
third harmonic of what the rim leaves: the *skewness*, as far as it is more than noise. The same stretching displaces
the middle by about three times as much, which no outline shows.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.stereo_node.detect.blob_model import (
    N_PARAMETERS,
    N_SECTORS,
    N_WORK,
    PROFILE,
    choose_pixels,
    derivatives,
    more_derivatives,
    normal_equations,
    profile,
    residuals,
)
from livedeform.stereo_node.detect.cuts import SHORT, add_untold, find_cut, rim_off, unevenness
from livedeform.stereo_node.detect.occlusion import MOST_HIDDEN, find_hidden
from livedeform.stereo_node.detect.small_linear import copy_part, solve_spd

N_RESULTS = N_PARAMETERS + 8
"""Columns of a fit: x, y, m11, m12, m22, blur, background, gx, gy, contrast, var_x, cov_xy, var_y, residual sigma,
share of the rim that was seen, ok (1) or the reason why not (0 no convergence, -1 left its window), number of
pixels, skewness px."""
FREE_SLOPE = 0.5  # share of the slope's part that the ink takes away which may not be so
SKEW_NOISE = 6.0  # variances: noise alone has one (two degrees of freedom), and more than this once in 400 times
LEAST_SLOPE = 2e-4  # of the contrast per pixel: the same where there is no slope


def fit_blobs(picture: NDArray[np.uint8], start: Array, margin_px: float, noise: float, max_iterations: int) -> Array:
    """Fit every row of ``start`` (n, 10) in ``picture`` (h, w); returns (n, N_RESULTS).

    ``margin_px``: how far around the outline pixels take part; ``noise``: the least residual sigma, grey values.
    """
    rows = np.ascontiguousarray(start, float)
    return np.asarray(_fit_blobs(picture, rows, margin_px, noise, max_iterations, PROFILE), float)


def start_parameters(centres: Array, radii: Array, background: Array, contrast: Array, blur: float = 0.8) -> Array:
    """Return rows (n, 10) to start ``fit_blobs`` from circles: ``centres`` (n, 2), ``radii`` (n,) or half axes (n, 2),
    px."""
    start = np.zeros((len(centres), N_PARAMETERS))
    axes = np.broadcast_to(radii[:, None], (len(centres), 2)) if radii.ndim == 1 else radii
    start[:, :2] = centres
    start[:, 2], start[:, 4] = 1 / axes[:, 0], 1 / axes[:, 1]
    start[:, 5] = blur
    start[:, 6], start[:, 9] = background, contrast
    return start


@njit(cache=True, fastmath=True, error_model="numpy")
def _fit_blobs(picture, start, margin_px, noise_floor, max_iterations, table):
    n_blobs = start.shape[0]
    out, fits = np.zeros((n_blobs, N_RESULTS)), start.copy()
    hidden = np.zeros((n_blobs, N_SECTORS), np.bool_)
    off, sigma = np.zeros((n_blobs, N_SECTORS)), np.zeros((n_blobs, N_SECTORS))
    sums, extra, work = np.empty((4, N_SECTORS)), np.empty(3), np.empty((N_WORK, 0))
    for b in range(n_blobs):
        work = _fit_blob(
            picture, fits[b], start[b], margin_px, noise_floor, max_iterations, table, hidden[b], off[b], sigma[b],
            out[b], sums, work,
        )  # fmt: skip
    uneven, third = unevenness(off, sigma, out, hidden)
    for b in range(n_blobs):
        p, before = fits[b], fits[b].copy()
        radius = 1.0 / math.sqrt(p[2] * p[4] - p[3] * p[3])
        skewed = out[b, 17] / radius if radius < SHORT else 0.0
        while out[b, 15] > 0.0:  # each time more is hidden
            radius = 1.0 / math.sqrt(p[2] * p[4] - p[3] * p[3])
            if find_cut(off[b], sigma[b], radius, uneven, third, hidden[b], extra) == 0:
                out[b, 17] = max(out[b, 17], skewed * radius)
                add_untold(before, p, extra, out[b])
                break
            if hidden[b].sum() > MOST_HIDDEN:
                out[b, 14] = 0.0
                break
            work = _fit_blob(
                picture, p, start[b], margin_px, noise_floor, max_iterations, table, hidden[b], off[b], sigma[b],
                out[b], sums, work,
            )  # fmt: skip
    return out


@njit(cache=True, fastmath=True, error_model="numpy")
def _fit_blob(
    picture, p, start, margin_px, noise_floor, max_iterations, table, hidden, off, sigma, out, sums, work
):  # fmt: skip
    """Fit ``p`` (10,), which it moves, to what is not ``hidden`` (N_SECTORS,) and does not show to be.

    Writes a row ``out`` (N_RESULTS,), and how far the rim is ``off`` by sector (N_SECTORS,) px, with its noise
    ``sigma``; returns ``work``.
    """
    for _ in range(5):
        p[7] = 0.0
        p[8] = 0.0
        status, scale, n, chosen, work = _descend(
            picture, p, start, margin_px, noise_floor, max_iterations, table, hidden, work
        )
        if status <= 0.0:
            break
        if find_hidden(picture, p, hidden, noise_floor, sums) == 0:
            break
        if hidden.sum() > MOST_HIDDEN:
            break
    rim_off(n, p, chosen, table, work, 2.0 * noise_floor, off, sigma)
    out[:] = 0.0
    _finish(p.copy(), status, noise_floor, scale, n, chosen, table, hidden, work, out)
    return work


@njit(cache=True, fastmath=True, error_model="numpy")
def _descend(picture, p, start, margin_px, noise_floor, max_iterations, table, hidden, work):
    """Descend by Levenberg-Marquardt from ``p`` (10,), which it moves.

    Returns whether it converged (1, else 0), the robust scale, the pixels' number, what they are placed relative to,
    and ``work``.
    """
    H, g, A, step, trial = np.empty((10, 10)), np.empty(10), np.empty((10, 10)), np.empty(10), np.empty(10)
    radius = math.sqrt(1.0 / (p[2] * p[4] - p[3] * p[3]))
    limit = max(2.0, 0.7 * radius)
    chosen = p.copy()
    n, work = choose_pixels(picture, chosen, max(margin_px, 0.5 * radius), hidden, work)
    scale, damping = 0.0, 1e-3
    profile(n, p, chosen, table, work)
    cost, weight, _, _ = residuals(n, p, scale, work)
    for iteration in range(max_iterations):
        if iteration == 2 or iteration == 5:  # weights only after the shape is roughly right
            # the pixels that take part are chosen anew: the start's outline may be far too small for the blur
            for i in range(2, 5):
                chosen[i] = p[i]
            radius = math.sqrt(1.0 / (p[2] * p[4] - p[3] * p[3]))
            n, work = choose_pixels(picture, chosen, max(margin_px, 0.5 * radius, 3.0 * p[5]), hidden, work)
            scale = 4.0 * max(noise_floor, math.sqrt(cost / max(weight - 10.0, 1.0)))
            profile(n, p, chosen, table, work)
            cost, weight, _, _ = residuals(n, p, scale, work)
        derivatives(n, p, chosen, work)
        normal_equations(n, work, H, g)
        accepted = False
        for _ in range(10):
            copy_part(H, A)
            for i in range(10):
                A[i, i] = H[i, i] * (1.0 + damping) + 1e-12
            if solve_spd(A, g, step):
                for i in range(10):
                    trial[i] = p[i] + step[i]
                if _plausible(trial, start, limit):
                    profile(n, trial, chosen, table, work)
                    new_cost, new_weight, _, _ = residuals(n, trial, scale, work)
                    # reweighting changes the cost's meaning: compare mean squares
                    if new_cost / max(new_weight, 1.0) <= cost / max(weight, 1.0) * (1.0 + 1e-9):
                        accepted = True
                        break
            damping = damping * 10.0 + 1e-3
        if not accepted:
            return (1.0 if iteration >= 2 else 0.0), scale, n, chosen, work
        for i in range(10):
            p[i] = trial[i]
        cost, weight = new_cost, new_weight
        damping = max(damping * 0.1, 1e-9)
        centre_stands = abs(step[0]) < 2e-3 and abs(step[1]) < 2e-3  # the next step would be far smaller
        rim_stands = abs(step[5]) < 0.03 * p[5] and abs(step[9]) < 0.01 * abs(p[9])
        if iteration >= 2 and centre_stands and rim_stands:
            return 1.0, scale, n, chosen, work
    return 0.0, scale, n, chosen, work


@njit(cache=True, fastmath=True, error_model="numpy")
def _plausible(p, start, limit):
    if abs(p[0] - start[0]) > limit or abs(p[1] - start[1]) > limit:
        return False
    det = p[2] * p[4] - p[3] * p[3]
    if p[2] <= 0.0 or p[4] <= 0.0 or det <= 0.0:
        return False
    return 0.15 < p[5] < 12.0


@njit(cache=True, fastmath=True, error_model="numpy")
def _finish(p, status, noise_floor, scale, n, chosen, table, hidden, work, out):
    """Take the last step from ``p``, with the slope on the ink free, and the covariance: a row ``out`` (N_RESULTS,)."""
    H, g, A, step, unit = np.empty((14, 14)), np.empty(14), np.empty((12, 12)), np.empty(12), np.zeros(12)
    profile(n, p, chosen, table, work)
    cost, weight, rim_weight, rim_count = residuals(n, p, scale, work)
    derivatives(n, p, chosen, work)
    more_derivatives(n, p, chosen, work)
    normal_equations(n, work, H, g)
    sigma2 = max(cost / max(weight - 10.0, 1.0), noise_floor * noise_floor)
    taken = min(abs(p[9]) / max(p[6], 5.0), 1.0) * math.sqrt(p[7] * p[7] + p[8] * p[8])
    free = FREE_SLOPE * taken + LEAST_SLOPE * abs(p[9])
    H[10, 10] += sigma2 / (free * free)
    H[11, 11] += sigma2 / (free * free)
    for i in range(12):
        H[i, i] = H[i, i] * (1.0 + 1e-10) + 1e-12
    third = H[12, 12] + H[13, 13] + 1e-12
    skew2 = 4.0 * (g[12] * g[12] + g[13] * g[13]) / (third * third)
    out[17] = math.sqrt(max(skew2 - SKEW_NOISE * sigma2 * 4.0 / third, 0.0))
    copy_part(H, A)
    if solve_spd(A, g[:12], step) and abs(step[0]) < 0.3 and abs(step[1]) < 0.3:
        p[0] += step[0]
        p[1] += step[1]
    for i in range(10):
        out[i] = p[i]
    for k in range(2):
        unit[:] = 0.0
        unit[k] = 1.0
        copy_part(H, A)
        if not solve_spd(A, unit, step):
            status = 0.0
            break
        out[11 if k == 0 else 12] = sigma2 * step[1]
        if k == 0:
            out[10] = sigma2 * step[0]
    out[13] = math.sqrt(sigma2)
    out[14] = rim_weight / max(rim_count, 1.0) * (1.0 - hidden.sum() / N_SECTORS)
    out[15] = status
    out[16] = n
