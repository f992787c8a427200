"""What noise keeps when the shared motion is taken off, without matrices of frames times frames."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import toy

from livedeform.closed_loop.evidence.measuring_noise import noise_of
from livedeform.closed_loop.evidence.shared_motion import Unshared
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


def peak(n: int) -> float:
    """Bytes that the noise of ``n`` frames of 20 markers at 200 Hz takes at most."""
    rng, places = np.random.default_rng(0), toy.markers(20)
    data = Track(
        (np.arange(n) * 5e6).astype(np.int64),
        np.arange(20),
        places + 1e-4 * rng.standard_normal((n, 20, 3)),
        np.broadcast_to(1e-8 * np.eye(3), (n, 20, 3, 3)),
    )
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
