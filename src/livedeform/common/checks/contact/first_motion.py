"""Does the body deform when the probe comes to it, and not before?

A body that nothing touches keeps its shape, but for slow drifts. One that begins to deform, as quickly as a press does
it, while the probe is surely clear of it, was touched: then poses lie too far away, or clocks differ. How the markers
lie to each other is looked at, so that a camera that is knocked tells nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter

from livedeform.common.checks.finding import Finding
from livedeform.common.checks.presses import rest_places
from livedeform.common.checks.probe_path import TOUCH, ProbeApproach, ProbeRecord
from livedeform.common.frames import apply, fit_rigid
from livedeform.common.types import Array, Ids, MarkerFrame

AROUND = 20.0  # s before and after the probe first comes near, in which is looked
MOST = 600  # frames that are looked at
LEAST = 4  # markers that tell a shape
MOVED = 80.0  # percentile of the markers: two that exchange their ids deform nothing
ABOVE, WILD = 1.5, 3  # times the largest at rest, a quarter of the deformation must be; frames whose middle one counts
BEGUN, QUARTER, HALF = 0.1, 0.25, 0.5  # of the largest deformation, or depth
APART = 0.25  # s: a larger offset of clocks than a diagnosis may be left to find
SHARE = 0.25  # of the time that the press takes to be deep, for the same


def check_first_motion(probe: ProbeRecord) -> list[Finding]:
    """Check whether the body begins to deform before the probe may touch it; say where that comes otherwise much
    earlier or later than the probe."""
    path = probe.path
    if path is None or probe.experiment.timeline.release or not (path.depths > probe.clear_limit).any():
        return []
    near = int(np.argmax(path.depths > probe.clear_limit))
    if near == 0:
        return []
    came = float(path.seconds[near])
    seconds, bent = deformation(probe.recording.measured_frames, probe.recording.start_ns, came)
    if not len(bent):
        return []
    quarter = _first(bent, QUARTER)
    begun = int(np.append(0, np.flatnonzero(bent[:quarter] < BEGUN * bent.max()))[-1])
    stays = bent[quarter : np.searchsorted(seconds, came)] > HALF * QUARTER * bent.max()
    is_quick = seconds[begun] - seconds[0] >= seconds[quarter] - seconds[begun]  # as no drift from the beginning on is
    if seconds[quarter] < came - APART and stays.all() and is_quick:
        away = -1e3 * float(np.interp(seconds[quarter], path.seconds, path.depths))
        text = f"the body is pressed at {seconds[quarter]:.1f} s, while the probe is {away:.1f} mm above it"
        remedy = "check the height of the poses, the probe's shape and length, and the clocks"
        return [Finding("WARN", text, remedy, doubts=True)]
    return _lag(probe, path, seconds, bent)


def _lag(probe: ProbeRecord, path: ProbeApproach, seconds: Array, bent: Array) -> list[Finding]:
    """Say by how much the body deforms earlier or later than the probe comes, where it does not sag away from it."""
    within = (path.seconds >= seconds[0]) & (path.seconds <= seconds[-1])
    depth = np.where(within, np.maximum(path.depths, 0.0), 0.0)
    if probe.sag > TOUCH or depth.max() < TOUCH:
        return []
    half = float(path.seconds[_first(depth, HALF)])
    lasts = float(path.seconds[_first(depth, 1.0 - BEGUN)] - path.seconds[_first(depth, BEGUN)])
    lag = float(seconds[_first(bent, HALF)]) - half
    if abs(lag) < max(APART, SHARE * lasts):
        return []
    text = f"the body is pressed {abs(lag):.1f} s {'after' if lag > 0 else 'before'} the probe comes"
    text += ": clocks may differ, or the poses are off along the probe"
    return [Finding("NOTE", text, "set both clocks by NTP, and check the height of the poses")]


def deformation(frames: Sequence[MarkerFrame], start_ns: int, came: float) -> tuple[Array, Array]:
    """Return when (f,) s, about the moment at which the probe ``came`` near, and by how much (f,) m, without noise,
    the markers lie otherwise to each other than at rest; nothing where they hardly do."""
    ids, places = rest_places(frames)
    stamps: Array = np.array([1e-9 * (frame.stamp_ns - start_ns) for frame in frames])
    rows = np.flatnonzero(np.abs(stamps - came) < AROUND)
    rows = rows[:: -(-len(rows) // MOST) or 1]
    found = [(stamps[k], _bent(frames[k], ids, places)) for k in rows.tolist()]
    known = np.array([each for each in found if np.isfinite(each[1])])
    if len(known) < 2 * WILD:
        return np.zeros(0), np.zeros(0)
    seconds, bent = known[:, 0], median_filter(known[:, 1], WILD, mode="nearest")
    rest = bent[seconds <= max(seconds[2 * WILD - 1], seconds[0] + BEGUN * (came - seconds[0]))]
    noise = float(np.median(rest))
    clear = np.sqrt(np.maximum(bent**2 - noise**2, 0.0))
    if np.hypot(QUARTER * clear.max(), noise) <= ABOVE * rest.max():
        return np.zeros(0), np.zeros(0)
    return seconds, clear


def _bent(frame: MarkerFrame, ids: Ids, places: Array) -> float:
    """Return by how much (m) a frame's markers lie otherwise to each other than at rest; NaN of few."""
    common, here, there = np.intersect1d(frame.ids, ids, return_indices=True)
    now, then = frame.points[here], places[there]
    known = np.asarray(np.isfinite(now).all(axis=1))
    if len(common) == 0 or known.sum() < max(LEAST, HALF * len(ids)):
        return float("nan")
    off = now[known] - apply(fit_rigid(then[known], now[known]), then[known])
    return float(np.percentile(np.linalg.norm(off, axis=1), MOVED))


def _first(values: Array, share: float) -> int:
    """Return the first row in which values (n,) come to a share of the largest."""
    return int(np.argmax(values >= share * values.max()))
