"""Find what a recording, or the part of it that is run, leaves out at its beginning: a press that is under way, and
presses that the body remembers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from livedeform.common.bags.recording import Recording
from livedeform.common.checks.finding import Finding
from livedeform.common.checks.presses import count_presses, lasting, motion, without_noise
from livedeform.common.checks.probe_path import CLEAR, TOUCH, ProbeApproach, ProbeRecord
from livedeform.common.checks.tared import LARGEST, depths_of, in_the_air
from livedeform.common.types import Array

HALF, SOME = 0.5, 0.2  # of the way from where the body may begin to the deepest: beyond, a probe presses, or may do so
PRESSED, SIGMAS = 0.1, 5.0  # a force: share of the largest one, and of what it scatters by in the air
AROUND = 0.25  # s about the beginning, whose median force counts
IN_THE_AIR = "begin with the probe in the air"


def check_beginning(probe: ProbeRecord) -> list[Finding]:
    """Check whether a recording begins with the probe inside the body, or, where that may sag by more than the probe is
    deep, within a press."""
    path = probe.path
    if path is None:
        return []
    if _surely_inside(probe, path, float(path.seconds[0])):
        text = f"the recording begins with the probe {1e3 * path.depths[0]:.1f} mm inside the body"
        return [Finding("WARN", text, "begin the recording with the probe in the air", doubts=True)]
    shown = _force_shows(probe, path, float(path.seconds[0]))
    if not shown and (shown is False or not _as_deep_as_later(probe, path) or _markers_stayed(probe, path)):
        return []
    text = f"it begins within a press (at {path.seconds[0]:.3g} s): the body is taken to rest there"
    return [Finding("WARN", text, IN_THE_AIR, doubts=True)]


def check_start(probe: ProbeRecord, start: float, *, registers: bool) -> list[Finding]:
    """Check whether a recording is run from within a press on, ``start`` s after it began, to which the model comes
    from the recording's beginning: cameras that are registered there (``registers``) are so to a body at rest."""
    if probe.path is None or not _is_pressed(probe, probe.path, start):
        return []
    text = f"it begins within a press (at {start:.3g} s)"
    if registers:
        text += ": the cameras are registered to a body that is taken to rest there"
        return [Finding("WARN", text, IN_THE_AIR, doubts=True)]
    return [Finding("NOTE", text + ", from where on presses are counted by how the markers move")]


def check_left_out(probe: ProbeRecord, start: float, remembers: Sequence[str], rubs: Sequence[str]) -> list[Finding]:
    """Check what a model lacks that was not led through what came before ``start`` s: a press that is under way, and
    presses that it ``remembers``, for the reasons given, or, while the probe touches, since it ``rubs``."""
    path = probe.path
    if path is None or start <= 0.0:
        return []
    found = []
    if _is_pressed(probe, path, start):
        remembers = [*remembers, *rubs]
        text = f"it begins within a press (at {start:.3g} s): the body is taken to rest there"
        found.append(Finding("WARN", text, IN_THE_AIR, doubts=True))
    presses = _presses(probe.recording, path, probe.clear_limit)
    if remembers and (_went_in_before(probe, path, start) or any(a < start for a, _ in presses)):
        text = f"--start {start:.3g} s leaves out presses that the model would remember ({', '.join(remembers)})"
        found.append(Finding("WARN", text, "run the recording from its beginning", doubts=True))
    return found


def last_clear(probe: ProbeRecord, at: float) -> float:
    """Return when (s) the probe was last clear of the body, ``at`` s at most, as far as the poses that are looked at
    tell; where it never was until then, when its poses begin."""
    path = probe.path
    if path is None:
        return at
    clear = (path.seconds <= at) & (path.depths < probe.clear_limit)
    return float(path.seconds[clear].max(initial=path.seconds[0]))


def _is_pressed(probe: ProbeRecord, path: ProbeApproach, at: float) -> bool:
    """Tell by the poses, the markers or the forces whether the body is pressed at ``at`` s."""
    presses = _presses(probe.recording, path, probe.clear_limit)
    if any(a <= at <= b for a, b in presses) or _surely_inside(probe, path, at):
        return True
    shown = _force_shows(probe, path, at)
    return _is_deep(probe, path, at) and not _markers_stayed(probe, path) if shown is None else shown


def _surely_inside(probe: ProbeRecord, path: ProbeApproach, at: float) -> bool:
    """Tell whether the probe is in the body at ``at`` s, however that may sag."""
    return float(np.interp(at, path.seconds, path.depths)) > TOUCH + probe.sag


def _outermost(probe: ProbeRecord, path: ProbeApproach) -> float:
    """Return the depth (m) from which the probe's way into the body counts: where its surface may be at the highest, or
    the shallowest pose where the probe never leaves. However far it is drawn back in the air tells nothing."""
    return max(float(path.depths.min()), probe.clear_limit + CLEAR)


def _is_deep(probe: ProbeRecord, path: ProbeApproach, at: float) -> bool:
    """Tell whether the probe is in the body as given at ``at`` s, by more than half of the way that it goes."""
    depth, outer = float(np.interp(at, path.seconds, path.depths)), _outermost(probe, path)
    return depth > TOUCH and depth - outer > HALF * (float(path.depths.max()) - outer)


def _went_in_before(probe: ProbeRecord, path: ProbeApproach, start: float) -> bool:
    """Tell whether the probe was in the body as given before ``start`` s, by some of the way that it goes, and the
    force there is not that in the air."""
    outer, before = _outermost(probe, path), np.where(path.seconds <= start, path.depths, -np.inf)
    most = int(np.argmax(before))
    if before[most] <= 0.0 or before[most] - outer <= SOME * (float(path.depths.max()) - outer):
        return False
    return _force_shows(probe, path, float(path.seconds[most])) is not False


def _as_deep_as_later(probe: ProbeRecord, path: ProbeApproach) -> bool:
    """Tell whether the probe is in the body at first by as much as in a press that follows once it had left, and that
    is over."""
    outer, top = _outermost(probe, path), float(path.depths[int(np.argmin(path.depths)) :].max())
    first, last = float(path.depths[0]), float(path.depths[-1])
    return min(first, top) > TOUCH and first - outer > HALF * (top - outer) > last - outer


def _markers_stayed(probe: ProbeRecord, path: ProbeApproach) -> bool:
    """Tell whether the markers are where they began when the probe is farthest away, while they move later: then it did
    not press them at first."""
    frames = probe.recording.measured_frames
    moved, _ = without_noise(lasting(motion(frames)), np.nan)
    if not moved.any():
        return False
    seconds: Array = np.array([1e-9 * (frame.stamp_ns - probe.recording.start_ns) for frame in frames])
    farthest = float(path.seconds[int(np.argmin(path.depths))])
    return bool(moved[int(np.argmin(np.abs(seconds - farthest)))] < SOME * moved.max())


def _presses(recording: Recording, path: ProbeApproach, limit: float) -> list[tuple[float, float]]:
    """Return when (s) each press begins and ends by the markers, while the probe is deeper than ``limit`` m; none where
    there are no markers yet."""
    frames = recording.measured_frames
    moved = motion(frames)
    if not np.isfinite(moved).any():
        return []
    seconds: Array = np.array([1e-9 * (frame.stamp_ns - recording.start_ns) for frame in frames])
    near = np.interp(seconds, path.seconds, path.depths) > limit
    found = count_presses(*without_noise(lasting(moved), np.nan))
    times = [seconds[press][near[press]] for press in found]
    return [(float(t[0]), float(t[-1])) for t in times if len(t)]


def _force_shows(probe: ProbeRecord, path: ProbeApproach, at: float) -> bool | None:
    """Tell whether the force about ``at`` s is another one than in the air, while the probe may touch; None where that
    is not known, or where no force stands out of its scatter."""
    recording, limit = probe.recording, probe.clear_limit
    near = np.interp(at, path.seconds, path.depths) > limit
    t = np.array([1e-9 * (wrench.stamp_ns - recording.start_ns) for wrench in recording.wrenches])
    here = np.abs(t - at) < AROUND
    if not near or not here.any():
        return None
    force = np.array([wrench.force for wrench in recording.wrenches])
    air = in_the_air(recording, depths_of(recording, path), path, limit)
    if not len(air):
        return None
    level = np.median(force[air], axis=0)
    size = float(np.linalg.norm(np.median(force[here], axis=0) - level))
    scatter = float(np.linalg.norm(force[air].std(axis=0))) / here.sum() ** 0.5
    least = PRESSED * float(np.percentile(np.linalg.norm(force - level, axis=1), LARGEST))
    if size > max(least, SIGMAS * scatter):
        return True
    return False if SIGMAS * scatter < least else None
