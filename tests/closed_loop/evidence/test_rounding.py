"""Values that were rounded: their step is found, and what rounding leaves is no less noise for staying as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toy

from livedeform.closed_loop.evidence.measuring_noise import noise_of
from livedeform.closed_loop.evidence.observation import observe
from livedeform.closed_loop.evidence.recordings import _of_rounding, _of_the_force
from livedeform.closed_loop.evidence.rounding import of_rounding, steps_of, that_lasts
from livedeform.closed_loop.evidence.track import Track
from livedeform.common.types import Array

STEP = 1e-4  # m
NOISE = toy.SETTINGS.noise


def second(x: Array) -> Array:
    """Return second differences (n, 3) of ``x`` (f, 3)."""
    return np.diff(x, 2, axis=0)


def turn(seed: int = 0) -> Array:
    """Return some rotation (3, 3)."""
    return np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("share", [0.05, 0.3, 0.7])
def test_the_step_of_rounded_values_is_found(share: float, turned: bool, single: bool) -> None:
    """Turned into another frame too, and as single numbers."""
    x = share * STEP * np.random.default_rng(3).standard_normal((2000, 3)) + 0.05
    x += 0.01 * np.sin(np.linspace(0.0, 20.0, 2000))[:, None]
    x = STEP * np.rint(x / STEP) @ (turn() if turned else np.eye(3)) + 0.1
    x = np.asarray(x.astype(np.float32), float) if single else x
    assert steps_of(second(x), float(np.abs(x).max()), NOISE) == pytest.approx(STEP, rel=0.02)


def test_each_axis_has_its_own_step() -> None:
    x = 2e-5 * np.random.default_rng(3).standard_normal((2000, 3)) + np.linspace(0.0, 0.01, 2000)[:, None]
    x[:, :2] = np.rint(x[:, :2] / [STEP, 3.0 * STEP]) * [STEP, 3.0 * STEP]
    assert steps_of(second(x), 0.01, NOISE) == pytest.approx([STEP, 3.0 * STEP, 0.0])


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("seed", range(20))
def test_values_that_were_not_rounded_have_no_step(seed: int, single: bool) -> None:
    rng = np.random.default_rng(seed)
    x = 0.1 + 10.0 ** rng.uniform(-6.0, -3.0) * rng.standard_normal((int(rng.integers(12, 500)), 3))
    x = np.asarray(x.astype(np.float32), float) if single else x
    assert not steps_of(second(x), 0.1, NOISE).any()


@pytest.mark.parametrize("share", [0.02, 0.1, 0.2, 0.3, 0.5, 1.0])
def test_what_lasts_of_a_rounding_error_follows_from_what_repeats(share: float) -> None:
    """By many true values, each measured many times: together they are the noise and a twelfth of a squared step."""
    rng = np.random.default_rng(1)
    true = rng.random(4000)
    errors = np.rint(true + share * rng.standard_normal((400, 4000))) - true
    repeats = errors.var(axis=0, ddof=1).mean()
    lasts = errors.mean(axis=0).var() - repeats / len(errors)
    found = that_lasts(np.array(repeats), np.array(1.0))
    assert found == pytest.approx(lasts, abs=1e-3)  # of 0.083; measured 0.0003 at most
    assert repeats + found == pytest.approx(share**2 + of_rounding(np.array(1.0)), rel=0.02)


def recorded(
    m: int, sigma: float, seed: int, turned: bool = False, stated: float = float("nan")
) -> tuple[Track, Array]:
    """Return ``m`` markers of the toy body at 25 Hz, with white noise of ``sigma`` m, in steps of 0.1 mm, and where
    they are (f, m, 3) m; ``stated`` m, sigma of a coordinate."""
    stamps = (np.arange(0.05, 29.9, 0.04) * 1e9).astype(np.int64)
    position, _ = toy.poses_at(toy.path(seed=seed), stamps)
    true = toy.ToyBody(toy.markers(m)).points([], 1e-9 * stamps, position)
    noisy = true + sigma * np.random.default_rng(seed).standard_normal(true.shape)
    Q = turn(seed) if turned else np.eye(3)
    covariances = np.broadcast_to(stated**2 * np.eye(3), (*true.shape, 3)).copy()
    return Track(stamps, np.arange(m), STEP * np.rint(noisy / STEP) @ Q, covariances), true @ Q


CASES = [(m, share) for m in (4, 6, 8, 20) for share in (0.05, 0.1, 0.2, 0.3, 0.5)]


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(("m", "share"), CASES)
def test_markers_that_were_rounded_have_the_noise_that_they_have(m: int, share: float, turned: bool) -> None:
    """Of 6 markers in steps of 0.1 mm with a noise of 0.02 mm 0.000 mm were taken for 0.032 mm, and of 8 0.025 mm for
    0.034 mm. What is taken holds for single frames, and for means, in which rounding errors stay."""
    data, true = recorded(m, share * STEP, 11, turned)
    noise = noise_of(data, NOISE)
    size = np.sqrt(np.trace(noise.covariance, axis1=1, axis2=2).mean() / 3.0)
    assert 0.9 < size / np.sqrt(np.mean((data.points - true) ** 2)) < 1.25  # measured 0.98 to 1.20
    o = observe("rounded", data, toy.path(seed=11), n_moments=30, start_ns=0, settings=toy.SETTINGS)
    at = np.array([[np.interp(o.stamps_ns, data.stamps_ns, c) for c in marker.T] for marker in true.swapaxes(0, 1)])
    error = np.sqrt(np.mean((o.points - at.transpose(2, 0, 1)) ** 2))
    taken = noise.repeated * o.covariances + (1.0 - noise.repeated) * noise.covariance
    taken = np.sqrt(np.trace(taken, axis1=2, axis2=3).mean() / 3.0)
    assert 0.9 < taken / error < 1.4  # measured 0.97 to 1.31; of few markers the frames of a window count as one


@pytest.mark.parametrize("m", [6, 20])
@pytest.mark.parametrize("stated", [1e-6, 2e-5, 3.5e-5])
def test_a_statement_far_below_the_step_does_not_hold(stated: float, m: int) -> None:
    """The true error is 0.035 mm: the noise of 0.02 mm and what rounding adds. What is stated of it stays as it is."""
    data, true = recorded(m, 2e-5, 12, stated=stated)
    noise = noise_of(data, NOISE)
    size = np.sqrt(np.trace(noise.covariance, axis1=1, axis2=2).mean() / 3.0)
    assert size == pytest.approx(np.sqrt(np.mean((data.points - true) ** 2)), rel=0.2)
    assert 0.6 < noise.repeated <= 1.0


def test_steps_far_below_the_noise_change_nothing() -> None:
    data, _ = recorded(20, 3.0 * STEP, 13, stated=3.0 * STEP)
    plain = replace(data, points=data.points + STEP * (np.random.default_rng(0).random(data.points.shape) - 0.5))
    ours, theirs = noise_of(data, NOISE), noise_of(plain, NOISE)
    assert ours.covariance == pytest.approx(theirs.covariance, rel=0.05, abs=1e-10)
    assert (ours.scale, ours.repeated) == pytest.approx((theirs.scale, theirs.repeated), rel=0.02)


@pytest.mark.parametrize(("share", "said"), [(0.02, True), (0.05, True), (0.5, False)])
def test_errors_that_stay_are_said(share: float, said: bool) -> None:
    data, _ = recorded(8, share * STEP, 14)
    o = observe("a", data, toy.path(seed=14), n_moments=30, start_ns=0, settings=toy.SETTINGS)
    assert ("steps of 0.1 mm" in "".join(_of_rounding(o))) == said


def test_a_force_of_unknown_noise_is_said() -> None:
    data, _ = recorded(8, STEP, 15)
    o = observe("a", data, toy.path(seed=15), n_moments=30, start_ns=0, settings=toy.SETTINGS)
    o = replace(o, forces=np.zeros((o.n_moments, 3)), force_sigma=0.01)
    assert not _of_the_force(o, 100)
    (note,) = _of_the_force(replace(o, force_told=False), 100)
    assert "0.01 N may be too small" in note
