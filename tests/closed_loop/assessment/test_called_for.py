"""How much of what an effect moves held-out data call for, whatever markers' places and registration scatter."""

from __future__ import annotations

import numpy as np
import pytest
import toy
from toy_loop import PLACES, toy_inputs

from livedeform.closed_loop.assessment.called_for import Called, called_for, moved_in_noise
from livedeform.closed_loop.assessment.held_out import HeldOutErrors
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.evidence.noise import Covariance, Nuisance, rows_of
from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.closed_loop.loop import investigate
from livedeform.common.types import Array

K, M, BLOCKS = 24, 20, 6  # moments, markers, presses
NOISE, PLACE, SHIFT = 3e-5, 2e-4, 3e-4  # m: of a window's mean, of where a marker is stuck, of the registration
FRAME = 1e-4  # m, noise of a single frame
PART = 0.01  # of the noise's mean square, which matters


def made(share: float, seed: int, size: float = 0.3 * FRAME, wrong: float = 0.0) -> tuple[Problem, Array]:
    """Make what is left without an effect that moves the markers by ``size`` m rms per coordinate, of which that
    ``share`` is there, and by what it moves them (n,) m; each press is another share, scattered by ``wrong``."""
    rng = np.random.default_rng(seed)
    points, folds = np.zeros((K, M, 3)), np.arange(K) // (K // BLOCKS)
    rows = rows_of(points, None, folds)
    motion = size * rng.normal(size=(BLOCKS, M, 3))[folds] * (1.0 + np.arange(K) % 4)[:, None, None] / np.sqrt(7.5)
    shares = share + wrong * rng.normal(size=BLOCKS)[folds][:, None, None]
    error = NOISE * rng.normal(size=points.shape) + PLACE * rng.normal(size=(1, M, 3)) + SHIFT * rng.normal(size=3)
    block = NOISE**2 * np.eye(3 * K) + PLACE**2 * np.tile(np.eye(3), (K, K))
    shift = Nuisance(SHIFT * np.eye(3)[rows.axis], ("x", "y", "z"))
    problem = Problem(rows, rows.take(shares * motion + error), Covariance(rows, (block,) * M), shift)
    return problem, rows.take(motion)


def found(share: float, seed: int, **how: float) -> Called:
    problem, motion = made(share, seed, **how)
    moved = float(np.mean(motion**2)) / FRAME**2
    return called_for(problem, problem.residual, problem.residual - motion, moved)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0, 2.5])
def test_the_share_is_right_and_its_standard_error_as_large_as_its_scatter(share):
    """Markers are stuck 7 times as far off as the noise of what is compared."""
    all_of_them = [found(share, seed) for seed in range(40)]
    off = np.array([(c.share - share) / c.sigma for c in all_of_them])
    assert abs(off.mean()) < 0.4  # measured -0.10, of 0.16 that 40 have
    assert 0.5 < np.sqrt(np.mean(off**2)) < 1.3  # measured 0.76: it is the largest of what data, presses, markers say
    mean = np.mean([c.share for c in all_of_them])
    assert mean == pytest.approx(share, abs=0.02)


def test_what_presses_differ_by_is_in_the_standard_error():
    sure, unsure = (np.mean([found(1.0, s, wrong=wrong).sigma for s in range(10)]) for wrong in (0.0, 0.6))
    assert unsure > 3.0 * sure  # measured 0.191 and 0.038
    off = np.array([(c.share - 1.0) / c.sigma for c in (found(1.0, s, wrong=0.6) for s in range(40))])
    assert 0.5 < np.sqrt(np.mean(off**2)) < 1.6  # measured 1.34


def test_it_matters_by_what_it_surely_takes_off():
    assert found(1.0, 1).matters(PART)  # it moves 0.3 of the noise
    assert not found(1.0, 1, size=0.09 * FRAME).matters(PART)  # all of it, and less than matters
    assert not found(0.5, 1).matters(PART)  # as wrong with it as without it
    assert not found(-1.0, 1).matters(PART) and found(-1.0, 1).fall < 0.0
    assert not Called(0.7, 0.25, 1.0).matters(PART)


def test_more_than_all_of_it_takes_off_no_more():
    """A slip of the base was fitted where nothing slips, and moved 0.75 % of the noise: 1.36 +- 0.20 of it were called
    for, which would be 1.3 %."""
    assert Called(1.36, 0.20, 0.0075).fall == 0.0075 and not Called(1.36, 0.20, 0.0075).matters(PART)
    assert Called(2.49, 0.35, 0.0905).matters(PART)  # a true friction, of which the mean square tells 5 +- 12 %


def test_what_moves_nothing_is_not_called_for():
    problem, _ = made(1.0, 0)
    nothing = called_for(problem, problem.residual, problem.residual, 0.0)
    assert nothing.share == 0.0 and not np.isfinite(nothing.sigma) and not nothing.matters(PART)


def test_what_is_let_go_is_counted_over_markers():
    """One stretch of time is no scatter of presses."""
    problem, motion = made(1.0, 0)
    once = rows_of(np.zeros((K, M, 3)), None, np.zeros(K, int))
    problem = Problem(once, problem.residual, problem.covariance, problem.nuisance)
    left = problem.residual - motion
    assert not called_for(problem, problem.residual, left, 1.0).matters(PART)  # one press says nothing of the next
    assert called_for(problem, problem.residual, left, 1.0, pressed=False).matters(PART)


def errors(predicted: Array, sigma: Array) -> HeldOutErrors:
    k, m, _ = predicted.shape
    measured = np.full_like(predicted, FRAME)
    measured[0, 1] = np.nan
    covariances = np.broadcast_to(np.diag(sigma**2), (k, m, 3, 3))
    weights, presses = np.linspace(1.0, 2.0, k), np.arange(k) + 1
    return HeldOutErrors((toy.recording_errors(measured, predicted, covariances, weights, presses),))


@pytest.mark.parametrize(("axis", "matters"), [(0, True), (2, False)])
def test_what_goes_sideways_is_compared_with_the_noise_there_and_not_with_that_of_depth(axis, matters):
    """Two cameras see depth six times worse: 0.4 of the sideways noise is 0.5 % of the mean square in millimetres."""
    sigma, moved = FRAME * np.array([1.0, 1.0, 6.0]), np.zeros((8, 3, 3))
    moved[..., axis] = 0.4 * FRAME
    square = moved_in_noise(errors(0.0 * moved, sigma), errors(moved, sigma))
    assert square == pytest.approx((0.4 if matters else 0.4 / 6.0) ** 2 / 3.0)
    assert Called(1.0, 0.01, square).matters(PART) == matters


def test_where_nothing_is_seen_nothing_is_moved():
    nothing = errors(np.full((8, 3, 3), np.nan), np.full(3, FRAME))
    assert moved_in_noise(nothing, nothing) == 0.0
    exact = errors(np.zeros((8, 3, 3)), np.zeros(3)), errors(np.full((8, 3, 3), FRAME), np.zeros(3))
    assert np.isfinite(moved_in_noise(*exact))  # a tracker may say that it knows a direction exactly


def relaxed(in_fit: float, in_test: float) -> Diagnosis:
    """Diagnose a body that relaxes by other shares in the recording that is fitted and in that held out."""
    fit, test = (
        toy.record([toy.effect("viscoelasticity", g=[g], tau=[2.0])], seed=seed, name=name, n=36)
        for g, seed, name in ((in_fit, 3, "fit"), (in_test, 1003, "test"))
    )
    inputs = toy_inputs(fit, test, ["viscoelasticity"])
    return investigate(toy.ToyModel(toy.ToyBody(PLACES)), inputs, seed=3)


@pytest.mark.parametrize("in_test", [0.2, 0.4])
def test_another_amount_in_what_was_held_out_is_told(in_test):
    found = relaxed(0.2, in_test)
    assert found.verdict == "effect"
    said = [n for n in found.notes if "times what viscoelasticity was fitted to move" in n]
    assert len(said) == 1
    share, sigma = (float(x) for x in said[0].split("call for ")[1].split(" times")[0].split(" +- "))
    assert sigma < 0.1 and share == pytest.approx(in_test / 0.2, abs=3.0 * sigma)  # 1.03 +- 0.06, 2.04 +- 0.07
