"""Choose the moments of a recording that are kept: windows of equal importance, their means, phases and blocks of
time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from livedeform.closed_loop.evidence.force_noise import ForceNoise, noise_of_force
from livedeform.closed_loop.evidence.measuring_noise import MarkerMotion, NoiseReport, median, zeros
from livedeform.closed_loop.evidence.track import Track
from livedeform.closed_loop.settings import NoiseSettings, SamplingSettings, Settings
from livedeform.common.checks.recorded import POSES_APART_NS
from livedeform.common.frames import PosePath
from livedeform.common.types import Array, Wrench

SOME_MOTION = 1e-5  # m, in all, below which there is none to share out


def cells(t: Array, motion: Array, n_moments: int, settings: SamplingSettings) -> tuple[Array, Array]:
    """Times of the key moments and the borders between them: equal shares of motion and time."""
    if len(t) <= n_moments:
        borders = np.r_[t[0], 0.5 * (t[1:] + t[:-1]), t[-1]] if len(t) > 1 else np.array([t[0], t[0] + 1.0])
        return t, borders
    span = t[-1] - t[0]
    change = np.abs(np.diff(motion, prepend=motion[0]))
    moved = change.sum()
    importance = np.diff(t, prepend=t[0]) / span
    if moved > SOME_MOTION:
        share = settings.share_of_time
        importance = share * importance + (1.0 - share) * change / moved
    cumulated = np.cumsum(importance) / importance.sum()
    quantiles = np.linspace(0.0, 1.0, n_moments + 1)
    borders = np.interp(quantiles, cumulated, t)
    borders[0], borders[-1] = t[0], t[-1]
    centres = np.interp(0.5 * (quantiles[1:] + quantiles[:-1]), cumulated, t)
    frame = np.argmin(np.abs(t[:, None] - centres), axis=0)
    first = np.r_[True, np.diff(frame) > 0]  # a slow camera has one frame for several: it counts once
    return centres[first], np.r_[borders[:-1][first], borders[-1]]


def window(
    t: Array, motion: Array, probe: Array | None, centre: float, low: float, high: float, settings: SamplingSettings
) -> np.ndarray:
    """Rows of the frames around ``centre`` over which averaging is harmless: short, and hardly moving."""
    middle = int(np.argmin(np.abs(t - centre)))
    half = 1
    best = np.array([middle])
    while True:
        a, b = middle - half, middle + half
        if a < 0 or b >= len(t) or t[a] < low - 1e-9 or t[b] > high + 1e-9 or t[b] - t[a] > settings.window_seconds:
            return best
        moved = abs(motion[a] - motion[b])
        if probe is not None:
            moved = max(moved, float(np.linalg.norm(probe[a] - probe[b])))
        if moved > settings.window_motion:
            return best
        best = np.arange(a, b + 1)
        half += 1


def averages(
    data: Track, noise: NoiseReport, rows: list[np.ndarray], settings: NoiseSettings
) -> tuple[Array, Array, np.ndarray, Array]:
    """Means over each window without gross outliers, and their covariances: a frame that the tracker states to be
    noisier than usual counts less."""
    k, m = len(rows), data.points.shape[1]
    points = np.full((k, m, 3), np.nan)
    covariances = np.full((k, m, 3, 3), np.nan)
    n_effective = np.zeros(k)
    inverse = np.linalg.inv(noise.covariance)
    variance = data.over_usual(settings.most_trusted)
    for i, r in enumerate(rows):
        part = data.points[r]
        seen = np.isfinite(part).all(axis=2)
        if len(r) >= 3:  # against the window's median, which one wild frame does not move
            d = zeros(part - median(part))
            seen &= np.einsum("fmi,mij,fmj->fm", d, inverse, d) < settings.outlier**2 * variance[r]
        weight = np.where(seen, 1.0 / variance[r], 0.0)
        total = weight.sum(axis=0)
        good = total > 0.0
        points[i, good] = np.einsum("fm,fmi->mi", weight, zeros(part))[good] / total[good, None]
        # a mean is no worse than the best of its frames
        effective = np.maximum(total / noise.inflation, weight.max(axis=0))
        covariances[i, good] = noise.covariance[good] / effective[good, None, None]
        n_effective[i] = float(effective[good].mean()) if good.any() else 0.0
    return points, covariances, np.array([len(r) for r in rows]), n_effective


def forces_at(
    wrenches: Sequence[Wrench],
    stamps: np.ndarray,
    rows: list[np.ndarray],
    t: Array,
    start_ns: int,
    sigma: float,
    settings: Settings,
    path: PosePath | None = None,
) -> tuple[Array | None, ForceNoise]:
    """Forces (k, 3) N at the key moments, NaN where wrenches are as far apart as poses that are not interpolated, and
    their noise, of a given ``sigma`` N or from the record itself (`noise_of_force`), with the probe's ``path``; None
    where there are too few."""
    given = ForceNoise(sigma)
    if len(wrenches) < settings.noise.least_wrenches:
        return None, given
    wrenches = sorted(wrenches, key=lambda w: w.stamp_ns)
    at = np.array([w.stamp_ns for w in wrenches])
    force, times = np.array([w.force for w in wrenches]), (at - start_ns) * 1e-9
    place = np.zeros((len(at), 3)) if path is None else path.at(at)[0]
    out = np.empty((len(stamps), 3))
    for k, (stamp, r) in enumerate(zip(stamps, rows, strict=True)):
        inside = (times >= t[r[0]] - 1e-9) & (times <= t[r[-1]] + 1e-9)
        here = (stamp - start_ns) * 1e-9
        if inside.sum() >= 3:
            out[k] = force[inside].mean(axis=0)
        else:
            near = _apart_at(times, here) <= 1e-9 * POSES_APART_NS
            out[k] = [np.interp(here, times, force[:, i]) for i in range(3)] if near else np.nan
    if not np.isfinite(out).any():
        return None, given
    return out, given if np.isfinite(sigma) else noise_of_force(force, times, place, settings)


def _apart_at(times: Array, t: float) -> float:
    """Return how far apart s those of sorted ``times`` are between which ``t`` lies; infinite beyond their ends."""
    after = int(np.searchsorted(times, t))
    return float(times[after] - times[after - 1]) if 0 < after < len(times) else np.inf


def phases_of(
    rate: Array, motion: MarkerMotion, key: np.ndarray, velocities: Array, settings: SamplingSettings
) -> np.ndarray:
    """rest, press, hold or retreat of each key moment, which are the frames ``key``, by how far the markers are from
    rest and how that changes."""
    here = motion.clear[key]
    level = max(settings.pressed_level * float(here.max(initial=0.0)), settings.pressed_motion, motion.unclear)
    pressed = here > level
    moving = (np.abs(rate) > settings.still_speed) | (np.linalg.norm(velocities, axis=1) > settings.still_probe)
    return np.where(~pressed & ~moving, "rest", np.where(~moving, "hold", np.where(rate >= 0.0, "press", "retreat")))


def blocks_at(t: Array, motion: MarkerMotion, centres: Array, settings: SamplingSettings) -> np.ndarray:
    """Blocks for cross-validation: one per press (from rest over the press to the next), never fewer than
    ``least_blocks``; long rests make blocks of their own."""
    pressed = _pressed(motion, settings)
    edges = [t[0]]
    starts = np.flatnonzero(pressed[1:] & ~pressed[:-1]) + 1
    ends = np.flatnonzero(~pressed[1:] & pressed[:-1]) + 1
    for end in ends:  # a press's block ends half way to the next press: its recovery belongs to it
        later = starts[starts > end]
        if len(later):
            edges.append(0.5 * (t[end] + t[later[0]]))
    edges = [e for i, e in enumerate(edges) if i == 0 or e - edges[i - 1] > settings.block_seconds]
    edges.append(t[-1] + 1e-9)
    while len(edges) - 1 < settings.least_blocks:
        widths = np.diff(edges)
        widest = int(np.argmax(widths))
        edges.insert(widest + 1, edges[widest] + 0.5 * widths[widest])
    at = (np.searchsorted(np.array(edges), centres, side="right") - 1).clip(0, len(edges) - 2)
    return np.asarray(np.unique(at, return_inverse=True)[1])  # those without a moment have no number


def presses_at(motion: MarkerMotion, key: np.ndarray, settings: SamplingSettings) -> np.ndarray:
    """Number (k,) of the press that is going on in each of the frames ``key``, from 1; 0 where there is none."""
    pressed = _pressed(motion, settings)
    number = np.cumsum(np.diff(pressed, prepend=False) & pressed)
    return np.asarray(np.where(pressed, number, 0)[key])


def _pressed(motion: MarkerMotion, settings: SamplingSettings) -> np.ndarray:
    """Tell of each frame (f,) whether the body is pressed: from above a level until so far below it as noise does not
    reach from there (the root of a mean square, so half as far as from rest where both are alike)."""
    x = motion.clear
    level = max(settings.block_level * float(x.max(initial=0.0)), settings.block_motion, motion.unclear)
    decided = (x > level) | (x <= level - 0.5 * motion.unclear**2 / level)
    last = np.maximum.accumulate(np.where(decided, np.arange(len(x)), 0))  # frames between go with the one before
    return np.asarray(x[last] > level)
