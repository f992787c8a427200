"""Markers that exchange their ids: found, said, and left out of a diagnosis while they do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from livedeform.closed_loop.evidence.own_ids import with_own_ids
from livedeform.closed_loop.evidence.track import track
from livedeform.common.checks.exchanged import check_exchanged, exchanges_in
from livedeform.common.types import Array, MarkerFrame

PLACES = 0.012 * np.stack(np.meshgrid(range(5), range(4), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
PERIOD = 0.04  # s
SECOND = round(1.0 / PERIOD)


def frames_of(motion: Array, noise: float = 2e-4, seed: int = 0) -> list[MarkerFrame]:
    """Frames of markers at ``PLACES`` + ``motion`` (f, m or 1, 3) m, every twentieth marker hidden."""
    rng = np.random.default_rng(seed)
    frames = []
    for k, by in enumerate(motion):
        seen = rng.random(len(PLACES)) > 0.05
        points = (PLACES + by + noise * rng.standard_normal(PLACES.shape))[seen]
        covariances = np.broadcast_to(noise**2 * np.eye(3), (len(points), 3, 3))
        ids = np.flatnonzero(seen).astype(np.uint32)
        frames.append(MarkerFrame(round(1e9 * PERIOD * k), ids, points, covariances, np.full(len(points), np.nan)))
    return frames


def pressed(seconds: float = 12.0, depth: float = 6e-3) -> Array:
    """Presses of 4 s on the middle, with a lean to the side."""
    t = PERIOD * np.arange(round(seconds / PERIOD))
    near = np.exp(-(((PLACES - PLACES.mean(axis=0)) / 0.02) ** 2).sum(axis=1))
    course = 0.5 - 0.5 * np.cos(2.0 * np.pi * t / 4.0)
    return np.asarray(depth * course[:, None, None] * near[:, None] * np.array([0.5, 0.0, -1.0]))


def exchanged(frames: list[MarkerFrame], i: int, j: int, begin: int, end: int) -> list[MarkerFrame]:
    out = list(frames)
    for k in range(begin, end):
        ids = frames[k].ids
        out[k] = replace(frames[k], ids=np.where(ids == i, j, np.where(ids == j, i, ids)).astype(np.uint32))
    return out


def hidden(frames: list[MarkerFrame], ids: list[int], begin: int, end: int) -> list[MarkerFrame]:
    out = list(frames)
    for k in range(begin, end):
        f, keep = frames[k], ~np.isin(frames[k].ids, ids)
        error = f.reprojection_error_px[keep]
        out[k] = MarkerFrame(f.stamp_ns, f.ids[keep], f.points[keep], f.covariances[keep], error)
    return out


@pytest.mark.parametrize(("i", "j"), [(5, 6), (9, 10), (0, 19)])
@pytest.mark.parametrize("covered", [0.0, 1.5])
def test_an_exchange_and_its_end_are_found(i: int, j: int, covered: float) -> None:
    """Neighbours under the probe and markers far apart; seen all the time, or covered for 1.5 s meanwhile."""
    begin, end = 4 * SECOND, 7 * SECOND
    frames = exchanged(frames_of(pressed()), i, j, begin, end)
    if covered:
        frames = hidden(frames, [i, j], begin - round(covered * SECOND), begin)
    found = exchanges_in(frames)
    assert [e.ids for e in found] == [(i, j)] * 2
    late = [1e-9 * e.stamp_ns - PERIOD * k for e, k in zip(found, (begin, end), strict=True)]
    assert min(late) > -1e-6 and max(late) < 4 * PERIOD  # a marker may be hidden in the first frame
    (finding,) = check_exchanged(frames, 0)
    assert finding.level == "WARN" and finding.doubts and f"{i} and {j} at 4." in finding.text


@pytest.mark.parametrize("seed", range(3))
def test_motion_and_wild_points_exchange_nothing(seed: int) -> None:
    """A body carried from place to place faster than its markers are apart, presses, and points off by 30 mm."""
    t = PERIOD * np.arange(300)
    carried = 0.2 * np.sin(2.0 * np.pi * t / 2.0)[:, None, None] * np.array([1.0, 0.0, 0.0])
    assert np.abs(np.diff(carried, axis=0)).max() > 0.012
    rng = np.random.default_rng(seed)
    for motion in (carried, pressed(depth=12e-3)):
        frames = frames_of(motion, seed=seed)
        assert not exchanges_in(frames)
        wild = [replace(f, points=f.points + 0.03 * (rng.random((len(f.ids), 1)) < 0.02)) for f in frames]
        assert not exchanges_in(wild)
    assert not exchanges_in([]) and not exchanges_in(frames[:1])


@pytest.mark.parametrize("begin", [0, 4 * SECOND])
def test_a_diagnosis_leaves_them_out_while_they_are_exchanged(begin: int) -> None:
    """Also where the recording begins with the wrong ids, and where a marker moves further than they are apart."""
    motion, end = pressed(depth=0.02), 7 * SECOND
    right = track(frames_of(motion), np.arange(len(PLACES)))
    frames = exchanged(frames_of(motion), 9, 10, begin, end)
    data = track(frames, np.arange(len(PLACES)))
    kept, notes = with_own_ids(data, exchanges_in(frames), PLACES)
    seen = np.isfinite(kept.points)
    assert np.array_equal(kept.points[seen], right.points[seen])
    assert not seen[begin + 3 : end, [9, 10]].any() and seen[end + 3 :, [9, 10]].mean() > 0.9
    others = np.delete(np.arange(len(PLACES)), [9, 10])
    assert np.array_equal(np.isnan(kept.points[:, others]), np.isnan(right.points[:, others]))
    (note,) = notes
    assert note.startswith("markers 9 and 10 have each other's id in ") and "left out" in note
