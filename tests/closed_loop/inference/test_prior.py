"""Where the data leave a line of values open, the prior decides what is said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toy

from livedeform.closed_loop.candidates import Candidate, catalogue
from livedeform.closed_loop.inference.gauss_newton import Fit, GaussNewton, Prior
from livedeform.closed_loop.settings import Settings

METHOD = GaussNewton(Settings().fit)
BALL = catalogue(toy.surroundings(toy.markers()), ["inclusion"])["inclusion"]
PLAIN = replace(BALL, coordinates=tuple(replace(c, usual=None) for c in BALL.coordinates))
KNOWN = 0.05  # of what a ball's size and contrast make together, one sigma


def seen_from_afar(candidate: Candidate, truth: np.ndarray, noise: float) -> Fit:
    """Fit a ball of which the place and what its values make together are measured."""
    size = candidate.made_together(truth)

    def residuals(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        made, slope = candidate.made_together(z), candidate.slope_of_together(z)
        place = (truth - z)[:3] / 1e-3
        left = np.append(place, (size * (1.0 + noise) - made) / (KNOWN * abs(size)))
        return left, np.vstack([np.eye(5)[:3] / 1e-3, slope / (KNOWN * abs(size))])

    start = truth.copy()
    start[3:] = np.log(0.01), np.sign(truth[4]) * 0.3
    prior = Prior.of([candidate], start)
    return METHOD(residuals, lambda r: r, start, prior, c0=np.inf, max_runs=60)


def balls(n: int, low: float, high: float) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    ratios, radii = np.exp(rng.uniform(np.log(low), np.log(high), n)), rng.uniform(0.006, 0.015, n)
    return [np.array([0.0, 0.0, 0.02, np.log(r), np.log(k)]) for r, k in zip(radii, ratios, strict=True)]


def test_the_middle_of_the_balls_that_look_alike_is_given_and_their_interval_holds():
    """Balls 2 to 20 times as stiff as what is around them (Krouskop 1998). With a prior that is normal in the logarithm
    of the ratio they were found nearly half as large again, and a quarter as stiff."""
    truths, rng = balls(200, 2.0, 20.0), np.random.default_rng(1)
    fits = [(z, seen_from_afar(BALL, z, KNOWN * rng.standard_normal())) for z in truths]
    off = np.median([fit.z[3:] - z[3:] for z, fit in fits], axis=0)
    assert np.exp(off[0]) == pytest.approx(1.0, abs=0.12)  # radius; measured 1.04
    assert np.exp(off[1]) == pytest.approx(1.0, abs=0.4)  # ratio; measured 0.71
    ends = [(BALL.values(z).values, BALL.intervals(fit.z, fit.covariance, 1.96)) for z, fit in fits]
    for name in ("radius", "ratio"):
        held = np.mean([e[name][0] <= float(true[name]) <= e[name][1] for true, e in ends])
        assert held >= 0.93  # measured 1.0 of both
    plain = [(z, seen_from_afar(PLAIN, z, 0.0)) for z in truths[:40]]
    off = np.median([fit.z[3:] - z[3:] for z, fit in plain], axis=0)
    assert np.exp(off[0]) > 1.35 and np.exp(off[1]) < 0.4  # measured 1.43 and 0.24


@pytest.mark.parametrize("ratio", [0.1, 0.3, 0.5])
def test_a_soft_ball_stays_soft(ratio):
    """What is seen of one is at most what is seen of a hole of its size."""
    for z in balls(10, ratio, ratio):
        fit = seen_from_afar(BALL, z, 0.0)
        assert fit.converged and fit.z[4] < 0.0
        ends = BALL.intervals(fit.z, fit.covariance, 1.96)
        assert ends["ratio"][0] <= ratio <= ends["ratio"][1]
        assert ends["radius"][0] <= np.exp(z[3]) <= ends["radius"][1]


def test_its_slope_and_precision_are_those_of_its_cost():
    rng = np.random.default_rng(2)
    for z in balls(20, 1.2, 30.0) + balls(20, 0.1, 0.8):
        prior = Prior.of([BALL], z)
        z = z + 0.1 * rng.standard_normal(5)
        h = 1e-4 * np.eye(5)
        slope = [(prior.cost(z + d) - prior.cost(z - d)) / 2e-4 for d in h]
        assert 2.0 * prior.slope(z) == pytest.approx(np.array(slope), rel=1e-3, abs=1e-6)
    z[4] = 0.0  # nothing is there: as probable as without that prior
    plain, nothing = (Prior.of([c], z) for c in (PLAIN, BALL))
    assert (nothing.cost(z), list(nothing.precision(z))) == (plain.cost(z), list(plain.precision(z)))
    assert plain.precision(z) == pytest.approx(1.0 / plain.sigma**2)


def test_a_wider_prior_at_the_end_is_as_if_it_had_been_there_from_the_start():
    """A value of 12, known to 0.8, with what is usual of 5: that draws it down, and is no part of what is gained."""

    def residuals(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (12.0 - z) / 0.8, np.array([[1.0 / 0.8]])

    def fitted(prior: Prior) -> Fit:
        return METHOD(residuals, lambda r: r, np.zeros(1), prior, c0=(12.0 / 0.8) ** 2, max_runs=9)

    usual, wide = (Prior(np.zeros(1), np.array([sigma]), np.full(1, -99.0), np.full(1, 99.0)) for sigma in (5.0, 12.0))
    held, free = fitted(usual), fitted(wide)
    ended = METHOD.last_step(held, lambda r: r, wide, usual)
    assert ended is not None and ended.z == pytest.approx(free.z) and ended.sigma == pytest.approx(free.sigma)
    assert ended.gain == pytest.approx(free.gain) and held.gain < free.gain - 4.0  # measured 4.6 less
