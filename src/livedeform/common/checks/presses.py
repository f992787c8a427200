"""Tell by the markers when a body is pressed: where they rest, how far they are from there, and which are the presses.

A run's coverage and the protocol's steps count presses by the same rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import find_peaks, peak_prominences

from livedeform.common.types import Array, Ids, MarkerFrame

SEEN_SHARE = 0.5  # of the markers that most frames show; a frame with fewer says nothing of the others
MOST_FRAMES = 90.0  # percentile of the frames' numbers of markers: how many a frame shows where little is hidden
RESTING = 5  # frames at the beginning of which the medians are the markers' places at rest: two may be wrong
HALF = 0.5  # of a press's largest motion: on both sides there is less than that; of the largest motion of all
WILD, OFTEN = 5, 99.0  # what lasts for less than half of so many frames is no press, if fewer than 1 % are so
MOVED, SHARE = 1.5, 0.05  # a press: noise floors, once the noise is taken off, and share of the largest motion
SMOOTHED, STILL = 5, 0.05  # frames to count presses by; share of the frames in which what shows as motion is noise
BOTH_ENDS = 1.29  # variances of one place that a displacement has: its own, and that of a median of five (0.287)


def shows_the_body(n_markers: np.ndarray) -> np.ndarray:
    """Tell of frames with so many markers (f,) which show at least half of what most frames show."""
    if not len(n_markers):
        return np.zeros(0, bool)
    return np.asarray(n_markers >= SEEN_SHARE * np.percentile(n_markers, MOST_FRAMES))


def rest_places(frames: Sequence[MarkerFrame]) -> tuple[Ids, Array]:
    """Return where markers rest: ids (m,) and places (m, 3) m, the medians over the first frames that show the body.

    One mislabelled frame decides nothing. Markers that these frames do not show are left out: where they are first seen
    the body may be pressed.
    """
    shown = [np.isfinite(frame.points).all(axis=1) for frame in frames]
    body = shows_the_body(np.array([s.sum() for s in shown])) & np.array([s.any() for s in shown], bool)
    first = np.flatnonzero(body)[:RESTING]
    if not len(first):
        return np.zeros(0, np.uint32), np.zeros((0, 3))
    ids = np.concatenate([frames[k].ids[shown[k]] for k in first])
    points = np.concatenate([frames[k].points[shown[k]] for k in first])
    known = np.unique(ids)
    return known, np.array([np.median(points[ids == marker], axis=0) for marker in known])


def motion(frames: Sequence[MarkerFrame]) -> Array:
    """Rms motion (f,) m of each frame's markers from where they rest; NaN for a frame that shows none of those."""
    out = np.full(len(frames), np.nan)
    known, places = rest_places(frames)
    if not len(known):
        return out
    ids = np.concatenate([frame.ids for frame in frames])
    points = np.concatenate([frame.points for frame in frames])
    row = np.repeat(np.arange(len(frames)), [len(frame.ids) for frame in frames])
    at = np.minimum(np.searchsorted(known, ids), len(known) - 1)
    seen = np.isfinite(points).all(axis=1) & (known[at] == ids)
    squares = np.sum((points[seen] - places[at[seen]]) ** 2, axis=1)
    n = np.bincount(row[seen], minlength=len(frames))
    total = np.bincount(row[seen], squares, minlength=len(frames))
    out[n > 0] = np.sqrt(total[n > 0] / n[n > 0])
    return out


def lasting(moved: Array) -> Array:
    """Motion (f,) m without that of single wild frames, where these are rare: elsewhere frames are so far apart that a
    press shows in one or two."""
    known = np.isfinite(moved)
    if not known.any():
        return moved
    kept = moved.copy()
    kept[known] = median_filter(moved[known], WILD)
    rare = HALF * np.percentile(moved[known], OFTEN) <= kept[known].max()
    return kept if rare else moved


def without_noise(moved: Array, noise: float) -> tuple[Array, float]:
    """Motion (f,) m over a few frames, less what noise adds, and the noise (m, rms of a marker's place): as stated, or
    what the stillest frames show where ``noise`` is NaN."""
    known = np.isfinite(moved)
    if not known.any():
        return np.zeros(len(moved)), noise
    squares = np.where(known, moved, 0.0) ** 2
    floor = noise if np.isfinite(noise) else float(np.sqrt(np.quantile(squares[known], STILL) / BOTH_ENDS))
    kernel = np.ones(min(SMOOTHED, len(moved)))
    seen = np.convolve(known.astype(float), kernel, "same")
    mean = np.divide(np.convolve(squares, kernel, "same"), seen, out=np.zeros(len(moved)), where=seen > 0.0)
    return np.sqrt(np.maximum(mean - BOTH_ENDS * floor**2, 0.0)), floor


def count_presses(clear: Array, floor: float) -> list[slice]:
    """Return the rows of the frames of each press, by motion ``clear`` (f,) m of a noise of ``floor`` m.

    While a body is pressed its markers move by clearly more than their noise, however little that is beside another
    press; on both sides they come back at least half of the way. So noise that is larger than it is said to be, or a
    slow drift, makes no presses where it comes near the limit.
    """
    limit = max(MOVED * floor, SHARE * float(clear.max(initial=0.0)))
    padded = np.concatenate([[0.0], clear, [0.0]])  # a press may last to an end of the recording
    peaks, _ = find_peaks(padded, height=limit)
    heights, prominences = padded[peaks], peak_prominences(padded, peaks)[0]
    tops: list[int] = []
    for top in (peaks[prominences >= HALF * heights] - 1).tolist():
        if tops and clear[tops[-1] : top].min() >= HALF * min(clear[tops[-1]], clear[top]):  # as high, and one press
            continue
        tops.append(top)
    between = [a + int(np.argmin(clear[a:b])) for a, b in pairwise(tops)]
    return (
        [
            _around(clear > limit, top, *ends)
            for top, ends in zip(tops, pairwise([0, *between, len(clear)]), strict=True)
        ]
        if tops
        else []
    )


def _around(away: np.ndarray, top: int, begin: int, end: int) -> slice:
    """Return the rows about ``top``, from ``begin`` to ``end`` at most, in which the markers are ``away`` (f,)."""
    before, after = np.flatnonzero(~away[begin:top]), np.flatnonzero(~away[top + 1 : end])
    first = begin + int(before[-1]) + 1 if len(before) else begin
    return slice(first, top + 1 + int(after[0]) if len(after) else end)
