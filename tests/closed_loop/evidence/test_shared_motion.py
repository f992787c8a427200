"""What noise keeps when the shared motion is taken off, without matrices of frames times frames."""

from __future__ import annotations

import time
import tracemalloc

import numpy as np
import pytest
import toy

from livedeform.closed_loop.evidence.measuring_noise import noise_of
from livedeform.closed_loop.evidence.shared_motion import Unshared, lagged
from livedeform.closed_loop.evidence.track import Track


@pytest.mark.parametrize("tau", [0.0, 0.01, 0.3, 3.0])
def test_noise_keeps_what_the_courses_leave_of_it(tau: float) -> None:
    """By the whole matrix M R M, M = 1 - C C^T, at times that are not even."""
    rng = np.random.default_rng(2)
    f, lags = 60, 5
    seconds = np.cumsum(rng.uniform(0.01, 0.08, f))
    courses = np.linalg.qr(rng.standard_normal((f, 3)))[0]
    own = Unshared(np.arange(8), np.zeros((f, 8, 3)), courses, np.zeros(f))
    apart = np.abs(seconds[:, None] - seconds)
    R = np.exp(-apart / tau) if tau > 0.0 else np.eye(f)
    M = np.eye(f) - courses @ courses.T
    frames = rng.random(f) > 0.2
    left = M @ R @ M
    expected = [np.mean([left[i, i + k] for i in range(f - k) if frames[i] and frames[i + k]]) for k in range(lags + 1)]
    one_direction = 1.0 - 2.0 / (3.0 * 8.0)  # of the two courses that are no constant
    assert own.kept(seconds, tau, lags, frames) == pytest.approx(one_direction * np.array(expected), abs=1e-12)


@pytest.mark.parametrize(("f", "lags"), [(1, 0), (97, 24), (97, 96)])
def test_products_of_later_frames_are_those_of_a_loop(f: int, lags: int) -> None:
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((2, f, 4, 3))
    expected = [np.vdot(a[: f - k], b[k:]) for k in range(lags + 1)]
    assert lagged(a, b, lags) == pytest.approx(np.array(expected), abs=1e-11)


def stretch(n: int, rate: float) -> Track:
    """``n`` frames of 20 markers at rest, at ``rate`` Hz."""
    points = toy.markers(20) + 1e-4 * np.random.default_rng(0).standard_normal((n, 20, 3))
    stamps = (np.arange(n) * 1e9 / rate).astype(np.int64)
    return Track(stamps, np.arange(20), points, np.broadcast_to(1e-8 * np.eye(3), (n, 20, 3, 3)))


@pytest.mark.slow
def test_a_fast_tracker_takes_time_as_its_frames_do() -> None:
    """A loop over all frames for each lag of up to 2 s took 11 times as long at four times the rate."""
    took = []
    for rate in (100.0, 400.0):
        data = stretch(round(60 * rate), rate)
        began = time.process_time()
        noise_of(data, toy.SETTINGS.noise)
        took.append(time.process_time() - began)
    assert took[1] < 8.0 * took[0]  # measured 4.0


def peak(n: int) -> float:
    """Bytes that the noise of ``n`` frames of 20 markers at 200 Hz takes at most."""
    data = stretch(n, 200.0)
    tracemalloc.start()
    noise_of(data, toy.SETTINGS.noise)
    used = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return float(used)


@pytest.mark.slow
def test_a_long_recording_takes_memory_as_its_frames_do() -> None:
    """18 000 frames, 90 s at 200 Hz, needed more than 5 GB."""
    peak(500)
    small, large = peak(1500), peak(6000)
    assert large < 5.0 * small  # measured 3.9: as the frames, and not as their square
