"""Find a force that is not the probe's on the body: of the wrong sign, or along another axis.

A body at rest gives no work: that of the force on it, along the way of the probe since it was in the air, is never
negative, however the probe rubs, sticks or pulls. And while a probe goes in along its axis, the force goes that way
too, as far as friction and a slope of the surface let it. Only what breaks both rules is doubted: a force that is late
breaks the first, and one on a probe that sticks to a body it has sheared the second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common.checks.finding import Finding
from livedeform.common.checks.probe_path import TOUCH, ProbeRecord
from livedeform.common.checks.tared import LARGEST, SIGMAS, depths_of, in_the_air
from livedeform.common.types import Array

ALONG = 0.9  # cosine between the probe's motion and its axis: it goes in
ACROSS = 0.1  # of a force whose part along that way is less, nothing presses; a slope of 80 degrees has 0.17
LARGE = 0.3  # of the largest force
FEW = 5  # readings while it goes in
TWICE = 2.0  # as much work as the body ever took, it gives only if the force is not that on it
REMEDY = "give the force on the phantom (not on the probe), in the phantom's frame (not the sensor's)"


@dataclass(frozen=True)
class Push:
    """The ``force`` (3,) N, largest while the probe goes in the ``way`` (3,); ``along`` is the cosine between both,
    over all of that way, and ``least`` and ``most`` the least and the most work since the air, as shares of what a
    force along that way does."""

    force: Array
    way: Array
    along: float
    least: float
    most: float


def check_pushing(probe: ProbeRecord) -> list[Finding]:
    """Check whether the tared force goes the way in which the probe presses."""
    push = pushed(probe)
    if push is None:
        return []
    given = push.least < -ACROSS and -push.least > TWICE * push.most
    if push.along < -ACROSS and given:
        text = f"the force {_said(push.force, 'N')} is against the way {_said(push.way)} in which the probe presses"
        return [Finding("WARN", text, REMEDY, doubts=True, of_forces=True)]
    if abs(push.along) < ACROSS and max(push.most, -push.least) < ACROSS:
        text = f"the force {_said(push.force, 'N')} is across the way {_said(push.way)} in which the probe presses"
        return [Finding("WARN", text, REMEDY, doubts=True, of_forces=True)]
    return []


def pushed(probe: ProbeRecord) -> Push | None:
    """Return how the force goes with the probe's way into the body; None where that is not deep enough, the force does
    not stand out of its scatter, or where the probe is never in the air, which tells what no force is."""
    recording, path = probe.recording, probe.path
    if path is None or len(recording.wrenches) < 2 or path.depths.max() <= TOUCH:
        return None
    depths, limit = depths_of(recording, path), probe.clear_limit
    air = in_the_air(recording, depths, path, limit)
    if not len(air):
        return None
    force = np.array([wrench.force for wrench in recording.wrenches])
    force = force - np.median(force[air], axis=0)
    scatter = float(np.sqrt(np.mean(np.sum(force[air] ** 2, axis=1))))
    steps, axes = _steps(probe)
    between = 0.5 * (force[1:] + force[:-1])
    from_air, known = np.arange(len(steps)) >= air[0], np.isfinite(depths[1:]) & np.isfinite(depths[:-1])
    touches = known & from_air & (np.maximum(depths[1:], depths[:-1]) > limit)
    size, length = np.linalg.norm(between, axis=1), np.linalg.norm(steps, axis=1)
    goes_in = touches & (depths[1:] > 0.0) & (np.einsum("ij,ij->i", steps, axes) > ALONG * length) & (length > 0.0)
    if not goes_in.any():
        return None
    least = max(SIGMAS * scatter, LARGE * float(np.percentile(size[goes_in], LARGEST)))
    rows = np.flatnonzero(goes_in & (size > least))
    if len(rows) < FEW or length[rows].sum() < TOUCH:
        return None
    work = np.einsum("ij,ij->i", between, steps)
    most = float(np.sum(size[rows] * length[rows]))
    total = np.cumsum(np.where(touches, work, 0.0)) / most
    top = rows[int(np.argmax(size[rows]))]
    return Push(between[top], axes[top], float(work[rows].sum()) / most, float(total.min()), float(total.max()))


def _steps(probe: ProbeRecord) -> tuple[Array, Array]:
    """Return how the probe's face moves (w - 1, 3) m between the wrenches, and where its +z points (w - 1, 3)."""
    poses = probe.recording.poses
    stamps = np.array([pose.stamp_ns for pose in poses])
    t = np.array([wrench.stamp_ns for wrench in probe.recording.wrenches])
    places = np.array([pose.position for pose in poses])
    start = int(stamps[0])  # in floats of seconds, stamps of today are exact to 0.2 us only
    at = np.column_stack([np.interp(1e-9 * (t - start), 1e-9 * (stamps - start), each) for each in places.T])
    turns = np.array([pose.orientation_xyzw for pose in poses])
    near = np.searchsorted(stamps, t[1:]).clip(0, len(stamps) - 1)
    return np.diff(at, axis=0), Rotation.from_quat(turns[near]).apply([0.0, 0.0, 1.0])


def _said(vector: Array, unit: str = "") -> str:
    return "(" + ", ".join(f"{value + 0.0:.2g}" for value in np.round(vector, 6)) + ")" + (unit and f" {unit}")
