"""All frames of one recording on one set of markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from livedeform.common.checks.recorded import POSES_APART_NS
from livedeform.common.errors import RecordingError
from livedeform.common.types import Array, MarkerFrame


@dataclass(frozen=True)
class Track:
    """All frames of one recording on one set of markers: ``points`` (f, m, 3) with NaN where a marker was not seen,
    ``covariances`` (f, m, 3, 3) as stated by the tracker (NaN where it states none). So many frames were ``copies`` of
    others, and are left out."""

    stamps_ns: np.ndarray
    ids: np.ndarray
    points: Array
    covariances: Array
    copies: int = 0

    def take(self, keep: np.ndarray) -> Track:
        """Some of the frames (f,) bool."""
        return replace(
            self, stamps_ns=self.stamps_ns[keep], points=self.points[keep], covariances=self.covariances[keep]
        )

    def over_usual(self, most: float) -> Array:
        """Find the variance (f, m) that the tracker states of each frame's point, over that of the marker's median
        frame: 1 where it states none, and nowhere so small that one frame outweighs more than ``most`` usual ones."""
        size = np.trace(self.covariances, axis1=2, axis2=3)
        size = np.where(np.isfinite(self.points).all(axis=2) & (size > 0.0), size, np.nan)
        stated = np.isfinite(size).any(axis=0)
        out = np.ones(size.shape)
        out[:, stated] = np.nan_to_num(size[:, stated] / np.nanmedian(size[:, stated], axis=0), nan=1.0)
        return np.maximum(out, 1.0 / most)


def track(frames: Sequence[MarkerFrame], ids: np.ndarray | None = None) -> Track:
    """Put the frames on one set of markers, in the order of their stamps; markers that are not in ``ids`` are left out,
    and so are frames that a tracker sent again (`copies_in`)."""
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
    covariances[~(np.trace(covariances, axis1=2, axis2=3) > 0.0)] = np.nan  # zero states nothing, as in a recording
    stamps = stamps[keep]
    again = copies_in(points, stamps)
    return replace(Track(stamps, ids, points, covariances).take(~again), copies=int(again.sum()))


def copies_in(points: Array, stamps_ns: np.ndarray) -> np.ndarray:
    """Tell which frames (f,) of ``points`` (f, m, 3) a tracker sent again, as one that publishes more often than it
    measures: all that is seen in a frame and the one before is the same to the bit, and that is usual.

    A body at rest, measured without noise, stays the same for longer than frames may be apart: these are no copies.
    """
    both = np.asarray(np.isfinite(points[1:] - points[:-1]).all(axis=2))
    moved = (both[..., None] & (points[1:] != points[:-1])).any(axis=(1, 2))
    begins = np.r_[True, moved | ~both.any(axis=1)][: len(points)]
    starts = np.flatnonzero(begins)
    usual = np.median(np.diff(np.r_[starts, len(points)]))
    longest = POSES_APART_NS / np.median(np.diff(stamps_ns)) if len(stamps_ns) > 1 else 1.0
    if not 2.0 <= usual <= longest:
        return np.zeros(len(points), bool)
    place = np.arange(len(points)) - starts[np.cumsum(begins) - 1]
    return np.asarray(place % int(longest) != 0)
