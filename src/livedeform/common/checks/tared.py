"""Find a force sensor that was not tared: it shows a force while the probe is in the air."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from livedeform.common.bags.recording import Recording
from livedeform.common.checks.finding import Finding
from livedeform.common.checks.presses import motion
from livedeform.common.checks.probe_path import TOUCH, ProbeApproach, ProbeRecord
from livedeform.common.types import Array

HALF = 0.5
FARTHER = 0.5  # of the farthest that it is: a body that swelled, or threads that it pulls, do not reach there
TURNED = 0.2  # rad from how it presses: a tool that is turned further weighs otherwise on its sensor
LEAST = 10  # readings in the air
PARTS = 5  # of the time in the air, whose medians tell how sure that of all is
SIGMAS = 5.0
SHARE = 0.05  # of the largest force: a sensor drifts by a few per cent of that
LARGEST = 99.0  # percentile of the forces: one wild reading is none
SOME = 20  # poses at which it presses
NEAR, BAND = 0.05, 0.3  # of the way from the shallowest pose to the deepest: hovering; where it would press already
FEW = 3  # readings on the way through the deeper half of that band
STILL = 0.1  # of the markers' largest motion


def check_tared(probe: ProbeRecord) -> list[Finding]:
    """Check whether there is no force while the probe is in the air, where it presses later or did before; say where
    nothing tells that, since it is never in the air."""
    recording, path = probe.recording, probe.path
    if path is None or not recording.wrenches:
        return []
    depths, force = depths_of(recording, path), np.array([wrench.force for wrench in recording.wrenches])
    limit = probe.clear_limit
    air = in_the_air(recording, depths, path, limit)
    if not (depths > limit).any():
        return []
    if not len(air):
        text = (
            f"whether the wrench was tared cannot be told: {LEAST} readings at which the probe, turned as it presses, "
        )
        text += f"is surely clear of the body ({-1e3 * limit:.1f} mm above it, or moving on unpushed) are not there"
        return [Finding("NOTE", text, "begin and end with the probe in the air")]
    level = np.median(force[air], axis=0)
    parts = np.array([np.median(part, axis=0) for part in np.array_split(force[air], PARTS)])
    sure = float(np.linalg.norm(parts.std(axis=0, ddof=1))) / PARTS**0.5
    largest = float(np.percentile(np.linalg.norm(force[depths > limit] - level, axis=1), LARGEST))
    size = float(np.linalg.norm(level))
    if size <= max(SIGMAS * sure, SHARE * largest):
        return []
    digits = max(2 - int(np.floor(np.log10(size))), 0)
    said = ", ".join(f"{value + 0.0:.{digits}f}" for value in np.round(level, digits))
    text = f"the wrench is not tared: ({said}) N while the probe is in the air"
    remedy = "tare the sensor in the air, or subtract that from the forces"
    return [Finding("WARN", text, remedy, doubts=True, of_forces=True)]


def depths_of(recording: Recording, path: ProbeApproach) -> Array:
    """Return how deep (w,) m the probe is in the body at each wrench, at most: the deeper of the poses around; NaN
    outside of the poses' time."""
    t = np.array([1e-9 * (wrench.stamp_ns - recording.start_ns) for wrench in recording.wrenches])
    after = np.searchsorted(path.seconds, t).clip(1, max(len(path.seconds) - 1, 1))
    before = after - 1
    deeper = np.maximum(path.depths[before], path.depths[np.minimum(after, len(path.seconds) - 1)])
    return np.where((t >= path.seconds[0]) & (t <= path.seconds[-1]), deeper, np.nan)


def in_the_air(recording: Recording, depths: Array, path: ProbeApproach, limit: float) -> NDArray[np.int64]:
    """Return the rows of the wrenches while the probe is above ``limit`` (m, negative) by far, turned as it presses:
    before it first touches, when nothing sticks to it and the sensor has not drifted, or else whenever; where these are
    too few, while it is where it moves on for long without being pushed (`_unpushed`); empty where that is nowhere."""
    upright = _turned_as_pressed(recording, path, limit)
    clear = depths < limit
    first = np.append(np.flatnonzero(depths >= limit), len(depths))[0]
    for chosen in (clear & (np.arange(len(depths)) < first), clear):
        if not chosen.any():
            continue
        far = np.flatnonzero(chosen & upright & (depths <= FARTHER * depths[chosen].min()))
        if len(far) >= LEAST:
            return far
    return _unpushed(recording, depths, upright)


def _unpushed(recording: Recording, depths: Array, upright: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the rows of the wrenches at the shallowest depths, if the probe moves on along itself from there, by a
    `BAND` of its way, and neither the force nor the markers follow: so it hovers over a body that sagged away from the
    surface as given. Of a probe that touches there, however lightly or hard, the force changes by a tenth (of a ball,
    by Hertz: 0.225^1.5) of the largest change, and of a flat face by more."""
    kept = np.flatnonzero(np.isfinite(depths) & upright)
    if len(kept) < LEAST:
        return kept[:0]
    depth, force = depths[kept], np.array([recording.wrenches[k].force for k in kept])
    low, way = float(depth.min()), float(np.ptp(depth))
    near, passed = depth <= low + NEAR * way, (depth > low + HALF * BAND * way) & (depth <= low + BAND * way)
    if way < TOUCH or near.sum() < LEAST or passed.sum() < FEW:
        return kept[:0]
    level = np.median(force[near], axis=0)
    follows, scatter = _beyond(force - level, near, passed)
    least = SHARE * float(np.percentile(np.linalg.norm(force - level, axis=1), LARGEST))
    is_sure = SIGMAS * scatter**2 <= least**2 * passed.sum() ** 0.5  # the error of a mean square
    stamps = np.array([recording.wrenches[k].stamp_ns for k in kept])
    is_free = is_sure and follows <= least and _goes_along_itself(recording, stamps, near, passed)
    return kept[near] if is_free and _markers_rest(recording, stamps, depth, near, passed) else kept[:0]


def _beyond(values: Array, near: NDArray[np.bool_], passed: NDArray[np.bool_]) -> tuple[float, float]:
    """Return by how much (rms) values (n, k) are off zero in the rows ``passed`` otherwise than ``near``, and what they
    are so ``near``."""
    squares = np.sum(values**2, axis=1)
    scatter = float(squares[near].mean())
    return abs(float(squares[passed].mean()) - scatter) ** 0.5, scatter**0.5


def _goes_along_itself(recording: Recording, stamps: Array, near: NDArray[np.bool_], passed: NDArray[np.bool_]) -> bool:
    """Tell whether the probe comes to the rows ``passed`` more along its axis than across it: one that is led over an
    uneven body with a force that is held comes across."""
    times = np.array([pose.stamp_ns for pose in recording.poses])
    rows = [np.flatnonzero(each)[:: max(int(each.sum()) // SOME, 1)] for each in (near, passed)]
    hovers, goes = ([recording.poses[k] for k in np.searchsorted(times[:-1], stamps[some])] for some in rows)
    axis = Rotation.from_quat([pose.orientation_xyzw for pose in goes]).apply([0.0, 0.0, 1.0])
    away = np.array([pose.position for pose in goes])[:, None] - np.array([pose.position for pose in hovers])
    along = np.einsum("pnk,pk->pn", away, axis)
    across = np.linalg.norm(away - along[..., None] * axis[:, None], axis=2)
    return bool((along > across).any(axis=1).all())


def _markers_rest(
    recording: Recording, stamps: Array, depth: Array, near: NDArray[np.bool_], passed: NDArray[np.bool_]
) -> bool:
    """Tell whether the markers, where there are some, are still while the probe is at the rows ``near`` and ``passed``
    of its ``depth`` (n,) m, beside how they move when it presses."""
    frames = recording.measured_frames
    moved = motion(frames)
    known = np.isfinite(moved)
    if not known.any():
        return True
    seen = np.interp([float(frame.stamp_ns) for frame in frames], stamps.astype(float), depth)
    within = [known & (seen >= depth[rows].min()) & (seen <= depth[rows].max()) for rows in (near, passed)]
    if not all(rows.any() for rows in within):
        return False
    follows, _ = _beyond(moved[:, None], *within)
    return follows <= STILL * float(np.percentile(moved[known], LARGEST))


def _turned_as_pressed(recording: Recording, path: ProbeApproach, limit: float) -> NDArray[np.bool_]:
    """Tell of each wrench (w,) whether the probe is turned as at some pose at which it may press."""
    stamps = np.array([pose.stamp_ns for pose in recording.poses])
    turns = np.array([pose.orientation_xyzw for pose in recording.poses])
    at = np.searchsorted(stamps, [wrench.stamp_ns for wrench in recording.wrenches]).clip(0, len(stamps) - 1)
    near = np.flatnonzero(path.depths > (0.0 if path.depths.max() > 0.0 else limit))
    chosen = path.seconds[near[:: max(len(near) // SOME, 1)]]
    pressed = np.searchsorted(stamps, recording.start_ns + np.round(1e9 * chosen)).clip(0, len(stamps) - 1)
    if not len(pressed):
        return np.ones(len(at), bool)
    cosine = np.abs(turns[at] @ turns[pressed].T).max(axis=1)
    return np.asarray(2.0 * np.arccos(np.minimum(cosine, 1.0)) < TURNED)
