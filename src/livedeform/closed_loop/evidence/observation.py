"""What was measured, reduced to key moments, and how large its noise really is.

A recording of 30 s has some 900 frames that are neither independent nor equally informative. ``observe`` cuts it into
windows of equal importance (motion of the markers, plus time so that holds and drifts are seen), averages the frames of
a window, and keeps for each window: the mean points, their covariance with the *effective* number of frames, the
probe's pose, the wrench, and the block (press or stretch of time) to which it belongs for cross-validation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common.errors import RecordingError
from livedeform.common.frames import PosePath
from livedeform.common.types import Array, MarkerFrame, Pose, Wrench

DEFAULT_POINT_SIGMA = 1e-4  # m, where neither the tracker nor repeats say more
WINDOW_SECONDS = 0.5  # longest window over which frames are averaged
WINDOW_MOTION = (
    5e-5  # m, motion of the probe or the markers beyond which frames are not averaged: a kink would bias the mean
)
PER_MOMENT = (
    "stamps_ns",
    "points",
    "covariances",
    "single",
    "single_covariances",
    "weights",
    "velocities",
    "phases",
    "n_frames",
    "n_effective",
)
MOVING = 40.0  # ratio of the variance of means to that of white noise beyond which a stretch is motion, not noise
STILL_SPEED = 5e-4  # m/s, below which probe and markers are at rest


@dataclass(frozen=True)
class Track:
    """All frames of one recording on one set of markers: ``points`` (f, m, 3) with NaN where a marker was not seen,
    ``covariances`` (f, m, 3, 3) as stated by the tracker (NaN where it states none)."""

    stamps_ns: np.ndarray
    ids: np.ndarray
    points: Array
    covariances: Array


@dataclass(frozen=True)
class NoiseReport:
    """How large the noise is, from the recording itself.

    ``covariance`` (m, 3, 3) m2 of one frame's point; ``scale`` measured over stated variance (NaN: none was stated);
    ``correlation_time`` s and ``inflation`` = n / n_effective of the mean of many frames; ``n_differences`` second
    differences went into it.
    """

    covariance: Array
    scale: float
    correlation_time: float
    inflation: float
    n_differences: int
    n_outliers: int

    @property
    def repeated(self) -> float:
        """The share of the covariance that repeats show; the rest is an error that lasts, as of a dot's shape."""
        return min(self.scale, 1.0) if np.isfinite(self.scale) else 1.0


@dataclass(frozen=True)
class Observation:
    """One recording at ``k`` key moments.

    ``points`` (k, m, 3) means over the windows, NaN where not seen; ``covariances`` (k, m, 3, 3) of these means;
    ``single`` (k, m, 3) the one frame nearest to each key moment, for error metrics that need no averaging;
    ``weights`` (k,) s, the time that each moment stands for; ``poses`` of the probe (None without a probe),
    ``velocities`` (k, 3) m/s of its origin; ``forces`` (k, 3) N or None; ``blocks`` (k,) for cross-validation,
    ``phases`` (k,) one of rest, press, hold, retreat; ``n_frames`` (k,), ``n_effective`` (k,) frames in the mean;
    ``path``: all poses of the recording; ``wrench_times`` (w,) s since its start and ``wrench_forces`` (w, 3) N: all
    of its forces. ``before``: what the same body went through earlier, as far as it remembers for good.
    """

    name: str
    stamps_ns: np.ndarray
    ids: np.ndarray
    points: Array
    covariances: Array
    single: Array
    single_covariances: Array
    weights: Array
    poses: tuple[Pose | None, ...]
    velocities: Array
    forces: Array | None
    force_sigma: float
    blocks: np.ndarray
    phases: np.ndarray
    n_frames: np.ndarray
    n_effective: Array
    noise: NoiseReport
    start_ns: int
    path: tuple[Pose, ...] = ()
    wrench_times: Array = field(default_factory=lambda: np.zeros(0))
    wrench_forces: Array = field(default_factory=lambda: np.zeros((0, 3)))
    before: Observation | None = None

    def force_later(self, offset: float) -> Array:
        """By how much (k, 3) N the recorded force at the key moments' stamps + ``offset`` s differs from that at the
        stamps: pose and wrench come by one clock."""
        if not len(self.wrench_times):
            return np.zeros((self.n_moments, 3))
        t = self.seconds
        force = [
            np.interp(t + offset, self.wrench_times, f) - np.interp(t, self.wrench_times, f)
            for f in self.wrench_forces.T
        ]
        return np.column_stack(force)

    @property
    def n_moments(self) -> int:
        return len(self.stamps_ns)

    def take(self, keep: np.ndarray) -> Observation:
        """Some of the moments (k,) bool; the recording's start and poses stay."""
        each = {name: getattr(self, name)[keep] for name in PER_MOMENT}
        blocks = np.unique(self.blocks[keep], return_inverse=True)[1]
        poses = tuple(p for p, k in zip(self.poses, keep, strict=True) if k)
        forces = None if self.forces is None else self.forces[keep]
        return replace(self, **each, blocks=blocks, poses=poses, forces=forces)

    def with_all_before(self) -> Observation:
        """The moments of what was `before`, one recording after another, and then these."""
        if self.before is None:
            return self
        first = self.before.with_all_before()
        each: dict[str, Any] = {
            name: np.concatenate([getattr(first, name), getattr(self, name)]) for name in PER_MOMENT
        }
        forces = np.concatenate(
            [np.full((o.n_moments, 3), np.nan) if o.forces is None else o.forces for o in (first, self)]
        )
        return replace(
            self,
            **each,
            poses=first.poses + self.poses,
            forces=None if self.forces is None else forces,
            blocks=np.concatenate([first.blocks, self.blocks + first.blocks.max() + 1]),
            path=first.path if first.path is self.path else first.path + self.path,
            start_ns=first.start_ns,
            before=None,
        )

    @property
    def seconds(self) -> Array:
        """Time of each key moment since the recording's start (k,) s."""
        return (self.stamps_ns - self.start_ns) * 1e-9


def track(frames: Sequence[MarkerFrame], ids: np.ndarray | None = None) -> Track:
    """The frames on one set of markers, in the order of their stamps; markers that are not in ``ids`` are left out."""
    if not frames:
        raise RecordingError(
            "the recording has no marker frames", remedy="run stereo_node on it first, or check the topic"
        )
    frames = sorted(frames, key=lambda f: f.stamp_ns)
    stamps = np.array([f.stamp_ns for f in frames], np.int64)
    keep = np.r_[True, np.diff(stamps) > 0]  # a repeated stamp is a repeated message
    frames = [f for f, k in zip(frames, keep, strict=True) if k]
    if ids is None:
        ids = np.unique(np.concatenate([f.ids for f in frames]))
    ids = np.asarray(ids)
    order = np.argsort(ids)
    points = np.full((len(frames), len(ids), 3), np.nan)
    covariances = np.full((len(frames), len(ids), 3, 3), np.nan)
    for k, frame in enumerate(frames):
        place = np.searchsorted(ids, frame.ids, sorter=order).clip(max=len(ids) - 1)
        place = order[place]
        known = ids[place] == frame.ids
        points[k, place[known]] = frame.points[known]
        covariances[k, place[known]] = frame.covariances[known]
    return Track(stamps[keep], ids, points, covariances)


def noise_of(data: Track) -> NoiseReport:
    """The size of the measuring noise from second differences in time, and its correlation from still stretches.

    For white noise of variance s2, d = y[t-1] - 2 y[t] + y[t+1] has variance 6 s2, and smooth motion hardly enters
    (von Neumann et al. 1941). The median of d2 keeps jerks and outliers out. One factor, not below one, scales the
    stated covariances: a tracker knows its anisotropy better than a recording does.
    """
    y = data.points
    m = y.shape[1]
    if len(y) >= 5:
        d = y[:-2] - 2.0 * y[1:-1] + y[2:]
        seen = np.asarray(np.isfinite(d).all(axis=2))
    else:
        d, seen = np.zeros((0, m, 3)), np.zeros((0, m), bool)
    stated = _mean_covariance(data.covariances)
    ever = np.isfinite(y).all(axis=2).any(axis=0)  # a marker that is never seen states nothing
    has_stated = bool(ever.any()) and np.isfinite(stated[ever]).all(axis=(1, 2)).mean() > 0.5
    n_differences = int(seen.sum())
    quiet = _quiet_differences(data, seen)
    if has_stated:
        complete = np.asarray(np.isfinite(stated).all(axis=(1, 2)))
        usual = stated[complete].mean(axis=0)  # a mean of covariances is one; a median of their elements need not be
        covariance = np.where(complete[:, None, None], stated, usual)
        scale = 1.0
        if quiet.sum() >= 30:
            frame_cov = np.where(np.isfinite(data.covariances[1:-1]), data.covariances[1:-1], covariance)
            z2 = np.einsum("fmi,fmij,fmj->fm", _zeros(d), np.linalg.inv(frame_cov), _zeros(d))[quiet] / 6.0
            scale = float(np.median(z2) / 2.366)  # the median of chi2 with three degrees of freedom is 2.366
        # what repeats do not show, a systematic part, may be stated with reason: never less than that
        covariance = covariance * max(scale, 1.0)
    else:
        scale = float("nan")
        covariance = _measured_covariance(d, quiet, m)
    correlation_time, inflation = _correlation(data, covariance)
    return NoiseReport(
        covariance, scale, correlation_time, inflation, n_differences, _count_outliers(d, seen, covariance)
    )


def observe(
    name: str,
    data: Track,
    poses: Sequence[Pose] = (),
    wrenches: Sequence[Wrench] = (),
    *,
    n_moments: int = 48,
    start_ns: int | None = None,
    force_sigma: float = float("nan"),
    noise: NoiseReport | None = None,
    release: float = 0.0,
) -> Observation:
    """The recording at ``n_moments`` key moments of equal importance (see the module's text)."""
    noise = noise or noise_of(data)
    start_ns = int(data.stamps_ns[0]) if start_ns is None else start_ns
    t = (data.stamps_ns - start_ns) * 1e-9
    probe = poses_at(poses, data.stamps_ns) if len(poses) >= 2 else None
    if probe is not None:  # no pose, no prediction: frames beyond the poses' span are left out
        inside = (data.stamps_ns >= poses[0].stamp_ns) & (data.stamps_ns <= poses[-1].stamp_ns)
        if inside.sum() < 2:
            raise RecordingError(
                "marker frames and probe poses do not overlap in time", where=name, remedy="check the clocks' stamps"
            )
        data = Track(data.stamps_ns[inside], data.ids, data.points[inside], data.covariances[inside])
        t, probe = t[inside], (probe[0][inside], probe[1][inside])
    motion = marker_motion(data, noise)
    centres, borders = _cells(t, motion, n_moments)
    speed = np.gradient(motion, t) if len(t) > 1 else np.zeros(1)
    rows = [_window(t, motion, probe, centres[k], borders[k], borders[k + 1]) for k in range(len(centres))]
    points, covariances, n_frames, n_effective = _averages(data, noise, rows)
    key = np.array([rows[k][np.argmin(np.abs(t[rows[k]] - t[rows[k]].mean()))] for k in range(len(rows))])
    stamps = np.array([round(float(np.mean(data.stamps_ns[r] - start_ns))) + start_ns for r in rows], np.int64)
    key_poses: tuple[Pose | None, ...] = (None,) * len(rows)
    velocities = np.zeros((len(rows), 3))
    if probe is not None:
        position, rotation = poses_at(poses, stamps)
        key_poses = tuple(Pose(int(s), p, q) for s, p, q in zip(stamps, position, rotation.as_quat(), strict=True))
        velocity = np.gradient(probe[0], t, axis=0)
        velocities = np.array([velocity[r].mean(axis=0) for r in rows])
    forces, force_sigma = _forces(wrenches, stamps, rows, t, start_ns, force_sigma)
    phases = _phases(np.array([speed[r].mean() for r in rows]), motion[key], velocities)
    in_order = sorted(wrenches, key=lambda w: w.stamp_ns) if forces is not None else []
    return Observation(
        name=name,
        stamps_ns=stamps,
        ids=data.ids,
        points=points,
        covariances=covariances,
        single=data.points[key],
        single_covariances=np.broadcast_to(
            noise.inflation * noise.covariance, (len(key), *noise.covariance.shape)
        ).copy(),
        weights=np.diff(borders),
        poses=key_poses,
        velocities=velocities,
        forces=forces,
        force_sigma=force_sigma,
        blocks=_blocks(t, data, noise, np.array([t[r].mean() for r in rows])),
        phases=phases,
        n_frames=n_frames,
        n_effective=n_effective,
        noise=noise,
        start_ns=start_ns,
        path=tuple(poses),
        wrench_times=np.array([(w.stamp_ns - start_ns) * 1e-9 for w in in_order]),
        wrench_forces=np.array([w.force for w in in_order]).reshape(-1, 3),
    )


def poses_at(poses: Sequence[Pose], stamps_ns: np.ndarray, offset: float = 0.0) -> tuple[Array, Rotation]:
    """Positions (k, 3) and rotations at ``stamps_ns`` + ``offset`` s, linear and spherical-linear between the poses,
    held at the ends."""
    return PosePath(poses).at(stamps_ns, offset)


def marker_motion(data: Track, noise: NoiseReport) -> Array:
    """Rms displacement of the markers from their place at the start (f,) m, smoothed, with the noise taken off."""
    y = data.points
    n = min(5, len(y))
    rest = _median(y[: max(n, 1)])
    d2 = np.nansum((y - rest) ** 2, axis=2)
    seen = np.isfinite(y).all(axis=2)
    floor = np.trace(noise.covariance, axis1=1, axis2=2).mean()
    rms2 = np.where(seen, d2, 0.0).sum(axis=1) / seen.sum(axis=1).clip(min=1)
    kernel = np.ones(min(5, len(y)))
    smooth = np.convolve(rms2, kernel, "same") / np.convolve(np.ones(len(y)), kernel, "same")
    return np.sqrt(np.maximum(smooth - floor, 0.0))


def _zeros(d: Array) -> Array:
    return np.where(np.isfinite(d), d, 0.0)


def _quiet_differences(data: Track, seen: np.ndarray) -> np.ndarray:
    """Second differences (f - 2, m) that motion hardly enters: evenly sampled, and of the quieter two thirds of
    time."""
    if len(data.stamps_ns) < 5:
        return seen
    dt = np.diff(data.stamps_ns) * 1e-9
    even = np.abs(dt[1:] - dt[:-1]) < 0.3 * np.median(dt)
    slope = np.nanmedian(np.abs(data.points[2:] - data.points[:-2]).sum(axis=2), axis=1)
    with np.errstate(invalid="ignore"):
        slow = slope <= np.nanquantile(slope, 0.67)
    rows = even & slow
    if (seen & rows[:, None]).sum() < 30:
        rows = slow
    return seen & rows[:, None]


def _measured_covariance(d: Array, quiet: np.ndarray, m: int) -> Array:
    """(m, 3, 3) from second differences, by the median, shrunk to the markers' common one."""
    if quiet.sum() < 10:
        return np.broadcast_to(np.eye(3) * DEFAULT_POINT_SIGMA**2, (m, 3, 3)).copy()
    pooled = _robust_covariance(d[quiet]) / 6.0
    out = np.empty((m, 3, 3))
    for i in range(m):
        own = d[quiet[:, i], i]
        w = len(own) / (len(own) + 50.0)
        ratio = np.median((own**2).sum(axis=1)) / np.median((d[quiet] ** 2).sum(axis=1)) if len(own) > 5 else 1.0
        out[i] = pooled * (w * ratio + (1.0 - w))
    return out


def _robust_covariance(d: Array) -> Array:
    """(3, 3) covariance of samples (n, 3) without the ones beyond 3.5 sigma of the median fit."""
    spread = 1.4826 * np.median(np.abs(d), axis=0) + 1e-12
    keep = (np.abs(d) / spread < 3.5).all(axis=1)
    return np.cov(d[keep].T) + np.eye(3) * 1e-16


def _count_outliers(d: Array, seen: np.ndarray, covariance: Array) -> int:
    if not len(d):
        return 0
    z2 = np.einsum("fmi,mij,fmj->fm", _zeros(d), np.linalg.inv(covariance), _zeros(d)) / 6.0
    return int((z2[seen] > 40.0).sum())


def _correlation(data: Track, covariance: Array) -> tuple[float, float]:
    """Correlation time (s) and variance inflation of long means, from what still stretches do beyond white noise.

    Means over n consecutive frames of white noise have variance s2 / n; the ratio of the observed to that variance,
    after a parabola in time is taken off each stretch of about 2 s, estimates n / n_effective = 1 + 2 sum rho_k.
    """
    t = (data.stamps_ns - data.stamps_ns[0]) * 1e-9
    if len(t) < 20:
        return 0.0, 1.0
    dt = float(np.median(np.diff(t)))
    n = max(round(2.0 / dt), 12)
    k = 8 if n >= 32 else 4
    n_short = n // k
    n = k * n_short
    q, _ = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1, 1, n), 2))
    smooth = q @ q.T
    averaging = np.kron(np.eye(k), np.full((1, n_short), 1.0 / n_short))
    kept = averaging @ (np.eye(n) - smooth)
    lost = float(np.sum(kept**2)) * n_short / k  # what the parabola leaves of the variance of white noise's short means
    ratios: list[tuple[float, int]] = []
    for start in range(0, len(t) - n + 1, max(n // 8, 1)):  # a pause of the probe is seldom longer than a stretch
        part = data.points[start : start + n]
        full = np.isfinite(part).all(axis=(0, 2))
        if full.sum() < 3:
            continue
        rest = part[:, full] - np.einsum("fg,gmi->fmi", smooth, part[:, full])
        means = np.einsum("kf,fmi->kmi", averaging, rest)
        sigma2 = covariance[full][:, [0, 1, 2], [0, 1, 2]]
        ratio = float(np.mean(means**2 / (sigma2 / n_short))) / lost
        if ratio < MOVING:
            ratios.append((ratio, start))
    if not ratios:
        return 0.0, 1.0
    # the quietest stretches are the still ones: motion would count as correlation
    quiet: list[tuple[float, int]] = []
    for ratio, start in sorted(ratios):
        if len(quiet) < 3 and all(abs(start - other) >= n for _, other in quiet):
            quiet.append((ratio, start))
    inflation = float(np.clip(np.mean([r for r, _ in quiet]), 1.0, 40.0))
    return 0.5 * dt * (inflation - 1.0), inflation


def _cells(t: Array, motion: Array, n_moments: int) -> tuple[Array, Array]:
    """Times of the key moments and the borders between them: equal shares of motion and time."""
    if len(t) <= n_moments:
        borders = np.r_[t[0], 0.5 * (t[1:] + t[:-1]), t[-1]] if len(t) > 1 else np.array([t[0], t[0] + 1.0])
        return t, borders
    span = t[-1] - t[0]
    change = np.abs(np.diff(motion, prepend=motion[0]))
    moved = change.sum()
    importance = np.diff(t, prepend=t[0]) / span
    if moved > 1e-5:
        importance = 0.45 * importance + 0.55 * change / moved
    cumulated = np.cumsum(importance) / importance.sum()
    quantiles = np.linspace(0.0, 1.0, n_moments + 1)
    borders = np.interp(quantiles, cumulated, t)
    borders[0], borders[-1] = t[0], t[-1]
    centres = np.interp(0.5 * (quantiles[1:] + quantiles[:-1]), cumulated, t)
    frame = np.argmin(np.abs(t[:, None] - centres), axis=0)
    first = np.r_[True, np.diff(frame) > 0]  # a slow camera has one frame for several: it counts once
    return centres[first], np.r_[borders[:-1][first], borders[-1]]


def _window(t: Array, motion: Array, probe: tuple | None, centre: float, low: float, high: float) -> np.ndarray:
    """Rows of the frames around ``centre`` over which averaging is harmless: short, and hardly moving."""
    middle = int(np.argmin(np.abs(t - centre)))
    half = 1
    best = np.array([middle])
    while True:
        a, b = middle - half, middle + half
        if a < 0 or b >= len(t) or t[a] < low - 1e-9 or t[b] > high + 1e-9 or t[b] - t[a] > WINDOW_SECONDS:
            return best
        moved = abs(motion[a] - motion[b])
        if probe is not None:
            moved = max(moved, float(np.linalg.norm(probe[0][a] - probe[0][b])))
        if moved > WINDOW_MOTION:
            return best
        best = np.arange(a, b + 1)
        half += 1


def _averages(data: Track, noise: NoiseReport, rows: list[np.ndarray]) -> tuple[Array, Array, np.ndarray, Array]:
    """Means over each window without gross outliers, and their covariances."""
    k, m = len(rows), data.points.shape[1]
    points = np.full((k, m, 3), np.nan)
    covariances = np.full((k, m, 3, 3), np.nan)
    n_effective = np.zeros(k)
    inverse = np.linalg.inv(noise.covariance)
    for i, r in enumerate(rows):
        part = data.points[r]
        seen = np.isfinite(part).all(axis=2)
        if len(r) >= 3:  # against the window's median, which one wild frame does not move
            d = _zeros(part - _median(part))
            seen &= np.einsum("fmi,mij,fmj->fm", d, inverse, d) < 36.0
        count = seen.sum(axis=0)
        good = count > 0
        total = np.where(seen[..., None], part, 0.0).sum(axis=0)
        points[i, good] = total[good] / count[good, None]
        effective = count / noise.inflation  # correlated noise is larger than its second differences, so also below one
        covariances[i, good] = noise.covariance[good] / effective[good, None, None]
        n_effective[i] = float(effective[good].mean()) if good.any() else 0.0
    return points, covariances, np.array([len(r) for r in rows]), n_effective


def _forces(
    wrenches: Sequence[Wrench], stamps: np.ndarray, rows: list[np.ndarray], t: Array, start_ns: int, sigma: float
) -> tuple[Array | None, float]:
    """Forces (k, 3) N at the key moments, and their sigma from the record's own second differences."""
    if len(wrenches) < 5:
        return None, sigma
    times = np.array([(w.stamp_ns - start_ns) * 1e-9 for w in wrenches])
    order = np.argsort(times)
    force = np.array([wrenches[i].force for i in order])
    times = times[order]
    d = force[:-2] - 2.0 * force[1:-1] + force[2:]
    measured = float(np.median(np.abs(d)) / 0.6745 / np.sqrt(6.0))
    out = np.empty((len(stamps), 3))
    for k, (stamp, r) in enumerate(zip(stamps, rows, strict=True)):
        inside = (times >= t[r[0]] - 1e-9) & (times <= t[r[-1]] + 1e-9)
        here = (stamp - start_ns) * 1e-9
        if inside.sum() >= 3:
            out[k] = force[inside].mean(axis=0)
        else:
            out[k] = [np.interp(here, times, force[:, i]) for i in range(3)]
    return out, (sigma if np.isfinite(sigma) else max(measured, 1e-4))


def _phases(rate: Array, motion: Array, velocities: Array) -> np.ndarray:
    """rest, press, hold or retreat of each key moment, by how far the markers are from rest and how that changes."""
    pressed = motion > max(0.05 * float(motion.max(initial=0.0)), 5e-5)
    moving = (np.abs(rate) > STILL_SPEED) | (np.linalg.norm(velocities, axis=1) > 4.0 * STILL_SPEED)
    return np.where(~pressed & ~moving, "rest", np.where(~moving, "hold", np.where(rate >= 0.0, "press", "retreat")))


def _blocks(t: Array, data: Track, noise: NoiseReport, centres: Array) -> np.ndarray:
    """Blocks for cross-validation: one per press (from rest over the press to the next), never fewer than four; long
    rests make blocks of their own."""
    motion = marker_motion(data, noise)
    level = max(0.15 * float(motion.max(initial=0.0)), 1e-4)
    pressed = motion > level
    edges = [t[0]]
    starts = np.flatnonzero(pressed[1:] & ~pressed[:-1]) + 1
    ends = np.flatnonzero(~pressed[1:] & pressed[:-1]) + 1
    for end in ends:  # a press's block ends half way to the next press: its recovery belongs to it
        later = starts[starts > end]
        if len(later):
            edges.append(0.5 * (t[end] + t[later[0]]))
    edges = [e for i, e in enumerate(edges) if i == 0 or e - edges[i - 1] > 0.5]
    edges.append(t[-1] + 1e-9)
    while len(edges) - 1 < 4:
        widths = np.diff(edges)
        widest = int(np.argmax(widths))
        edges.insert(widest + 1, edges[widest] + 0.5 * widths[widest])
    return (np.searchsorted(np.array(edges), centres, side="right") - 1).clip(0, len(edges) - 2)


def _median(part: Array) -> Array:
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
