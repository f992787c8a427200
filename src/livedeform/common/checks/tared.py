"""Find a force sensor that was not tared: it shows a force while the probe is in the air."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from livedeform.common.bags.recording import Recording
from livedeform.common.checks.finding import Finding
from livedeform.common.checks.probe_path import TOUCH, ProbeApproach, probe_path, sag_bound
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.surface import Surface
from livedeform.common.types import Array

CLEAR = 2 * TOUCH  # m above the body, besides what it may sag: the probe does not touch
ALONG = 0.7  # cosine between the way in which a probe presses and that in which the body sags
FARTHER = 0.5  # of the farthest that it is: a body that swelled, or threads that it pulls, do not reach there
TURNED = 0.2  # rad from how it presses: a tool that is turned further weighs otherwise on its sensor
LEAST = 10  # readings in the air
PARTS = 5  # of the time in the air, whose medians tell how sure that of all is
SIGMAS = 5.0
SHARE = 0.05  # of the largest force: a sensor drifts by a few per cent of that
LARGEST = 99.0  # percentile of the forces: one wild reading is none
SOME = 20  # poses at which it presses


def check_tared(recording: Recording, experiment: Experiment, body: Surface) -> list[Finding]:
    """Check whether there is no force while the probe is in the air, where it presses later or did before."""
    if experiment.probe is None or not recording.poses or not recording.wrenches:
        return []
    path = probe_path(recording.poses, experiment.probe.shape, body, recording.start_ns)
    depths, force = depths_of(recording, path), np.array([wrench.force for wrench in recording.wrenches])
    limit = clear_limit(recording, experiment, body)
    air = in_the_air(recording, depths, path, limit)
    if not len(air) or not (depths > limit).any():
        return []
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
    return [Finding("WARN", text, "tare the sensor in the air, or subtract that from the forces", doubts=True)]


def clear_limit(recording: Recording, experiment: Experiment, body: Surface) -> float:
    """Return the depth (m, negative) above which a probe may touch a body that sags: not where it presses the way that
    the body sags, which is away from it."""
    phantom = experiment.phantom
    scanned = np.array(phantom.scan_gravity) if phantom.configuration == "loaded" else np.zeros(3)
    pull = np.array(phantom.gravity) - scanned
    axes = Rotation.from_quat([pose.orientation_xyzw for pose in recording.poses]).apply([0.0, 0.0, 1.0])
    away = bool((axes @ pull > ALONG * np.linalg.norm(pull)).all()) and not experiment.timeline.release
    return -(CLEAR + (0.0 if away else sag_bound(experiment, body)))


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
    before it first touches, when nothing sticks to it and the sensor has not drifted, or else whenever; empty where
    these are too few."""
    upright = _turned_as_pressed(recording, path, limit)
    clear = depths < limit
    first = np.append(np.flatnonzero(depths >= limit), len(depths))[0]
    for chosen in (clear & (np.arange(len(depths)) < first), clear):
        if not chosen.any():
            continue
        far = np.flatnonzero(chosen & upright & (depths <= FARTHER * depths[chosen].min()))
        if len(far) >= LEAST:
            return far
    return np.zeros(0, np.int64)


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
