"""Observations: what was measured, reduced to key moments, and how large its noise really is.

A recording of 30 s has some 900 frames that are neither independent nor equally informative. `observe` cuts it into
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

from livedeform.closed_loop.evidence.key_moments import (
    averages,
    blocks_at,
    cells,
    forces_at,
    phases_of,
    presses_at,
    window,
)
from livedeform.closed_loop.evidence.measuring_noise import MarkerMotion, NoiseReport, marker_motion, noise_of
from livedeform.closed_loop.evidence.track import Track
from livedeform.closed_loop.settings import Settings
from livedeform.common.checks.recorded import POSES_APART_NS
from livedeform.common.errors import RecordingError
from livedeform.common.frames import PosePath
from livedeform.common.types import Array, Pose, Wrench

PER_MOMENT = (
    "stamps_ns",
    "points",
    "rates",
    "covariances",
    "single",
    "single_covariances",
    "weights",
    "velocities",
    "phases",
    "presses",
    "n_frames",
    "n_effective",
)


@dataclass(frozen=True)
class Observation:
    """One recording at ``k`` key moments.

    ``points`` (k, m, 3) means over the windows, NaN where not seen, and their ``rates`` (k, m, 3) m/s from frame to
    frame, 0 where not known; ``covariances`` (k, m, 3, 3) of these means;
    ``single`` (k, m, 3) the one frame nearest to each key moment, for error metrics that need no averaging;
    ``weights`` (k,) s, the time that each moment stands for; ``poses`` of the probe (None without a probe),
    ``velocities`` (k, 3) m/s of its origin; ``forces`` (k, 3) N or None; ``blocks`` (k,) for cross-validation,
    ``phases`` (k,) one of rest, press, hold, retreat, ``presses`` (k,) the number of the press that is going on, from
    1, or 0; ``n_frames`` (k,), ``n_effective`` (k,) frames in the mean;
    ``path``: all poses of the recording; ``wrench_times`` (w,) s since its start and ``wrench_forces`` (w, 3) N: all
    of its forces. ``before``: what the same body went through earlier, as far as it remembers for good.
    ``patience``: iterations for a moment, after which the model's run is given up; as many as it takes for what was
    recorded. ``force_told``: ``force_sigma`` is known to be all of the force's noise (`ForceNoise`).
    """

    name: str
    stamps_ns: np.ndarray
    ids: np.ndarray
    points: Array
    rates: Array
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
    presses: np.ndarray
    n_frames: np.ndarray
    n_effective: Array
    noise: NoiseReport
    start_ns: int
    path: tuple[Pose, ...] = ()
    wrench_times: Array = field(default_factory=lambda: np.zeros(0))
    wrench_forces: Array = field(default_factory=lambda: np.zeros((0, 3)))
    before: Observation | None = None
    patience: float = np.inf
    force_told: bool = True

    def force_later(self, offset: float) -> Array:
        """Return by how much (k, 3) N the recorded force at the key moments' stamps + ``offset`` s differs from that at
        the stamps: pose and wrench come by one clock."""
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

    def deepest(self, most: int) -> np.ndarray:
        """Return the first moment, and of each block in which markers move the one at which they are furthest away, of
        at most so many blocks."""
        d = np.linalg.norm(self.points - self.points[0], axis=2)
        size = np.array([float(np.sqrt(np.nanmean(row**2))) if np.isfinite(row).any() else 0.0 for row in d])
        rows = [np.flatnonzero(self.blocks == b) for b in np.unique(self.blocks)]
        best = [int(r[np.argmax(size[r])]) for r in rows]
        best = sorted(best, key=lambda i: -size[i])[:most]
        return np.unique([0, *(i for i in best if size[i] > 0.2 * size.max())])

    @property
    def known_forces(self) -> Array:
        """Forces (k, 3) N, NaN where none is known."""
        return np.full((self.n_moments, 3), np.nan) if self.forces is None else self.forces

    def with_all_before(self) -> Observation:
        """The moments of what was `before`, one recording after another, and then these."""
        if self.before is None:
            return self
        first = self.before.with_all_before()
        each: dict[str, Any] = {
            name: np.concatenate([getattr(first, name), getattr(self, name)]) for name in PER_MOMENT
        }
        forces = np.concatenate([first.known_forces, self.known_forces])
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

    def with_part_before(self) -> Observation:
        """The moments of the same recording that were `before`, if it was parted, and then these."""
        first = self.before
        if first is None or (first.name, first.start_ns) != (self.name, self.start_ns):
            return self
        return replace(self, before=replace(first, before=None)).with_all_before()

    @property
    def seconds(self) -> Array:
        """Time of each key moment since the recording's start (k,) s."""
        return (self.stamps_ns - self.start_ns) * 1e-9


def are_pressed(observations: Sequence[Observation]) -> bool:
    """Tell whether a probe moves in any of them; a body without one is loaded otherwise, or let go."""
    return any(len(o.path) for o in observations)


def are_untouched(held_out: Sequence[Observation], fitted: Sequence[Observation]) -> bool:
    """Tell whether no press is ``held_out`` while some were ``fitted``: what a press shows is seen in these alone."""
    pressed = [any((o.presses > 0).any() for o in part) for part in (held_out, fitted)]
    return pressed == [False, True] and are_pressed(fitted)


def move_by_themselves(observations: Sequence[Observation]) -> bool:
    """Tell whether the body moves though no probe does, as after it was let go."""
    moves = any(np.isin(o.phases, ("press", "retreat")).any() for o in observations)
    return moves and not are_pressed(observations)


def observe(
    name: str,
    data: Track,
    poses: Sequence[Pose] = (),
    wrenches: Sequence[Wrench] = (),
    *,
    settings: Settings,
    n_moments: int | None = None,
    start_ns: int | None = None,
    force_sigma: float = float("nan"),
    noise: NoiseReport | None = None,
) -> Observation:
    """Reduce the recording to ``n_moments`` key moments of equal importance (see the module's text)."""
    noise = noise or noise_of(data, settings.noise)
    start = int(data.stamps_ns[0]) if start_ns is None else start_ns
    # 1. frames that have a pose: without one there is no prediction
    data, probe = _with_poses(name, data, poses)
    # 2. windows of equal importance, and their means
    cut = _windows(data, probe, noise, start, n_moments or settings.sampling.moments_fit, settings)
    points, covariances, n_frames, n_effective = averages(data, noise, cut.rows, settings.noise)
    # 3. where the probe was then, what the body was doing, and how hard it was pressed
    key_poses, velocities = _probe_at(poses, probe, cut)
    observation = Observation(
        name=name,
        stamps_ns=cut.stamps_ns,
        ids=data.ids,
        points=points,
        rates=_rates_at(data, cut.rows),
        covariances=covariances,
        single=data.points[cut.key],
        single_covariances=noise.covariance * data.over_usual(settings.noise.most_trusted)[cut.key][..., None, None],
        weights=np.diff(cut.borders),
        poses=key_poses,
        velocities=velocities,
        forces=None,
        force_sigma=force_sigma,
        blocks=blocks_at(cut.t, cut.motion, cut.mean_of(cut.t), settings.sampling),
        phases=phases_of(cut.mean_of(cut.speed), cut.motion, cut.key, velocities, settings.sampling),
        presses=presses_at(cut.motion, cut.key, settings.sampling),
        n_frames=n_frames,
        n_effective=n_effective,
        noise=noise,
        start_ns=start,
        path=tuple(poses),
    )
    return _with_forces(observation, wrenches, cut, settings)


def _rates_at(data: Track, rows: Sequence[np.ndarray]) -> Array:
    """Return how fast (k, m, 3) m/s the markers move over the windows' ``rows``, from the frames around; 0 where these
    do not tell."""
    if len(data.stamps_ns) < 2:
        return np.zeros((len(rows), *data.points.shape[1:]))
    rate = np.gradient(data.points, 1e-9 * (data.stamps_ns - data.stamps_ns[0]), axis=0)
    return np.array([np.nan_to_num(rate[r].mean(axis=0)) for r in rows])


@dataclass(frozen=True)
class Windows:
    """A recording cut into windows: times ``t`` (f,) s and ``motion`` of its frames, the frames of each window
    as ``rows``, the ``borders`` (k + 1,) s between windows and their mean ``stamps_ns`` (k,)."""

    t: Array
    motion: MarkerMotion
    rows: list[np.ndarray]
    borders: Array
    stamps_ns: np.ndarray

    @property
    def key(self) -> np.ndarray:
        """The frame (k,) nearest to the mean time of each window."""
        return np.array([r[np.argmin(np.abs(self.t[r] - self.t[r].mean()))] for r in self.rows])

    @property
    def speed(self) -> Array:
        """Speed (f,) m/s of the markers."""
        return np.gradient(self.motion.size, self.t) if len(self.t) > 1 else np.zeros(1)

    def mean_of(self, x: Array) -> Array:
        """Average ``x`` (f,) over the windows (k,)."""
        return np.array([x[r].mean() for r in self.rows])


def _windows(
    data: Track, probe: Array | None, noise: NoiseReport, start: int, n_moments: int, settings: Settings
) -> Windows:
    """Cut frames into ``n_moments`` windows of equal importance; times count from ``start`` ns."""
    t = (data.stamps_ns - start) * 1e-9
    motion = marker_motion(data, noise, settings.noise)
    centres, borders = cells(t, motion.size, n_moments, settings.sampling)
    cuts = zip(centres, borders[:-1], borders[1:], strict=True)
    rows = [window(t, motion.size, probe, *at, settings.sampling) for at in cuts]
    stamps = np.array([round(float(np.mean(data.stamps_ns[r] - start))) + start for r in rows], np.int64)
    return Windows(t, motion, rows, borders, stamps)


def _with_poses(name: str, data: Track, poses: Sequence[Pose]) -> tuple[Track, Array | None]:
    """Leave frames beyond the poses' span out, and those between poses too far apart to tell where the probe is; also
    gives where it is (f, 3) m, None without a probe."""
    if len(poses) < 2:
        return data, None
    inside = (data.stamps_ns >= poses[0].stamp_ns) & (data.stamps_ns <= poses[-1].stamp_ns)
    told = inside & ~_in_gaps(data.stamps_ns, poses)
    if told.sum() < 2:
        apart = f"the probe's poses are more than {1e-9 * POSES_APART_NS:g} s apart wherever markers were measured"
        raise RecordingError(
            apart if inside.sum() >= 2 else "marker frames and probe poses do not overlap in time",
            where=name,
            remedy="record poses more often" if inside.sum() >= 2 else "check the clocks' stamps",
        )
    position, _ = poses_at(poses, data.stamps_ns)
    return data.take(told), position[told]


def _in_gaps(stamps_ns: np.ndarray, poses: Sequence[Pose]) -> np.ndarray:
    """Tell which stamps (f,) lie between poses that are too far apart to be interpolated (`POSES_APART_NS`)."""
    at = np.sort([p.stamp_ns for p in poses])
    after = np.searchsorted(at, stamps_ns).clip(1, len(at) - 1)  # a frame with a pose's own stamp is before it
    wide = at[after] - at[after - 1] > POSES_APART_NS
    return np.asarray(wide & (stamps_ns > at[after - 1]) & (stamps_ns < at[after]))


def _probe_at(poses: Sequence[Pose], probe: Array | None, cut: Windows) -> tuple[tuple[Pose | None, ...], Array]:
    """Give the poses at the key moments' stamps and the mean velocities (k, 3) m/s over their windows."""
    if probe is None:
        return (None,) * len(cut.rows), np.zeros((len(cut.rows), 3))
    position, rotation = poses_at(poses, cut.stamps_ns)
    each = zip(cut.stamps_ns, position, rotation.as_quat(), strict=True)
    velocity = np.gradient(probe, cut.t, axis=0)
    return tuple(Pose(int(s), p, q) for s, p, q in each), np.array([velocity[r].mean(axis=0) for r in cut.rows])


def _with_forces(o: Observation, wrenches: Sequence[Wrench], cut: Windows, settings: Settings) -> Observation:
    """Add the forces at the key moments, their noise, and the recording's course of the force."""
    path = PosePath(o.path) if len(o.path) > 1 else None
    forces, noise = forces_at(wrenches, o.stamps_ns, cut.rows, cut.t, o.start_ns, o.force_sigma, settings, path)
    o = replace(o, force_sigma=noise.sigma, force_told=noise.told)
    if forces is None:
        return o
    in_order = sorted(wrenches, key=lambda w: w.stamp_ns)
    times = np.array([(w.stamp_ns - o.start_ns) * 1e-9 for w in in_order])
    course = np.array([w.force for w in in_order]).reshape(-1, 3)
    return replace(o, forces=forces, wrench_times=times, wrench_forces=course)


def poses_at(poses: Sequence[Pose], stamps_ns: np.ndarray, offset: float = 0.0) -> tuple[Array, Rotation]:
    """Give positions (k, 3) and rotations at ``stamps_ns`` + ``offset`` s, linear and spherical-linear between the
    poses, held at the ends."""
    return PosePath(poses).at(stamps_ns, offset)
