"""What a tracker states of its noise, or does not: zero, exact directions, frames that are sent again."""

from __future__ import annotations

import numpy as np
import pytest
import toy

from livedeform.closed_loop.evidence.measuring_noise import noise_of
from livedeform.closed_loop.evidence.observation import observe, poses_at
from livedeform.closed_loop.evidence.track import Track, track
from livedeform.common.types import Array, MarkerFrame

SIGMA = 1e-4  # m, of a coordinate
STAMPS = (np.arange(0.05, 29.9, 0.04) * 1e9).astype(np.int64)


def pressed(m: int, seed: int = 1) -> Array:
    """Return points (f, m, 3) m of the toy body with white noise, at ``STAMPS``."""
    position, _ = poses_at(toy.path(seed=seed), STAMPS)
    points = toy.ToyBody(toy.markers(m)).points([], 1e-9 * STAMPS, position)
    return points + SIGMA * np.random.default_rng(seed).standard_normal(points.shape)


def sent(points: Array, covariances: Array, stamps: np.ndarray, lost: float = 0.0) -> Track:
    """Put points (f, m, 3) m with covariances (f, m, 3, 3) m2 on markers, as a tracker sends them that loses a share
    of them."""
    ids, rng = np.arange(points.shape[1]).astype(np.uint32), np.random.default_rng(7)
    seen = rng.random(points.shape[:2]) >= lost
    each = zip(stamps, points, covariances, seen, strict=True)
    return track([MarkerFrame(int(s), ids[k], p[k], c[k], np.full(k.sum(), np.nan)) for s, p, c, k in each], ids)


@pytest.mark.parametrize("m", [7, 20])
@pytest.mark.parametrize("which", ["all", "one marker", "every 50th frame", "one marker of one frame"])
def test_zero_is_not_stated(which: str, m: int) -> None:
    """It ended a diagnosis with `LinAlgError: Singular matrix`."""
    points = pressed(m)
    zero = np.zeros(points.shape[:2], bool)
    zero[{"all": np.s_[:], "one marker": np.s_[:, 3], "every 50th frame": np.s_[::50]}.get(which, np.s_[9, 3])] = True
    stated = np.where(zero[..., None, None], 0.0, SIGMA**2 * np.eye(3))
    data = sent(points, stated, STAMPS)
    unknown = np.isnan(data.covariances).all(axis=(2, 3))
    np.testing.assert_array_equal(unknown, zero)
    o = observe("zero", data, toy.path(seed=1), n_moments=20, start_ns=0, settings=toy.SETTINGS)
    assert o.noise.source in (("second differences",) if m < 8 and which == "all" else ("stated", "unshared motion"))
    sigma = np.sqrt(np.trace(o.noise.covariance, axis1=1, axis2=2) / 3.0)
    assert sigma == pytest.approx(SIGMA, rel=0.2)
    assert np.isfinite(o.points).all() and (np.linalg.eigvalsh(o.covariances) > 0.0).all()


@pytest.mark.parametrize("m", [7, 20])
@pytest.mark.parametrize("turned", [False, True])
def test_a_direction_that_is_stated_exactly_has_the_noise_of_the_recording(turned: bool, m: int) -> None:
    """Of zero noise every frame is an outlier, and no point is left."""
    stated = SIGMA**2 * np.diag([1.0, 1.0, 0.0])
    Q = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0] if turned else np.eye(3)
    stated = np.asarray((Q @ stated @ Q.T).astype(np.float32), float)  # as a message has it
    points = pressed(m)
    data = sent(points, np.broadcast_to(stated, (*points.shape[:2], 3, 3)), STAMPS)
    o = observe("exact", data, toy.path(seed=1), n_moments=20, start_ns=0, settings=toy.SETTINGS)
    assert np.isfinite(o.points).all()
    assert np.sqrt(np.linalg.eigvalsh(o.noise.covariance)) == pytest.approx(SIGMA, rel=0.5)
    assert o.noise.repeated > 0.6  # of a third of the variance that is not stated
    assert o.noise.scale == pytest.approx(1.0, rel=0.15)


@pytest.mark.parametrize("m", [7, 20])
@pytest.mark.parametrize("copies", [2, 3, 5])
def test_a_tracker_that_sends_each_frame_several_times_has_the_noise_that_it_has(copies: int, m: int) -> None:
    """Of 7 markers that were sent three times and more the independent noise was taken for nearly zero, and chi2 per
    datum went from 0.7 to 310."""
    points, dt = np.repeat(pressed(m), copies, axis=0), 40_000_000 // copies
    stamps = np.repeat(STAMPS, copies) + np.tile(np.arange(copies) * dt, len(STAMPS))
    covariances = np.broadcast_to(SIGMA**2 * np.eye(3), (*points.shape[:2], 3, 3))
    data = sent(points, covariances, stamps, lost=0.02)
    assert data.copies == (copies - 1) * len(STAMPS) and len(data.stamps_ns) == len(STAMPS)
    noise = noise_of(data, toy.SETTINGS.noise)
    assert noise.scale == pytest.approx(1.0, rel=0.08) and noise.repeated > 0.9  # measured


def test_markers_that_are_sent_in_turn_are_no_copies() -> None:
    """Each frame has new places of every third marker: no frame is a copy, and most of its points are."""
    points, frame = pressed(6), np.arange(len(STAMPS))
    for i in range(6):
        points[:, i] = points[np.maximum(frame - (frame + i) % 3, 0), i]
    data = sent(points, np.broadcast_to(SIGMA**2 * np.eye(3), (*points.shape[:2], 3, 3)), STAMPS)
    assert data.copies == 0
    assert noise_of(data, toy.SETTINGS.noise).repeated > 0.9


@pytest.mark.parametrize("moving", [0, 300])
def test_a_body_at_rest_without_noise_is_kept(moving: int) -> None:
    """Frames that are alike for long are a body that rests: what is there of it stays."""
    points = np.repeat(toy.markers(10)[None], 700, axis=0)
    points[:moving] += 1e-5 * np.arange(moving)[:, None, None]
    data = sent(points, np.full((700, 10, 3, 3), np.nan), STAMPS[:700])
    assert data.copies == 0 and len(data.stamps_ns) == 700
