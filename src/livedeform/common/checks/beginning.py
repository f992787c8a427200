"""Find what a recording, or the part of it that is run, leaves out at its beginning: a press that is under way, and
presses that the body remembers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from livedeform.common.bags.recording import Recording
from livedeform.common.checks.finding import Finding
from livedeform.common.checks.presses import count_presses, lasting, motion, without_noise
from livedeform.common.checks.probe_path import TOUCH, ProbeApproach, probe_path, sag_bound
from livedeform.common.checks.tared import clear_limit, depths_of, in_the_air
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.surface import Surface
from livedeform.common.types import Array

HALF, SOME = 0.5, 0.2  # of the way from the shallowest to the deepest: beyond that a probe presses, or may do so
PRESSED, SIGMAS = 0.1, 5.0  # a force: share of the largest one, and of what it scatters by in the air
AROUND = 0.25  # s about the beginning, whose median force counts


def check_beginning(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Check whether a recording begins within a press, of a body that may sag by more than the probe is deep."""
    if experiment.probe is None or not recording.poses:
        return []
    path = probe_path(recording.poses, experiment.probe.shape, body, recording.start_ns)
    limit = clear_limit(recording, experiment, body)
    surely = _surely_inside(path, experiment, body)
    if surely or not (_as_deep_as_later(path) or _force_shows(recording, path, float(path.seconds[0]), limit)):
        return []
    return [_within_a_press(float(path.seconds[0]))]


def begins_inside(recording: Recording, experiment: Experiment, body: Surface) -> bool:
    """Tell whether the probe begins in the body, however that may sag: `check_probe` says so."""
    if experiment.probe is None or not recording.poses:
        return False
    path = probe_path(recording.poses, experiment.probe.shape, body, recording.start_ns)
    return _surely_inside(path, experiment, body)


def _surely_inside(path: ProbeApproach, experiment: Experiment, body: Surface) -> bool:
    return float(path.depths[0]) > TOUCH + sag_bound(experiment, body)


def check_start(
    whole: Recording,
    experiment: Experiment,
    body: Surface,
    start: float,
    remembers: Sequence[str],
    rubs: Sequence[str],
    *,
    said: bool = False,
) -> list[Finding]:
    """Check what is left out of a ``whole`` recording that is run from ``start`` s on: a press that is under way, and
    presses before it, where the model ``remembers`` these for the reasons given, or, while the probe touches, since it
    ``rubs``. That it begins inside the body may be ``said`` already."""
    if experiment.probe is None or not whole.poses or start <= 0.0:
        return []
    path = probe_path(whole.poses, experiment.probe.shape, body, whole.start_ns)
    limit = clear_limit(whole, experiment, body)
    presses = _presses(whole, path, limit)
    found = []
    within = any(a <= start <= b for a, b in presses) or _is_deep(path, start)
    if within or _force_shows(whole, path, start, limit):
        remembers = [*remembers, *rubs]
        found += [] if said else [_within_a_press(start)]
    if remembers and (_went_in_before(path, start) or any(a < start for a, _ in presses)):
        text = f"--start {start:.3g} s leaves out presses that the model would remember ({', '.join(remembers)})"
        found.append(Finding("WARN", text, "run the recording from its beginning", doubts=True))
    return found


def _within_a_press(at: float) -> Finding:
    text = f"it begins within a press (at {at:.3g} s): the body is taken to rest there"
    return Finding("WARN", text, "begin with the probe in the air", doubts=True)


def _is_deep(path: ProbeApproach, at: float) -> bool:
    """Tell whether the probe is in the body as given at ``at`` s, by more than half of the way that it goes."""
    depth, low = float(np.interp(at, path.seconds, path.depths)), float(path.depths.min())
    return depth > TOUCH and depth - low > HALF * (float(path.depths.max()) - low)


def _went_in_before(path: ProbeApproach, start: float) -> bool:
    """Tell whether the probe was in the body as given before ``start`` s, by some of the way that it goes."""
    low, before = float(path.depths.min()), float(path.depths[path.seconds <= start].max(initial=-np.inf))
    return before > 0.0 and before - low > SOME * (float(path.depths.max()) - low)


def _as_deep_as_later(path: ProbeApproach) -> bool:
    """Tell whether the probe is in the body at first by as much as in a press that follows once it had left, and that
    is over."""
    least = int(np.argmin(path.depths))
    low, top = float(path.depths[least]), float(path.depths[least:].max())
    first, last = float(path.depths[0]), float(path.depths[-1])
    return min(first, top) > TOUCH and first - low > HALF * (top - low) > last - low


def _presses(recording: Recording, path: ProbeApproach, limit: float) -> list[tuple[float, float]]:
    """Return when (s) each press begins and ends by the markers, while the probe is deeper than ``limit`` m; none where
    there are no markers yet."""
    frames = recording.uncorrected_marker_frames or recording.marker_frames
    moved = motion(frames)
    if not np.isfinite(moved).any():
        return []
    seconds: Array = np.array([1e-9 * (frame.stamp_ns - recording.start_ns) for frame in frames])
    near = np.interp(seconds, path.seconds, path.depths) > limit
    found = count_presses(*without_noise(lasting(moved), np.nan))
    times = [seconds[press][near[press]] for press in found]
    return [(float(t[0]), float(t[-1])) for t in times if len(t)]


def _force_shows(recording: Recording, path: ProbeApproach, at: float, limit: float) -> bool:
    """Tell whether the force about ``at`` s is another one than in the air, where that is known, while the probe is
    deeper than ``limit`` m."""
    near = np.interp(at, path.seconds, path.depths) > limit
    t = np.array([1e-9 * (wrench.stamp_ns - recording.start_ns) for wrench in recording.wrenches])
    here = np.abs(t - at) < AROUND
    if not near or not here.any():
        return False
    force = np.array([wrench.force for wrench in recording.wrenches])
    air = in_the_air(recording, depths_of(recording, path), path, limit)
    if not len(air):
        return False
    level = np.median(force[air], axis=0)
    size = float(np.linalg.norm(np.median(force[here], axis=0) - level))
    scatter = float(np.linalg.norm(force[air].std(axis=0))) / here.sum() ** 0.5
    return bool(size > max(PRESSED * float(np.linalg.norm(force - level, axis=1).max()), SIGMAS * scatter))
