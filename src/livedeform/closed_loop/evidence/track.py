"""All frames of one recording on one set of markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from livedeform.common.errors import RecordingError
from livedeform.common.types import Array, MarkerFrame


@dataclass(frozen=True)
class Track:
    """All frames of one recording on one set of markers: ``points`` (f, m, 3) with NaN where a marker was not seen,
    ``covariances`` (f, m, 3, 3) as stated by the tracker (NaN where it states none)."""

    stamps_ns: np.ndarray
    ids: np.ndarray
    points: Array
    covariances: Array

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
    """The frames on one set of markers, in the order of their stamps; markers that are not in ``ids`` are left out."""
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
    return Track(stamps[keep], ids, points, covariances)
