"""Estimate the noise of a recorded force: of a sensor that filters, repeats or rounds its values, beside a probe whose
recorded path jitters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from livedeform.closed_loop.evidence.measuring_noise import DIFFERENCES, MAD_PER_SIGMA, TINY, are_usual, of_rounded
from livedeform.closed_loop.evidence.rounding import of_rounding, steps_of, that_lasts
from livedeform.closed_loop.settings import Settings
from livedeform.common.types import Array


@dataclass(frozen=True)
class ForceNoise:
    """The noise of a force: ``sigma`` N of an axis; whether it is ``told``, or may be larger, as neighbouring samples
    are alike for longer than the probe is known to be still; ``step`` N in which values are written, 0 for none."""

    sigma: float
    told: bool = True
    step: float = 0.0


def force_noise(force: Array, times: Array, place: Array, settings: Settings) -> float:
    """Estimate the sigma (N) of ``force`` (w, 3) N, as `noise_of_force`."""
    return noise_of_force(force, times, place, settings).sigma


def noise_of_force(force: Array, times: Array, place: Array, settings: Settings) -> ForceNoise:
    """Estimate the noise of ``force`` (w, 3) N at ``times`` (w,) s with the probe at ``place`` (w, 3) m, by second
    differences over as many samples as it takes until they grow no more: a sensor's filter, or samples that are sent
    several times, keep neighbours alike. Between neighbours all differences count, over more those of a still probe.
    """
    most = settings.noise.window / max(float(np.median(np.diff(times))), TINY)
    steps = steps_of(_differences(force, 1), float(np.abs(force).max(initial=0.0)), settings.noise)
    step, rounding = float(steps.max()), float(of_rounding(steps).max())
    all_of_them = _variance(_differences(force, 1), step, settings)
    lag = _changing_lag(force, most, settings)
    variance = _of_a_still_probe(force, place, lag, step, settings)
    variance = variance if np.isfinite(variance) else all_of_them
    told = most < 2 * lag
    while 2 * lag <= most:
        lag, before = 2 * lag, variance
        here = _of_a_still_probe(force, place, lag, step, settings)
        known = np.isfinite(here)
        # motion only adds to the noise: where all differences have grown no more, those of a still probe have not
        grown = here if known else _variance(_differences(force, lag), step, settings)
        # what rounding alone makes is another one at each sample, and hides for how long the rest stays alike
        beyond = max(grown, before) - rounding, before - rounding
        ends = 0.0 < beyond[0] < (1.0 + settings.noise.uncorrelated) * beyond[1]
        told = known or ends
        if known:
            variance = max(variance, here)
        if ends:
            break
    variance = max(variance, all_of_them)
    variance += float(that_lasts(np.array(variance), np.array(step)))
    return ForceNoise(max(float(np.sqrt(variance)), settings.noise.force_sigma), bool(told), step)


def _changing_lag(force: Array, most: float, settings: Settings) -> int:
    """Find after how many samples nearly all of ``force`` (w, 3) are other ones: the filtered values of a sensor that
    sends each several times do not grow evenly with the time between them. 1 where it takes more than ``most``."""
    for lag in range(1, min(int(most), len(force) // settings.noise.least_frames) + 1):
        if (force[lag:] != force[:-lag]).any(axis=1).mean() > settings.noise.changed:
            return lag
    return 1


def _differences(x: Array, lag: int) -> Array:
    """Return second differences (w - 2 lag, 3) of ``x`` (w, 3) over ``lag`` samples."""
    return x[: -2 * lag] - 2.0 * x[lag:-lag] + x[2 * lag :]


def _variance(d: Array, step: float, settings: Settings) -> float:
    """Return the variance N2 of a force of which ``d`` (n, 3) N are second differences: by their median, and where that
    is one of few ``step`` N, by the mean square of those that are no outliers."""
    if not d.size:
        return 0.0
    # as if each value could be anywhere within its step, which adds what is taken off again (Sheppard)
    spread = float(np.median(np.abs(d + step * (np.random.default_rng(0).random(d.shape) - 0.5)))) / MAD_PER_SIGMA
    if step <= spread:
        return (spread**2 - float(of_rounding(np.array(step)))) / DIFFERENCES
    flat = d.reshape(-1, 1)
    usual = are_usual(flat, of_rounded(np.array([step])), settings.noise.sample_outlier)
    return float(np.mean(flat[usual] ** 2)) / DIFFERENCES


def _of_a_still_probe(force: Array, place: Array, lag: int, step: float, settings: Settings) -> float:
    """Return the variance N2 of ``force`` (w, 3) by second differences over ``lag`` samples between which the probe, at
    ``place`` (w, 3) m, hardly moved; NaN where there are too few of these."""
    if len(force) <= 2 * lag:
        return float("nan")
    d, smooth = _differences(force, lag), uniform_filter1d(place, lag, axis=0, mode="nearest")
    moved = _moved(smooth, lag)
    turned, jitter = _differences(smooth, lag), settings.noise.jitter * _jitter(place, lag)
    still = np.minimum(moved, _moved(place, lag)) <= settings.sampling.window_motion
    if jitter > settings.sampling.window_motion:
        more = moved <= jitter
        if not _follows(d[more], moved[more], turned[more], step, settings):
            still = more
    if still.sum() < settings.noise.enough:
        return float("nan")
    return _variance(d[still], step, settings)


def _moved(place: Array, lag: int) -> Array:
    """Return how far (w - 2 lag,) m the probe at ``place`` (w, 3) m was before or after, ``lag`` samples away."""
    ends = place[: -2 * lag], place[2 * lag :]
    return np.asarray(np.maximum(*(np.linalg.norm(end - place[lag:-lag], axis=1) for end in ends)))


def _jitter(place: Array, lag: int) -> float:
    """Return how far (m rms) the path ``place`` (w, 3) m of a still probe, smoothed over ``lag`` samples, seems to move
    over as many, by its second differences, which a steady motion does not enter; 0 where they grow faster than
    the lag: those of a motion grow with its square, those of noise at most with its root."""
    short, long = 0.0, 0.0
    for n in (max(lag // 2, 1), lag):
        d = _differences(uniform_filter1d(place, n, axis=0, mode="nearest"), n)
        short, long = long, float(np.linalg.norm(np.median(np.abs(d), axis=0))) / MAD_PER_SIGMA
    return long * float(np.sqrt(2.0 / DIFFERENCES)) if long <= 2.0 * short else 0.0


def _follows(d: Array, moved: Array, turned: Array, step: float, settings: Settings) -> bool:
    """Tell whether second differences ``d`` (n, 3) N of the force know where the probe was: by how far (n,) m it
    ``moved``, or by second differences (n, 3) m of its path, which ``turned``. Noise knows neither."""
    near = moved <= np.median(moved)
    parts = [_variance(d[rows], step, settings) for rows in (near, ~near)]
    alone = _variance(d - turned @ np.linalg.lstsq(turned, d, rcond=None)[0], step, settings)
    most = settings.noise.most_uncertain
    return max(parts) > most * min(parts) or _variance(d, step, settings) > most * alone
