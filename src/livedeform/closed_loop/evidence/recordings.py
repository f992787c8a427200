"""Turn recordings into observations: markers, key moments, what is held out, and where the probe pressed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from livedeform.closed_loop.evidence.observation import Observation, observe
from livedeform.closed_loop.evidence.own_ids import with_own_ids
from livedeform.closed_loop.evidence.rounding import of_rounding
from livedeform.closed_loop.evidence.track import Track, track
from livedeform.closed_loop.progress import Tell
from livedeform.closed_loop.settings import SamplingSettings, Settings
from livedeform.common.bags.recording import Recording, recording_name
from livedeform.common.checks.exchanged import exchanges_in
from livedeform.common.checks.presses import shows_the_body
from livedeform.common.errors import RecordingError
from livedeform.common.experiment.yaml_file import Experiment
from livedeform.common.types import Array, Image, MarkerFrame, Pose
from livedeform.stereo_node.effects.view import View
from livedeform.stereo_node.pairing import recorded_pairs
from livedeform.stereo_node.pipeline import StereoTracker

TOLD_EVERY = 25  # pairs of pictures
SOONER = 0.9  # of the interval between two pairs, by which the next one may come


@dataclass(frozen=True)
class Evidence:
    """Recordings at key moments: those that are ``fitted`` and those that are ``held_out``; ``notes`` for the user."""

    fitted: tuple[Observation, ...]
    held_out: tuple[Observation, ...]
    notes: tuple[str, ...] = ()


def read_evidence(
    experiment: Experiment,
    recordings: Mapping[str, Recording],
    n_fit: int,
    views: Mapping[str, View],
    settings: Settings,
    tell: Tell,
) -> Evidence:
    """Observe the ``recordings``, the first ``n_fit`` to be fitted; the ``views`` have where markers rest in each."""
    observations, notes = [], []
    sampling = settings.sampling
    for number, (name, recording) in enumerate(recordings.items()):
        n_moments = sampling.moments_fit if number < n_fit else sampling.moments_test
        acting = experiment.of_recording(recording.own_name)
        release, sigma = acting.timeline.release, acting.sigma("timeline.release") or 0.0
        if release > 0.0:
            n_moments = max(n_moments, sampling.moments_swing)
        rest = views[name].rest
        frames, note = marker_frames(acting, recording, rest, settings.sampling, tell)
        named, exchanged = with_own_ids(track(frames, experiment.markers.ids), exchanges_in(frames), rest)
        warnings = [text for text in recording.warnings if text not in recording.doubts]  # which are said as such
        notes += [f"{name}: {text}" for text in (*warnings, *note, *_of_copies(named), *exchanged)]
        seen = since_seen(without(named, recording.start_ns, release, sigma, sampling.letting_go))
        poses = recording.poses if experiment.probe is not None else ()
        observed = observe(
            name, seen, poses, recording.wrenches, settings=settings, n_moments=n_moments, start_ns=recording.start_ns
        )
        observations.append(observed)
        told = *_of_rounding(observed), *_of_the_force(observed, len(recording.wrenches))
        notes += [f"{name}: {text}" for text in told]
    observations = in_sequence(observations)
    fitted, held_out = observations[:n_fit], observations[n_fit:]
    if not held_out:
        notes.append("no --test recording: the last third of the blocks of time is held out, two at least")
        parts = [split(o) for o in fitted]
        fitted, held_out = [p[0] for p in parts], [replace(p[1], before=p[0]) for p in parts]
    return Evidence(tuple(fitted), tuple(held_out), tuple(notes))


def _of_copies(data: Track) -> list[str]:
    """Say how many frames a tracker sent again."""
    if not data.copies:
        return []
    return [f"{data.copies} frames repeat the one before to the bit, and are left out: their noise is no new one"]


def _of_the_force(o: Observation, n_wrenches: int) -> list[str]:
    """Say where no force is compared although wrenches were recorded, and where its noise is not told."""
    if n_wrenches == 0:
        return []
    out = []
    missing = o.n_moments if o.forces is None else int((~np.isfinite(o.forces).all(axis=1)).sum())
    if missing:
        out = [f"at {missing} of {o.n_moments} moments no wrench was measured near by: no force is compared there"]
    if not o.force_told:
        out.append(
            f"the force's noise of {o.force_sigma:.2g} N may be too small: a sensor's filter keeps samples alike, and "
            "by its recorded poses the probe is hardly ever still for long enough to see how much that hides"
        )
    return out


def _of_rounding(o: Observation) -> list[str]:
    """Say where a good part of the noise of markers is what rounding their places leaves from frame to frame."""
    step, share = float(o.noise.steps.max()), 1.0 - o.noise.repeated
    lasts = share * float(np.trace(o.noise.covariance, axis1=1, axis2=2).mean())
    if not (np.sqrt(share) > 0.5 and lasts < 2.0 * float(of_rounding(o.noise.steps).sum())):
        return []
    return [
        f"places are written in steps of {1e3 * step:.2g} mm, which is more than they scatter by: {np.sqrt(share):.0%} "
        "of their noise is errors of rounding, which frames do not average out"
    ]


def without(data: Track, start_ns: int, release: float, sigma: float, within: tuple[float, float]) -> Track:
    """Leave out the frames ``within`` so many ``sigma`` s about the ``release`` s after the start: a hand may still be
    at the body, and the model lets go at once. With a sigma of 0 all stay."""
    late = 1e-9 * (data.stamps_ns - start_ns) - release
    keep = (sigma == 0.0) | (late < sigma * within[0]) | (late > sigma * within[1])
    return data.take(keep)


def since_seen(data: Track) -> Track:
    """Leave out the frames before the first one that shows the body: where it is at rest is told by those that follow,
    as `livedeform info` does (`common.checks.presses.rest_places`)."""
    shown = shows_the_body(np.isfinite(data.points).all(axis=2).sum(axis=1))
    return data.take(np.logical_or.accumulate(shown))


def in_sequence(observations: Sequence[Observation]) -> list[Observation]:
    """Give each recording the one `before` it, if the body goes on from there: if at its start the markers are where
    they were at the other's end rather than at the other's start. Else the body is new, or has recovered."""
    out = list(observations)
    order = sorted(range(len(out)), key=lambda i: out[i].start_ns)
    for i, j in pairwise(order):
        earlier, later = out[i], out[j]
        if _apart(later, 0, earlier, -1) <= _apart(later, 0, earlier, 0):
            out[j] = replace(later, before=earlier)
    return out


def _apart(one: Observation, i: int, two: Observation, j: int) -> float:
    """Return how far apart the markers are at moment i of one and moment j of the other, in their noise."""
    d = one.points[i] - two.points[j]
    seen = np.isfinite(d).all(axis=1)
    if not seen.any():
        return 0.0
    noise = one.covariances[i][seen] + two.covariances[j][seen]
    return float(np.einsum("mi,mij,mj->", d[seen], np.linalg.inv(noise), d[seen]) / seen.sum())


def split(o: Observation) -> tuple[Observation, Observation]:
    """Part one recording into fitted and held-out moments: its last third of blocks is held out, of few blocks two,
    since one does not tell how presses differ."""
    n = int(o.blocks.max()) + 1
    first_held = max(n - max(n // 3, 2), 1)
    return o.take(o.blocks < first_held), o.take(o.blocks >= first_held)


def names_of(paths: Sequence[Path]) -> list[str]:
    """Name the recordings, each differently; what is declared for one goes by its `Recording.own_name`."""
    out: list[str] = []
    for path in paths:
        base = recording_name(path)
        name, number = base, 2
        while name in out:
            name, number = f"{base}-{number}", number + 1
        out.append(name)
    return out


def marker_frames(
    experiment: Experiment, recording: Recording, rest: Array, settings: SamplingSettings, tell: Tell
) -> tuple[list[MarkerFrame], list[str]]:
    """Take the markers as an uncorrected rig reports them; measured here from the pictures if nobody has yet."""
    if recording.uncorrected_marker_frames:
        return recording.uncorrected_marker_frames, []
    if recording.marker_frames:
        return recording.marker_frames, []
    cameras = None
    if {"left", "right"} <= set(recording.camera_infos):
        cameras = recording.camera_infos["left"], recording.camera_infos["right"]
    tracker = StereoTracker.from_experiment(experiment, cameras, rest)
    frames: list[MarkerFrame] = []
    for left, right in pairs_of(recording, settings):
        frame, _ = tracker.process(left, right)
        frames.append(frame)
        if len(frames) % TOLD_EVERY == 0:
            tell(f"measuring markers in pictures: {len(frames)} pairs", None)
    if not any(len(f.ids) for f in frames):
        raise RecordingError(
            "the recording holds neither markers nor pictures in which markers are found",
            where=str(recording.path),
            remedy="check it with `livedeform info`",
        )
    return frames, [f"markers measured here from {len(frames)} pairs of pictures"]


def pairs_of(recording: Recording, settings: SamplingSettings) -> Iterator[tuple[Image, Image]]:
    """Pair left and right pictures, at most so many per second as the settings say."""
    interval = SOONER * 1e9 / settings.pairs_per_second
    last = -np.inf
    for left, right in recorded_pairs(recording.left, recording.right):
        if left.stamp_ns - last >= interval:
            last = left.stamp_ns
            yield left, right


def jolt(poses: Sequence[Pose], window: float) -> float:
    """Find the probe's highest acceleration, m/s2, over a ``window`` in s."""
    if len(poses) < 3:
        return 0.0
    t = np.array([p.stamp_ns - poses[0].stamp_ns for p in poses]) * 1e-9
    x = np.array([p.position for p in poses])
    grid = np.arange(t[0], t[-1], window)
    at = np.column_stack([np.interp(grid, t, x[:, i]) for i in range(3)])
    return float(np.linalg.norm(np.diff(at, 2, axis=0), axis=1).max(initial=0.0) / window**2)
