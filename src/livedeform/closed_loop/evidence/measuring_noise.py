"""Estimate how large the measuring noise really is: its covariance, its correlation in time, and what a tracker
overlooks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livedeform.closed_loop.evidence.track import Track
from livedeform.closed_loop.settings import NoiseSettings
from livedeform.common.types import Array

DIFFERENCES = 6.0  # variance of a second difference of white noise, 1 + 4 + 1, over its own
MEDIAN_CHI2_3 = 2.366  # the median of chi-square with three degrees of freedom
SIGMA_PER_MAD = 1.4826  # of a normal distribution, over the median of absolute deviations
LEAST_FRAMES = 5  # that have second differences worth a median
TINY, TINY_VARIANCE = 1e-12, 1e-16  # m, m2: keep a covariance of identical frames invertible


@dataclass(frozen=True)
class NoiseReport:
    """The size of the noise, from the recording itself.

    ``covariance`` (m, 3, 3) m2 of one frame's point; ``scale`` measured over stated variance (NaN: none was stated);
    ``correlation_time`` s and ``inflation`` = n / n_effective of the mean of many frames; ``n_differences`` second
    differences went into it.
    """

    covariance: Array
    scale: float
    correlation_time: float
    inflation: float
    n_differences: int

    @property
    def repeated(self) -> float:
        """The share of the covariance that repeats show; the rest is an error that lasts, as of a dot's shape."""
        return min(self.scale, 1.0) if np.isfinite(self.scale) else 1.0


def noise_of(data: Track, settings: NoiseSettings) -> NoiseReport:
    """Estimate the measuring noise from second differences in time, and its correlation from still stretches.

    For white noise of variance s2, d = y[t-1] - 2 y[t] + y[t+1] has variance 6 s2, and smooth motion hardly enters
    (von Neumann et al. 1941). The median of d2 keeps jerks and outliers out. One factor, not below one, scales the
    stated covariances: a tracker knows its anisotropy better than a recording does.
    """
    y = data.points
    m = y.shape[1]
    if len(y) >= LEAST_FRAMES:
        d = y[:-2] - 2.0 * y[1:-1] + y[2:]
        seen = np.asarray(np.isfinite(d).all(axis=2))
    else:
        d, seen = np.zeros((0, m, 3)), np.zeros((0, m), bool)
    stated = _mean_covariance(data.covariances)
    ever = np.isfinite(y).all(axis=2).any(axis=0)  # a marker that is never seen states nothing
    has_stated = bool(ever.any()) and np.isfinite(stated[ever]).all(axis=(1, 2)).mean() > 0.5
    n_differences = int(seen.sum())
    quiet = _quiet_differences(data, seen, settings)
    if has_stated:
        complete = np.asarray(np.isfinite(stated).all(axis=(1, 2)))
        usual = stated[complete].mean(axis=0)  # a mean of covariances is one; a median of their elements need not be
        covariance = np.where(complete[:, None, None], stated, usual)
        scale = 1.0
        if quiet.sum() >= settings.enough:
            frame_cov = np.where(np.isfinite(data.covariances[1:-1]), data.covariances[1:-1], covariance)
            z2 = np.einsum("fmi,fmij,fmj->fm", zeros(d), np.linalg.inv(frame_cov), zeros(d))[quiet] / DIFFERENCES
            scale = float(np.median(z2) / MEDIAN_CHI2_3)
        # what repeats do not show, a systematic part, may be stated with reason: never less than that
        covariance = covariance * max(scale, 1.0)
    else:
        scale = float("nan")
        covariance = _measured_covariance(d, quiet, m, settings)
    correlation_time, inflation = _correlation(data, covariance, settings)
    return NoiseReport(covariance, scale, correlation_time, inflation, n_differences)


def marker_motion(data: Track, noise: NoiseReport, settings: NoiseSettings) -> Array:
    """Rms displacement of the markers from their place at the start (f,) m, smoothed, with the noise taken off."""
    y = data.points
    n = min(settings.smoothed, len(y))
    rest = median(y[: max(n, 1)])
    d2 = np.nansum((y - rest) ** 2, axis=2)
    seen = np.isfinite(y).all(axis=2)
    floor = np.trace(noise.covariance, axis1=1, axis2=2).mean()
    rms2 = np.where(seen, d2, 0.0).sum(axis=1) / seen.sum(axis=1).clip(min=1)
    kernel = np.ones(min(settings.smoothed, len(y)))
    smooth = np.convolve(rms2, kernel, "same") / np.convolve(np.ones(len(y)), kernel, "same")
    return np.asarray(np.sqrt(np.maximum(smooth - floor, 0.0)))


def zeros(d: Array) -> Array:
    return np.where(np.isfinite(d), d, 0.0)


def _quiet_differences(data: Track, seen: np.ndarray, settings: NoiseSettings) -> np.ndarray:
    """Second differences (f - 2, m) that motion hardly enters: evenly sampled, and of the quieter two thirds of
    time."""
    if len(data.stamps_ns) < LEAST_FRAMES:
        return seen
    dt = np.diff(data.stamps_ns) * 1e-9
    even = np.abs(dt[1:] - dt[:-1]) < settings.even * np.median(dt)
    slope = np.nanmedian(np.abs(data.points[2:] - data.points[:-2]).sum(axis=2), axis=1)
    with np.errstate(invalid="ignore"):
        slow = slope <= np.nanquantile(slope, settings.quiet)
    rows = even & slow
    if (seen & rows[:, None]).sum() < settings.enough:
        rows = slow
    return np.asarray(seen & rows[:, None])


def _measured_covariance(d: Array, quiet: np.ndarray, m: int, settings: NoiseSettings) -> Array:
    """(m, 3, 3) from second differences, by the median, shrunk to the markers' common one."""
    if quiet.sum() < settings.few:
        return np.broadcast_to(np.eye(3) * settings.point_sigma**2, (m, 3, 3)).copy()
    pooled = _robust_covariance(d[quiet], settings.sample_outlier) / DIFFERENCES
    out = np.empty((m, 3, 3))
    for i in range(m):
        own = d[quiet[:, i], i]
        w = len(own) / (len(own) + settings.own_weight)
        ratio = (
            np.median((own**2).sum(axis=1)) / np.median((d[quiet] ** 2).sum(axis=1)) if len(own) > LEAST_FRAMES else 1.0
        )
        out[i] = pooled * (w * ratio + (1.0 - w))
    return out


def _robust_covariance(d: Array, outlier: float) -> Array:
    """Estimate the covariance (3, 3) of samples (n, 3) without those beyond ``outlier`` sigma of the median fit."""
    spread = SIGMA_PER_MAD * np.median(np.abs(d), axis=0) + TINY
    keep = (np.abs(d) / spread < outlier).all(axis=1)
    return np.asarray(np.cov(d[keep].T) + np.eye(3) * TINY_VARIANCE)


def _correlation(data: Track, covariance: Array, settings: NoiseSettings) -> tuple[float, float]:
    """Correlation time (s) and variance inflation of long means, from what still stretches do beyond white noise.

    Means over n consecutive frames of white noise have variance s2 / n; the ratio of the observed to that variance,
    after a parabola in time is taken off each stretch of about 2 s, estimates n / n_effective = 1 + 2 sum rho_k.
    """
    t = (data.stamps_ns - data.stamps_ns[0]) * 1e-9
    least, least_stretch = settings.least_frames
    if len(t) < least:
        return 0.0, 1.0
    dt = float(np.median(np.diff(t)))
    n = max(round(settings.stretch / dt), least_stretch)
    many, few = settings.short_means
    k = many if n >= many * few else few
    n_short = n // k
    n = k * n_short
    q, _ = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, n), 2))
    smooth = q @ q.T
    averaging = np.kron(np.eye(k), np.full((1, n_short), 1.0 / n_short))
    kept = averaging @ (np.eye(n) - smooth)
    lost = float(np.sum(kept**2)) * n_short / k  # what the parabola leaves of the variance of white noise's short means
    ratios: list[tuple[float, int]] = []
    for start in range(0, len(t) - n + 1, max(n // many, 1)):  # a pause of the probe is seldom longer than a stretch
        part = data.points[start : start + n]
        full = np.isfinite(part).all(axis=(0, 2))
        if full.sum() < 3:
            continue
        rest = part[:, full] - np.einsum("fg,gmi->fmi", smooth, part[:, full])
        means = np.einsum("kf,fmi->kmi", averaging, rest)
        sigma2 = covariance[full][:, [0, 1, 2], [0, 1, 2]]
        ratio = float(np.mean(means**2 / (sigma2 / n_short))) / lost
        if ratio < settings.moving:
            ratios.append((ratio, start))
    if not ratios:
        return 0.0, 1.0
    # the quietest stretches are the still ones: motion would count as correlation
    quiet: list[tuple[float, int]] = []
    for ratio, start in sorted(ratios):
        if len(quiet) < 3 and all(abs(start - other) >= n for _, other in quiet):
            quiet.append((ratio, start))
    inflation = float(np.clip(np.mean([r for r, _ in quiet]), 1.0, settings.moving))
    return 0.5 * dt * (inflation - 1.0), inflation


def median(part: Array) -> Array:
    """Median over frames (m, 3), NaN where a marker was never seen."""
    out = np.full(part.shape[1:], np.nan)
    seen = np.asarray(np.isfinite(part).any(axis=(0, 2)))
    out[seen] = np.nanmedian(part[:, seen], axis=0)
    return out


def _mean_covariance(covariances: Array) -> Array:
    """Mean over frames (m, 3, 3) of what was stated, NaN for markers without."""
    known = np.asarray(np.isfinite(covariances).all(axis=(2, 3)))
    total = np.where(known[..., None, None], covariances, 0.0).sum(axis=0)
    count = known.sum(axis=0)[:, None, None]
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
