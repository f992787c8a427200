"""The size of the noise, its correlation, outliers, windows and blocks."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import toy
from scipy.signal import lfilter

from livedeform.closed_loop.evidence.measuring_noise import NoiseReport
from livedeform.closed_loop.evidence.measuring_noise import noise_of as estimate
from livedeform.closed_loop.evidence.observation import observe as observe_with
from livedeform.closed_loop.evidence.observation import poses_at
from livedeform.closed_loop.evidence.recordings import in_sequence, without
from livedeform.closed_loop.evidence.track import Track, track
from livedeform.common.errors import RecordingError
from livedeform.common.types import MarkerFrame, Pose

observe = partial(observe_with, settings=toy.SETTINGS)
SPREAD = np.array([0.5, 0.5, 1.6]) * 1e-4


def noise_of(data: Track) -> NoiseReport:
    return estimate(data, toy.SETTINGS.noise)


def still(n: int = 750, m: int = 20, *, rho: float = 0.0, stated: float = 1.0, seed: int = 0) -> Track:
    """Markers at rest at 25 Hz with AR(1) noise and stated covariances."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((n, m, 3)) * np.sqrt(1.0 - rho**2)
    noise = lfilter([1.0], [1.0, -rho], white, axis=0) if rho else white
    points = toy.markers(m) + SPREAD * noise
    cov = np.broadcast_to(np.diag(SPREAD**2) / stated, (n, m, 3, 3)).copy()
    return Track((np.arange(n) * 4e7).astype(np.int64), np.arange(m), points, cov)


def test_the_stated_size_of_the_noise_is_checked():
    assert noise_of(still()).scale == pytest.approx(1.0, rel=0.03)  # measured 1.01
    assert noise_of(still(stated=4.0)).scale == pytest.approx(4.0, rel=0.03)  # measured 4.05


def test_a_marker_that_is_never_seen_has_a_possible_covariance():
    """Long ellipsoids along three directions: the medians of the elements make no covariance."""
    data = still(n=50)
    along = np.resize([[1.0, 1.0, -1.0], [1.0, 1.0, 1.0], [1.0, -1.0, -1.0]], (20, 3))
    one = 1e-10 * (np.eye(3) + 100.0 * np.einsum("mi,mj->mij", along, along))
    assert np.linalg.eigvalsh(np.median(one, axis=0)).min() < 0.0
    points, covariances = data.points.copy(), np.broadcast_to(one, (50, 20, 3, 3)).copy()
    points[:, 7], covariances[:, 7] = np.nan, np.nan
    found = noise_of(replace(data, points=points, covariances=covariances)).covariance
    assert (np.linalg.eigvalsh(found) > 0.0).all()


def test_one_frame_of_a_few_of_the_markers_keeps_what_is_stated():
    data = still(n=1)
    points, covariances = data.points.copy(), data.covariances.copy()
    points[:, ::2], covariances[:, ::2] = np.nan, np.nan
    one = observe("one", replace(data, points=points, covariances=covariances))
    assert (one.n_moments, one.n_frames.tolist()) == (1, [1])
    assert np.diagonal(one.covariances[0, 1::2], axis1=1, axis2=2) == pytest.approx(np.tile(SPREAD**2, (10, 1)))


def test_without_stated_covariances_the_recording_gives_them():
    data = still()
    report = noise_of(Track(data.stamps_ns, data.ids, data.points, np.full_like(data.covariances, np.nan)))
    assert np.isnan(report.scale)
    assert np.sqrt(np.diag(report.covariance.mean(axis=0))) == pytest.approx(SPREAD, rel=0.06)


def test_frames_that_are_not_independent_count_less():
    assert noise_of(still()).inflation == pytest.approx(1.0, abs=0.2)
    rho = 0.8
    # second differences see (6 - 8 rho + 2 rho^2) / 6 of the variance, long means (1 + rho) / (1 - rho) of it
    seen = (6.0 - 8.0 * rho + 2.0 * rho**2) / 6.0
    expected = (1.0 + rho) / (1.0 - rho)
    report = noise_of(still(rho=rho))
    total = max(report.scale, 1.0) * report.inflation  # what a long mean's variance is multiplied by in the end
    assert report.scale == pytest.approx(seen, rel=0.1)
    # measured 2.0: more than one frame's variance; stretches of 2 s see no more of the rest
    assert 1.5 < total < expected


def test_wild_frames_do_not_reach_the_means():
    rng = np.random.default_rng(3)
    data = still(seed=3)
    points = data.points.copy()
    wild = rng.random(points.shape[:2]) < 0.01
    points[wild] += 0.01
    o = observe("still", Track(data.stamps_ns, data.ids, points, data.covariances), n_moments=30, start_ns=0)
    used = o.n_frames >= 5
    off = np.abs(o.points[used] - toy.markers(20)).max()
    assert off < 6e-4  # 10 mm outliers; measured 0.19 mm, the noise of few frames


@pytest.mark.parametrize("poor", [(0.05, 30.0), (0.3, 5.0)])
def test_a_point_that_is_stated_to_be_noisier_counts_less(poor: tuple[float, float]):
    """What was stated was averaged over time: 46 and 8 times the variance of a usual frame was taken for all."""
    data = still(seed=5)
    times = np.where(np.random.default_rng(6).random(data.points.shape[:2]) < poor[0], poor[1], 1.0)
    points = toy.markers(20) + times[..., None] * (data.points - toy.markers(20))
    covariances = data.covariances * times[..., None, None] ** 2
    o = observe("still", replace(data, points=points, covariances=covariances), n_moments=100, start_ns=0)
    size = np.sqrt(np.trace(o.noise.covariance, axis1=1, axis2=2) / (SPREAD**2).sum())
    assert size == pytest.approx(1.0, rel=0.05) and o.noise.ratio == pytest.approx(
        1.0, rel=0.1
    )  # measured 1.001; 1.002
    off = o.points - toy.markers(20)
    z2 = np.einsum("kmi,kmij,kmj->km", off, np.linalg.inv(o.covariances), off)
    assert z2.mean() == pytest.approx(3.0, rel=0.1)  # measured 2.96 and 3.05
    z2 = ((o.single - toy.markers(20)) ** 2 / np.diagonal(o.single_covariances, axis1=2, axis2=3)).sum(axis=2)
    assert z2.mean() == pytest.approx(3.0, rel=0.1)  # measured 2.95 and 3.06


def test_moments_are_where_something_happens_and_moving_frames_are_not_averaged():
    o = toy.record([], seed=0)
    assert o.n_moments == 48
    assert {"rest", "press", "hold", "retreat"} == set(o.phases)
    assert o.blocks.max() + 1 == 4  # one per press
    moving = np.linalg.norm(o.velocities, axis=1) > 5e-3
    assert (o.n_frames[moving] == 1).all()
    assert o.n_frames[o.phases == "hold"].max() >= 5


def pressed_with(seed: int) -> tuple[Track, int]:
    """Presses of a body with random markers, as a tracker of a random rate and noise sees them, and how many."""
    rng = np.random.default_rng(seed)
    period, m, n = 1.0 / rng.choice([10, 30, 60, 100]), int(rng.integers(8, 60)), int(rng.integers(1, 5))
    noise, depth = rng.choice([2e-5, 5e-5, 1e-4, 2e-4, 4e-4]), rng.uniform(1e-3, 4e-3)
    rest, ramp, hold = rng.uniform(0.8, 2.0), rng.uniform(0.4, 2.0), rng.uniform(0.3, 3.0)
    knots = np.cumsum([0.0, rest, *[ramp, hold, ramp, rest] * n])
    t = np.arange(0.0, knots[-1], period)
    down = np.interp(t, knots, [0.0, 0.0, *[1.0, 1.0, 0.0, 0.0] * n])
    places = rng.uniform(-0.04, 0.04, (m, 3))
    near = np.exp(-(((places - places[0])[:, :2] / 0.02) ** 2).sum(axis=1) / 2.0)
    moved = depth * near[:, None] * [0.3, 0.3, -1.0]
    points = places + down[:, None, None] * moved + noise / np.sqrt(3.0) * rng.normal(size=(len(t), m, 3))
    return Track((1e9 * t).astype(np.int64), np.arange(m), points, np.full((len(t), m, 3, 3), np.nan)), n


@pytest.mark.parametrize("seed", range(1, 120, 6))
def test_noise_makes_no_presses(seed: int):
    """Of 400 seeds none was wrong; with motion smoothed over five frames, whatever their noise, one in ten was."""
    data, n = pressed_with(seed)
    o = observe("r", data)
    assert o.blocks.max() + 1 == max(n, 4)
    assert set(o.presses) == set(range(n + 1))


def test_blocks_of_a_part_are_numbered_anew():
    o = toy.record([], seed=0)
    part = o.take(o.blocks >= 2)
    assert set(part.blocks) == {0, 1}
    assert part.start_ns == o.start_ns and len(part.path) == len(o.path)


def test_poses_are_interpolated_and_held_at_the_ends():
    q = np.array([0.0, 0.0, 0.0, 1.0])
    poses = [Pose(0, np.zeros(3), q), Pose(1_000_000_000, np.array([0.0, 0.0, 1.0]), q)]
    position, _ = poses_at(poses, np.array([250_000_000, 3_000_000_000]))
    assert position[:, 2] == pytest.approx([0.25, 1.0])
    shifted, _ = poses_at(poses, np.array([250_000_000]), 0.5)
    assert shifted[0, 2] == pytest.approx(0.75)


def test_no_frames_and_no_overlap_are_said():
    with pytest.raises(RecordingError, match="no marker frames"):
        track([])
    nan = np.full(1, np.nan)
    frames = [
        MarkerFrame(s, np.array([0], np.uint32), np.zeros((1, 3)), np.full((1, 3, 3), np.nan), nan)
        for s in range(0, 10**9, 10**8)
    ]
    late = [Pose(s, np.zeros(3), np.array([0, 0, 0, 1.0])) for s in (5 * 10**9, 6 * 10**9)]
    with pytest.raises(RecordingError, match="overlap"):
        observe("x", track(frames), late)


def test_a_late_wrench_is_read_later():
    o = toy.record([], seed=0)
    o = replace(o, wrench_times=np.array([0.0, 10.0]), wrench_forces=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -5.0]]))
    inside = (o.seconds > 0.1) & (o.seconds < 9.9)
    assert o.force_later(0.02)[inside, 2] == pytest.approx(-0.01)
    assert toy.record([], seed=0).force_later(0.02) == pytest.approx(0.0)


def test_a_body_that_has_not_come_back_goes_on():
    first = toy.record([], seed=1, name="first")
    shift = np.zeros((len(first.ids), 3))
    shift[:, 2] = -3e-4  # what the first recording leaves
    later = replace(toy.record([], seed=2, name="later"), start_ns=first.start_ns + 60_000_000_000)
    left = replace(first, points=first.points + np.linspace(0.0, 1.0, first.n_moments)[:, None, None] * shift)
    settled = replace(later, points=later.points + shift)
    assert in_sequence([left, settled])[1].before is left
    assert in_sequence([left, later])[1].before is None  # a new one, or it has recovered
    assert in_sequence([settled, left])[0].before is left  # by the clock, not by the order of the files
    whole = in_sequence([left, settled])[1].with_all_before()
    assert whole.n_moments == first.n_moments + later.n_moments
    assert len(np.unique(whole.blocks)) == len(np.unique(first.blocks)) + len(np.unique(later.blocks))


def test_what_a_hand_is_still_at_is_left_out_and_markers_have_rates():
    stamps = (np.arange(0.0, 1.0, 0.01) * 1e9).astype(np.int64) + 5
    points = np.zeros((100, 1, 3))
    points[:, 0, 2] = 0.1 * np.arange(0.0, 1.0, 0.01)
    data = Track(stamps, np.array([1]), points, np.full((100, 1, 3, 3), np.nan))
    kept = without(data, 5, 0.2, 0.003, (-5.0, 10.0))
    assert len(without(data, 5, 0.2, 0.0, (-5.0, 10.0)).stamps_ns) == 100
    assert len(kept.stamps_ns) == 95 and not np.isin(stamps[19:24], kept.stamps_ns).any()
    o = observe_with("take", kept, settings=toy.SETTINGS, n_moments=20)
    assert o.rates[:, 0, 2] == pytest.approx(0.1) and not o.rates[:, 0, :2].any()
    assert o.take(np.arange(o.n_moments) < 3).rates.shape == (3, 1, 3)
