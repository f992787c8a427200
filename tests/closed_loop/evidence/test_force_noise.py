"""The noise of a force sensor that filters or rounds, or whose values are sent several times, beside a probe whose
recorded path jitters."""

from __future__ import annotations

import numpy as np
import pytest
import toy
from scipy.signal import lfilter

from livedeform.closed_loop.evidence.force_noise import force_noise, noise_of_force
from livedeform.closed_loop.evidence.observation import poses_at
from livedeform.common.types import Array

SIGMA = 0.05  # N


def course(
    rate: float, filtered: float = 0.0, poles: int = 2, copies: int = 1, relaxes: float = 0.0, seed: int = 0
) -> tuple[Array, Array, Array]:
    """Return forces (w, 3) N of presses, which relax with a time constant s, their times (w,) s at ``rate`` Hz and the
    probe's places (w, 3) m; the noise is ``filtered`` with a time constant s, by each of the ``poles``."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 29.9, 1.0 / rate)
    place, _ = poses_at(toy.path(seed=seed), (1e9 * t).astype(np.int64))
    depth, fades = np.maximum(toy.HEIGHT - place[:, 2], 0.0), np.exp(-1.0 / (rate * relaxes)) if relaxes else 0.0
    held = lfilter([1.0 - fades], [1.0, -fades], depth)
    noise, keeps = rng.standard_normal((len(t) + 2000, 3)), np.exp(-1.0 / (rate * filtered)) if filtered else 0.0
    for _ in range(poles):
        noise = lfilter([1.0 - keeps], [1.0, -keeps], noise, axis=0)
    noise = noise[2000:] * SIGMA / (noise[2000:].std() if filtered else 1.0)
    force = noise - np.outer(400.0 * (depth + 0.3 * (depth - held)), [0.0, 0.0, 1.0])
    return force[np.arange(len(t)) // copies * copies], t, place


CASES = {
    "white": dict(rate=100.0),
    "two poles of 50 ms": dict(rate=100.0, filtered=0.05),
    "two poles of 20 ms": dict(rate=100.0, filtered=0.02),
    "one pole of 50 ms": dict(rate=100.0, filtered=0.05, poles=1),
    "1 kHz": dict(rate=1000.0, filtered=0.02),
    "20 Hz": dict(rate=20.0, filtered=0.05),
    "sent four times": dict(rate=100.0, copies=4),
    "filtered, and sent four times": dict(rate=250.0, filtered=0.05, copies=4),
    "filtered, and relaxing": dict(rate=100.0, filtered=0.05, relaxes=0.5),
    "white, and relaxing": dict(rate=100.0, relaxes=2.0),
}


@pytest.mark.parametrize("name", CASES)
def test_a_filter_hides_no_noise(name: str) -> None:
    """Two poles of 50 ms at 100 Hz had 0.0034 N taken for 0.050 N."""
    found = [force_noise(*course(**CASES[name], seed=seed), toy.SETTINGS) for seed in range(3)]  # type: ignore[arg-type]
    assert found == pytest.approx([SIGMA] * 3, rel=0.15)


def test_a_probe_that_never_rests_tells_of_neighbours_alone() -> None:
    """What goes on while the probe moves is no noise."""
    force, t, place = course(100.0)
    place = place + np.outer(t, [0.0, 0.0, 0.01])
    neighbours = np.median(np.abs(np.diff(force, 2, axis=0))) / 0.6745 / np.sqrt(6.0)
    assert force_noise(force, t, place, toy.SETTINGS) == pytest.approx(neighbours)


@pytest.mark.parametrize("alike", [0.0, 0.8])
@pytest.mark.parametrize("jitter", [3e-5, 5e-5, 7e-5, 1e-4, 2e-4])
@pytest.mark.parametrize("name", ["white", "two poles of 50 ms", "two poles of 20 ms", "one pole of 50 ms", "1 kHz"])
def test_a_filter_hides_no_noise_where_poses_jitter(name: str, jitter: float, alike: float) -> None:
    """A probe followed by cameras was never still, and 0.008 N were taken for 0.050 N. ``alike``: correlation of the
    error of a pose and that of the next, as a tracker's own filter makes it."""
    force, t, place = course(**CASES[name], seed=5)  # type: ignore[arg-type]
    wobble = np.random.default_rng(6).standard_normal((len(t) + 200, 3))
    wobble = lfilter([np.sqrt(1.0 - alike**2)], [1.0, -alike], wobble, axis=0)[200:]
    found = noise_of_force(force, t, place + jitter * wobble, toy.SETTINGS)
    assert found.told and found.sigma == pytest.approx(SIGMA, rel=0.15)


def test_a_probe_that_never_rests_leaves_it_open_what_a_filter_hides() -> None:
    """A swinging probe is still nowhere, and what grows with the time between samples may be its motion."""
    force, t, _ = course(100.0, filtered=0.05)
    swings = np.outer(0.005 * np.cos(2.0 * t), [0.0, 0.0, 1.0]) + np.outer(t, [0.0, 0.0, 0.01])
    assert not noise_of_force(force + 400.0 * swings, t, swings, toy.SETTINGS).told
    assert noise_of_force(course(100.0)[0], t, swings, toy.SETTINGS).told  # white: nothing grows


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("filtered", [0.0, 0.05])
@pytest.mark.parametrize("share", [0.05, 0.2, 0.5, 2.0, 5.0])
def test_rounding_hides_no_noise(share: float, filtered: float, turned: bool) -> None:
    """Values in steps of 0.1 N with a noise of 0.02 N mostly stay as they are: 0.0001 N were taken for 0.017 to
    0.029 N. The noise is that ``share`` of a step, on a slow drift."""
    step = SIGMA / share
    force, t, place = course(100.0, filtered)
    exact = force + np.outer(0.7 * step * t, [0.2, 0.3, 0.1])  # a slow drift: true values anywhere within a step
    rounded = step * np.rint(exact / step)
    Q = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0] if turned else np.eye(3)
    found = noise_of_force(rounded @ Q, t, place, toy.SETTINGS)
    assert share > 1.0 or found.step == pytest.approx(step)
    assert found.sigma == pytest.approx(np.hypot(SIGMA, step / np.sqrt(12.0)), rel=0.15)


def test_a_force_without_noise_has_the_least_one() -> None:
    force, t, place = course(100.0)
    assert force_noise(0.0 * force, t, place, toy.SETTINGS) == toy.SETTINGS.noise.force_sigma
