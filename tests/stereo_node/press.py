"""A press as the tracker meets it: spots of 60 markers of which the probe hides a third, with noise, misses and false
spots.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scene import dome_markers, looking_down, make_test_rig

from livedeform.common.frames import apply, inverse
from livedeform.stereo_node.detect.blobs import Blobs
from livedeform.stereo_node.track.identities import IdentityTracker, TrackSettings
from livedeform.stereo_node.track.match import MatchSettings, candidate_pairs

SIGMA_PX = 0.02


@dataclass(frozen=True)
class PressResult:
    """Counts over one press: published marker positions, wrong ones (a swap or a false marker), frames until a marker
    that is seen again (in both pictures) is published (all returns), and the share of markers hidden at the deepest."""

    published: int
    wrong: int
    returns: np.ndarray
    never: int
    hidden_share: float


def simulate_press(
    seed: int, seconds: float = 30.0, rate: float = 15.0, depth: float = 0.015, watch=lambda *_: None
) -> PressResult:
    """Three presses with a sideways stroke within ``seconds``; the probe goes at up to 60 mm/s.

    ``watch`` is called in every frame with the time (s), the spots of the left picture (n, 2), the pixels of all
    markers, which of them the probe covers, and which are published."""
    rng = np.random.default_rng(seed)
    markers, normals = dome_markers(60, seed=seed % 7)
    rig, T = make_test_rig(), looking_down(turn=rng.uniform(-3, 3))
    to_left = inverse(T)
    centre = apply(T, np.zeros((1, 3)))[0]
    tracker: IdentityTracker | None = None
    axis = rng.uniform(-0.012, 0.012, 2)
    n_frames = int(seconds * rate)
    published = wrong = never = 0
    returns: list[int] = []
    waiting = np.zeros(60, int)
    was_hidden = np.zeros(60, bool)
    most_hidden = 0.0
    for k in range(n_frames):
        time = k / rate
        d, slide = _profile(time % 10.0, depth)
        probe = np.array([axis[0] + slide, axis[1]])
        off = markers.points[:, :2] - probe
        bump = np.exp(-(off**2).sum(axis=1) / (2 * 0.018**2))
        inside = -normals * (d * bump)[:, None]
        drag = np.zeros((60, 3))
        drag[:, 0] = 0.25 * slide * bump
        points = markers.points + inside + drag
        covered = (np.abs(off[:, 0]) < 0.036) & (np.abs(off[:, 1]) < 0.025) & (d > 0)
        faces = ((centre - points) * normals).sum(axis=1) > 0.3 * np.linalg.norm(centre - points, axis=1)
        seen = faces & ~covered
        most_hidden = max(most_hidden, float((covered & faces).mean()))
        found = seen & (rng.random((2, 60)) > 0.01)  # one in a hundred is missed, in each picture
        left, right = (spots(rig, apply(to_left, points), found[i], rng, right=bool(i)) for i in (0, 1))
        pairs = candidate_pairs(rig, left, right, MatchSettings())
        stamp_ns = int(time * 1e9) + 1
        if tracker is None:
            tracker = IdentityTracker(apply(to_left, markers.points), np.zeros(60, bool), TrackSettings(), 1e-3)
        result = tracker.update(stamp_ns, pairs)
        rows, names = result.pairs[result.confirmed], result.markers[result.confirmed]
        error = np.linalg.norm(apply(T, pairs.points.points[rows]) - points[names], axis=1)
        published += len(rows)
        wrong += int((error > 1.5e-3).sum())
        out = np.zeros(60, bool)
        out[names] = True
        watch(time, left.centres, rig.project(apply(to_left, points))[0], covered & faces, out)
        waiting = np.where(seen, waiting + found.all(axis=0), 0)
        for i in np.flatnonzero(was_hidden & out):
            returns.append(int(waiting[i]))
        was_hidden = (was_hidden | (faces & covered)) & ~out
    never = int((was_hidden & (waiting > 3)).sum())
    return PressResult(published, wrong, np.array(returns), never, most_hidden)


def _profile(t: float, depth: float) -> tuple[float, float]:
    """Depth and sideways stroke (m) within 10 s: fast down, hold, stroke, faster up."""
    down = np.clip((t - 1.0) / 0.5, 0, 1)
    up = np.clip((t - 8.0) / 0.25, 0, 1)
    return float(depth * (down - up)), float(
        0.02 * np.clip((t - 3.0) / 2.0, 0, 1) * (1 - np.clip((t - 9.0) / 0.5, 0, 1))
    )


def spots(rig, in_left, seen, rng, right=False) -> Blobs:
    left_px, right_px, _, _ = rig.project(in_left)
    pixels = right_px if right else left_px
    false = rng.uniform([300, 100], [1000, 650], size=(6, 2))
    centres = np.concatenate([pixels[seen] + rng.normal(0, SIGMA_PX, (seen.sum(), 2)), false])
    n = len(centres)
    return Blobs(
        centres, np.tile(np.eye(2) * SIGMA_PX**2, (n, 1, 1)), np.tile(np.eye(2) / 5.0, (n, 1, 1)),
        np.full(n, -120.0), np.full(n, 0.7), np.full(n, 2.0),
    )  # fmt: skip
