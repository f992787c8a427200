"""Estimate how large the measuring noise is: its covariance, its correlation in time, what a tracker overlooks.

The noise is taken from what cannot be motion: from what each marker has for itself (`shared_motion`). Where that does
not tell it, it is what the tracker states, or else second differences in time or an assumption, and the report says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.optimize import nnls
from scipy.special import stdtrit

from livedeform.closed_loop.evidence.rounding import of_rounding, steps_of, that_lasts
from livedeform.closed_loop.evidence.shared_motion import Unshared, lagged, unshared
from livedeform.closed_loop.evidence.track import Track
from livedeform.closed_loop.settings import NoiseSettings
from livedeform.common.types import Array

DIFFERENCES = 6.0  # variance of a second difference of white noise, 1 + 4 + 1, over its own
MEDIAN_OVER_MEAN = np.pi / 2.0  # variance of a median of normal numbers over that of their mean
MEDIAN_CHI2_3 = 2.366  # the median of chi-square with three degrees of freedom
SIGMA_PER_MAD, MAD_PER_SIGMA = 1.4826, 0.6745  # of a normal distribution; MAD: median of absolute deviations
TINY, TINY_VARIANCE = 1e-12, 1e-16  # m, m2: keep a covariance of identical frames invertible
SINGLE = 4.0 * float(np.finfo(np.float32).eps)  # of the largest eigenvalue: rounding of what a message states
LEVEL = 0.975  # of a two-sided 95 % interval

Source = Literal["unshared motion", "quiet stretches", "stated", "second differences", "assumed"]


@dataclass(frozen=True)
class NoiseReport:
    """The size of the noise, from the recording itself.

    ``covariance`` (m, 3, 3) m2 of one usual frame's point (`Track.over_usual` tells how others differ); ``scale``
    variance of second differences over the stated one (NaN: none was stated); ``correlation_time`` s and ``inflation``
    = n / n_effective of the mean of a window of frames; ``n_differences`` second differences there are. ``source``:
    where the size comes from, and whether it was ``measured``; ``value`` m, Euclidean sigma of a point as that source
    has it, with its 95 % ``interval`` m, from ``n`` points (NaN and 0 where it was not measured); ``ratio`` of the
    measured to the stated variance (NaN: one of them is missing). Values are written in ``steps`` (3,) m, 0 along axes
    where that is not seen; ``kept`` is what was stated, or where nothing was what is seen from frame to frame, over
    the ``covariance`` that rounding makes of it (1 where it makes nothing).
    """

    covariance: Array
    scale: float
    correlation_time: float
    inflation: float
    n_differences: int
    source: Source = "stated"
    value: float = float("nan")
    interval: tuple[float, float] = (float("nan"), float("nan"))
    n: int = 0
    ratio: float = float("nan")
    steps: Array = field(default_factory=lambda: np.zeros(3))
    kept: float = 1.0

    @property
    def measured(self) -> bool:
        """Return whether the recording itself told how large it is."""
        return self.source in ("unshared motion", "quiet stretches")

    @property
    def repeated(self) -> float:
        """The share of the covariance that repeats show; the rest is an error that lasts, as of a dot's shape, or of
        rounding."""
        seen = self.ratio if np.isfinite(self.ratio) else self.scale
        return min(seen * self.kept, 1.0) if np.isfinite(seen) else self.kept


@dataclass(frozen=True)
class Measured:
    """Noise as the recording tells it: ``samples`` (n, 3) m, of the ``markers`` (n,); ``value`` m with its 95 %
    ``interval``; ``correlation`` (lags,) of consecutive frames, None where it is not told."""

    source: Source
    samples: Array
    markers: np.ndarray
    value: float
    interval: tuple[float, float]
    correlation: Array | None


def noise_of(data: Track, settings: NoiseSettings) -> NoiseReport:
    """Estimate the measuring noise, with where it comes from and how sure it is.

    One factor, not below one, scales the stated covariances: a tracker knows its anisotropy better than a recording
    does, and what repeats do not show, a systematic part, may be stated with reason.
    """
    steps = _steps(data, settings)
    lag = _changing_lag(data, settings)
    d, seen = _second_differences(data, lag, settings.least_frames)
    quiet = _quiet_differences(data, seen, lag, settings)
    measured = _from_unshared(data, settings)
    shown, source = _without_statement(measured, d, quiet, steps, settings)
    stated, has_stated = _stated(data, settings)
    scale = ratio = float("nan")
    covariance = shown
    if has_stated:
        stated = _in_all_directions(stated, shown)
        scale = _scale(d, data, stated, quiet, lag, shown, steps, settings) if quiet.sum() >= settings.enough else 1.0
        if measured is not None:
            ratio = float(measured.value**2 / _size(stated, data) ** 2)
        covariance, source = stated * max(ratio if measured else 1.0, 1.0), "stated"
    rounded = _with_rounding(covariance, shown, steps, has_stated)
    kept = (_size(stated if has_stated else shown, data) / _size(rounded, data)) ** 2 if steps.any() else 1.0
    time, inflation = _correlation(data, measured, settings)
    report = NoiseReport(rounded, scale, time, inflation, int(seen.sum()), source, _size(rounded, data))
    report = replace(report, steps=steps, kept=kept)
    if measured is None:
        return report
    n = len(measured.samples)
    return replace(report, source=measured.source, value=measured.value, interval=measured.interval, n=n, ratio=ratio)


@dataclass(frozen=True)
class MarkerMotion:
    """Rms displacement ``size`` (f,) m of the markers from their place at the start, smoothed, with the noise taken
    off; ``clear`` (f,) m: without the noise of the start too, which every frame has; ``unclear`` m: what noise alone
    may show of it."""

    size: Array
    clear: Array
    unclear: float


def marker_motion(data: Track, noise: NoiseReport, settings: NoiseSettings) -> MarkerMotion:
    """Measure how far the markers are from where they began, over as many frames as it takes to see it through the
    noise, at least ``smoothed`` and at most those of ``smoothed_seconds``."""
    dt = np.median(np.diff(data.stamps_ns)) * 1e-9 if len(data.stamps_ns) > 1 else np.inf
    most = max(int(settings.smoothed_seconds / dt), settings.smoothed)
    n, variance = settings.smoothed, data.over_usual(settings.most_trusted)
    motion = _motion_over(n, data, variance, noise, settings)
    while n < most and motion.unclear > settings.clear_level * float(motion.clear.max(initial=0.0)):
        n = min(2 * n, most)
        motion = _motion_over(n, data, variance, noise, settings)
    return motion


def _motion_over(n: int, data: Track, variance: Array, noise: NoiseReport, settings: NoiseSettings) -> MarkerMotion:
    """Smooth the mean square over ``n`` frames, in which points weigh by their ``variance`` (f, m) over the usual. Of
    noise alone it scatters by sqrt(2 / n) of itself, n the coordinates in it."""
    y = data.points
    n = min(n, max(len(y), 1))
    rest = median(y[:n])
    d2 = np.nansum((y - rest) ** 2, axis=2)
    seen = np.isfinite(y - rest).all(axis=2)  # a marker whose rest was not seen does not tell how far it is
    weight = seen / variance
    count, n_seen = weight.sum(axis=1), seen.sum(axis=1)
    trust = count / n_seen.clip(min=1)  # one where all that was seen is as usual
    mean = np.divide((weight * np.nan_to_num(d2)).sum(axis=1), count, out=np.zeros(len(y)), where=count > 0.0)
    one = float(np.trace(noise.covariance, axis1=1, axis2=2).mean()) * noise.repeated
    total, shown, frames = (np.convolve(x, np.ones(n), "same") for x in (trust * mean, 1.0 * (n_seen > 0), trust))
    coordinates = 3.0 * max(float(np.median(count)) if len(count) else 0.0, 1.0) * n / min(noise.inflation, n)
    unclear = np.sqrt(settings.clear_sigmas * one * np.sqrt(2.0 / coordinates))
    size = np.sqrt(np.maximum(total - one * shown, 0.0) / np.maximum(frames, TINY))
    return MarkerMotion(size, np.sqrt(np.maximum(size**2 - MEDIAN_OVER_MEAN * one / n, 0.0)), float(unclear))


def zeros(d: Array) -> Array:
    return np.where(np.isfinite(d), d, 0.0)


def _changing_lag(data: Track, settings: NoiseSettings) -> int:
    """Find after how many frames nearly all points are other ones: a tracker may send each point several times, and
    what it repeats tells nothing of its noise. 1 where no window is long enough for that."""
    y, step = data.points, np.diff(data.stamps_ns)
    most = int(1e9 * settings.window / np.median(step)) if len(step) else 1
    for lag in range(1, min(most, len(y) // settings.least_frames) + 1):
        d = y[lag:] - y[:-lag]
        d = d[np.isfinite(d).all(axis=2)]
        if len(d) and (d != 0.0).any(axis=1).mean() > settings.changed:
            return lag
    return 1


def _second_differences(data: Track, lag: int, least: int) -> tuple[Array, np.ndarray]:
    """Second differences over ``lag`` frames (f - 2 lag, m, 3) and where there are any (f - 2 lag, m): for white noise
    of variance s2 they have variance 6 s2, and smooth motion hardly enters (von Neumann et al. 1941)."""
    y = data.points
    if len(y) < least:
        return np.zeros((0, y.shape[1], 3)), np.zeros((0, y.shape[1]), bool)
    d = y[: -2 * lag] - 2.0 * y[lag:-lag] + y[2 * lag :]
    return d, np.asarray(np.isfinite(d).all(axis=2))


def _steps(data: Track, settings: NoiseSettings) -> Array:
    """Return the steps (3,) m in which points are written, 0 along axes where there is none."""
    d, seen = _second_differences(data, 1, settings.least_frames)
    return steps_of(d[seen], float(np.nanmax(np.abs(data.points), initial=0.0)), settings)


def _with_rounding(covariance: Array, shown: Array, steps: Array, stated: bool) -> Array:
    """Return a ``covariance`` (m, 3, 3) m2 that is no smaller along an axis than what rounding to ``steps`` (3,) m
    makes of what repeats have ``shown`` (m, 3, 3) m2; beside one that is ``stated``, no more than rounding adds."""
    axes = np.arange(3)
    own, seen = covariance[:, axes, axes], shown[:, axes, axes]
    least = seen + that_lasts(seen, np.broadcast_to(steps, seen.shape))
    if stated:
        least = np.minimum(least, own + of_rounding(steps))
    out = covariance.copy()
    out[:, axes, axes] = np.where(steps > 0.0, np.maximum(own, least), own)
    return out


def _stated(data: Track, settings: NoiseSettings) -> tuple[Array, bool]:
    """Return what the tracker states of each marker's usual frame (m, 3, 3), and whether it does of most of those that
    it saw."""
    stated = _mean_covariance(data.covariances / data.over_usual(settings.most_trusted)[..., None, None])
    ever = np.isfinite(data.points).all(axis=2).any(axis=0)  # a marker that is never seen states nothing
    if not ever.any() or np.isfinite(stated[ever]).all(axis=(1, 2)).mean() <= 0.5:
        return stated, False
    complete = np.asarray(np.isfinite(stated).all(axis=(1, 2)))
    usual = stated[complete].mean(axis=0)  # a mean of covariances is one; a median of their elements need not be
    return np.where(complete[:, None, None], stated, usual), True


def _size(covariance: Array, data: Track) -> float:
    """Euclidean sigma (m) of a point of the markers that were seen."""
    ever = np.isfinite(data.points).all(axis=2).any(axis=0)
    return float(np.sqrt(np.trace(covariance[ever] if ever.any() else covariance, axis1=1, axis2=2).mean()))


def _scale(
    d: Array,
    data: Track,
    stated: Array,
    quiet: np.ndarray,
    lag: int,
    own: Array,
    steps: Array,
    settings: NoiseSettings,
) -> float:
    """Find the variance of ``quiet`` second differences ``d`` over ``lag`` frames over the one that is stated of each
    frame, or else (m, 3, 3) of its marker; the median keeps jerks and outliers out, but of few ``steps`` (3,) m it is
    one of them."""
    of_frame, marker = data.covariances[lag:-lag][quiet], np.nonzero(quiet)[1]
    known = np.isfinite(of_frame).all(axis=(1, 2))[:, None, None]
    covariance = _in_all_directions(np.where(known, of_frame, stated[marker]), own[marker])
    z2 = np.einsum("ni,nij,nj->n", d[quiet], np.linalg.inv(covariance), d[quiet]) / DIFFERENCES
    if steps.any():
        return float(np.mean(z2[are_usual(d[quiet], of_rounded(steps), settings.sample_outlier)]) / 3.0)
    return float(np.median(z2) / MEDIAN_CHI2_3)


def _in_all_directions(stated: Array, own: Array) -> Array:
    """Return covariances (n, 3, 3) m2 as they are ``stated``, along a direction that is stated without any error (to
    single precision) with what the recording's ``own`` one has there: nothing is measured exactly."""
    values, vectors = np.linalg.eigh(stated)
    exact = values < SINGLE * values[:, -1:]
    rows = exact.any(axis=1)
    if not rows.any():
        return stated
    along = np.einsum("nik,nij,njk->nk", vectors[rows], own[rows], vectors[rows])
    values, vectors = np.where(exact[rows], along, values[rows]), vectors[rows]
    out = stated.copy()
    out[rows] = np.einsum("nik,nk,njk->nij", vectors, values, vectors)
    return out


def _from_unshared(data: Track, settings: NoiseSettings) -> Measured | None:
    """Measure the noise by what markers do not share; None where that does not tell it.

    Where there is more of it while markers move fast, some motion was not shared: the slow frames are taken, and they
    must pass the same test.
    """
    variance = data.over_usual(settings.most_trusted)
    usable = variance < settings.wild**2  # what the tracker itself calls wild tells nothing
    own = unshared(np.where(usable[..., None], data.points, np.nan), settings)
    if own is None:
        return None
    own = replace(own, residual=own.residual / np.sqrt(variance[:, own.markers, None]))
    slow = own.speed <= np.quantile(own.speed, settings.quiet)
    frames = np.ones(len(own.speed), bool)
    source: Source = "unshared motion"
    if _leaks(own, slow, settings):
        slower = own.speed <= np.quantile(own.speed[slow], 0.5)
        if _leaks(own, slower, settings, among=slow):
            return None
        source, frames = "quiet stretches", slow
    residual = np.where(frames[:, None, None], own.residual, np.nan)
    seconds = (data.stamps_ns - data.stamps_ns[0]) * 1e-9
    course = _course(own, residual, seconds, frames, settings)
    if course is None:
        return None
    true_variance, correlation = course
    raw, error = _size_in_time(residual, settings)
    usual = _of_usual_markers(residual)
    larger = float(np.sqrt(true_variance)) / raw
    # a correction may be wrong by half as much; what only some markers have, altogether
    width = float(np.exp(np.linalg.norm([error, 0.5 * np.log(larger), np.log(usual)])))
    if not width**2 <= settings.most_uncertain:
        return None
    seen, value = np.isfinite(residual).all(axis=2), raw * larger * usual
    markers = own.markers[np.nonzero(seen)[1]]
    samples = residual[seen] * larger * usual
    return Measured(source, samples, markers, value, (value / width, value * width), correlation)


def _of_usual_markers(residual: Array) -> float:
    """Find the sigma of the median marker over that of all: a marker at the probe's edge, which moves like no other,
    does not count as noise."""
    power = np.nanmean(residual**2, axis=(0, 2))
    return float(np.sqrt(np.median(power) / max(power.mean(), TINY**2)))


def _course(
    own: Unshared, residual: Array, seconds: Array, frames: np.ndarray, settings: NoiseSettings
) -> tuple[float, Array] | None:
    """Find the noise's variance (Euclidean, m2) and its correlations (lags,), as the sum of a white part and one that
    fades exponentially: the two whose residual, without what the shared courses took, has the covariances in time that
    were seen. None where nothing is left of it."""
    dt = float(np.median(np.diff(seconds)))
    lags = int(np.clip(round(settings.stretch / dt), 1, len(seconds) // 4))
    measured = _autocovariance(residual, lags)
    white = own.kept(seconds, 0.0, lags, frames)
    weight = np.sqrt(len(seconds) - np.arange(lags + 1.0)) * np.r_[np.sqrt(lags), np.ones(lags)]
    best, found = np.inf, None
    for tau in np.geomspace(settings.fading[0] * dt, settings.fading[1], int(settings.fading[2])):
        fading = own.kept(seconds, float(tau), lags, frames)
        parts, left = nnls(weight[:, None] * np.column_stack([white, fading]), weight * measured)
        if left < best:
            best, found = left, (parts, tau)
    if found is None or not found[0].sum() > 0.0:
        return None
    (alone, slow), tau = found
    variance = float(alone + slow)
    return variance, slow / variance * np.exp(-dt * np.arange(1, lags + 1) / tau)


def _leaks(own: Unshared, slow: np.ndarray, settings: NoiseSettings, among: np.ndarray | None = None) -> bool:
    """Tell whether frames that are not ``slow`` (f,) have clearly more unshared variance than those that are."""
    fast = ~slow if among is None else among & ~slow
    if min(slow.sum(), fast.sum()) < settings.least_frames:
        return False
    power = [np.nanmean(own.residual[rows] ** 2, axis=(0, 2)) for rows in (slow, fast)]
    return float(np.median(power[1] / np.maximum(power[0], TINY**2))) > settings.most_uncertain


def _size_in_time(residual: Array, settings: NoiseSettings) -> tuple[float, float]:
    """Euclidean sigma m of ``residual`` (f, q, 3), and half the width of its logarithm's 95 % interval, from how much
    stretches of time differ."""
    power = np.nansum(residual**2, axis=(1, 2)) / np.maximum(np.isfinite(residual[..., 0]).sum(axis=1), 1)
    power = power[np.isfinite(residual[..., 0]).any(axis=1)]
    if len(power) < settings.stretches:
        return float("nan"), float("nan")
    parts = np.array([p.mean() for p in np.array_split(power, settings.stretches)])
    error = float(np.std(parts, ddof=1) / np.sqrt(len(parts)) / max(parts.mean(), TINY**2)) / 2.0
    return float(np.sqrt(power.mean())), float(stdtrit(len(parts) - 1, LEVEL)) * error


def _autocovariance(residual: Array, lags: int) -> Array:
    """Covariance (lags + 1,) m2, summed over the axes, of the residual (f, q, 3) with itself so many frames later."""
    x, w = np.nan_to_num(residual).reshape(len(residual), -1), np.isfinite(residual[..., 0]).astype(float)
    return lagged(x, x, lags) / np.maximum(np.rint(lagged(w, w, lags)), 1.0)


def _without_statement(
    measured: Measured | None, d: Array, quiet: np.ndarray, steps: Array, settings: NoiseSettings
) -> tuple[Array, Source]:
    """Return what is taken (m, 3, 3) m2 where nothing is stated: what was ``measured``, or where noise cannot be told
    from motion second differences, which motion makes larger and slow noise smaller, or an assumption."""
    m = d.shape[1]
    if measured is not None:
        return _covariance_of(measured, m, steps, settings), measured.source
    if quiet.sum() < settings.few:
        return np.broadcast_to(np.eye(3) * settings.point_sigma**2, (m, 3, 3)).copy(), "assumed"
    covariance = _robust_covariance(d[quiet], settings.sample_outlier, of_rounded(steps)) / DIFFERENCES
    return np.broadcast_to(covariance, (m, 3, 3)).copy(), "second differences"


def _covariance_of(measured: Measured, m: int, steps: Array, settings: NoiseSettings) -> Array:
    """(m, 3, 3) m2 of the samples, each marker's shrunk to the common one."""
    pooled = _robust_covariance(measured.samples, settings.sample_outlier, steps)
    common = float(np.median((measured.samples**2).sum(axis=1)))
    out = np.empty((m, 3, 3))
    for i in range(m):
        own = measured.samples[measured.markers == i]
        w = len(own) / (len(own) + settings.own_weight)
        ratio = np.median((own**2).sum(axis=1)) / max(common, TINY**2) if len(own) > settings.least_frames else 1.0
        out[i] = pooled * (w * ratio + (1.0 - w))
    return out


def _quiet_differences(data: Track, seen: np.ndarray, lag: int, settings: NoiseSettings) -> np.ndarray:
    """Second differences over ``lag`` frames (f - 2 lag, m) that motion hardly enters: evenly sampled, and of the
    quieter two thirds of time."""
    if len(data.stamps_ns) < settings.least_frames or not seen.any():
        return seen
    dt = (data.stamps_ns[lag:] - data.stamps_ns[:-lag]) * 1e-9
    even = np.abs(dt[lag:] - dt[:-lag]) < settings.even * np.median(dt)
    slope = np.nanmedian(np.abs(data.points[2 * lag :] - data.points[: -2 * lag]).sum(axis=2), axis=1)
    with np.errstate(invalid="ignore"):
        slow = slope <= np.nanquantile(slope, settings.quiet)
    rows = even & slow
    if (seen & rows[:, None]).sum() < settings.enough:
        rows = slow
    return np.asarray(seen & rows[:, None])


def of_rounded(steps: Array) -> Array:
    """Return the sigma (c,) of second differences of errors of rounding to ``steps`` (c,) alone."""
    return np.asarray(np.sqrt(DIFFERENCES * of_rounding(steps)))


def are_usual(d: Array, least: Array | float, outlier: float) -> np.ndarray:
    """Tell which samples ``d`` (n, c) are within ``outlier`` sigma of the median fit, which is not below ``least``."""
    spread = np.maximum(SIGMA_PER_MAD * np.median(np.abs(d), axis=0) + TINY, least)
    return np.asarray((np.abs(d) / spread < outlier).all(axis=1))


def _robust_covariance(d: Array, outlier: float, least: Array | float = 0.0) -> Array:
    """Estimate the covariance (3, 3) of samples (n, 3) without those beyond ``outlier`` sigma of the median fit, which
    is not below ``least`` (3,)."""
    return np.asarray(np.cov(d[are_usual(d, least, outlier)].T) + np.eye(3) * TINY_VARIANCE)


def _correlation(data: Track, measured: Measured | None, settings: NoiseSettings) -> tuple[float, float]:
    """Correlation time (s), and n / n_effective = 1 + 2 sum (1 - k / n) rho_k of the mean of as many frames as a window
    has at most. Where correlation is not told, the frames of a window count as one."""
    if len(data.stamps_ns) < 2:
        return 0.0, 1.0
    dt = float(np.median(np.diff(data.stamps_ns))) * 1e-9
    n = max(round(settings.window / dt), 1)
    if measured is None or measured.correlation is None:
        return float("nan"), float(n)
    rho = measured.correlation
    quiet = np.flatnonzero(rho < settings.uncorrelated)
    rho = rho[: quiet[0]] if len(quiet) else rho
    within = rho[: n - 1]
    inflation = 1.0 + 2.0 * float(np.sum((1.0 - np.arange(1, len(within) + 1) / n) * within))
    return dt * float(rho.sum()), float(np.clip(inflation, 1.0, n))


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
