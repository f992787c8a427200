"""Intervals of fitted values: where the answer is exact, and how often they hold it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toy

from livedeform.closed_loop.evidence.noise import Covariance, Nuisance, rows_of
from livedeform.closed_loop.forward import Correction, keys_of
from livedeform.closed_loop.inference.gauss_newton import Fit, Prior, Problem
from livedeform.closed_loop.inference.interval import (
    between_presses,
    covariance_of_values,
    drawn_along,
    followed,
    mesh_patterns,
)

PRESSES, MARKERS, SIGMA = 5, 6, 1e-4  # a moment for each press; m
PRIOR = Prior(np.zeros(2), np.full(2, 1e3), np.full(2, -1e6), np.full(2, 1e6))
TRUE = np.array([2.0, -1.0])


def problem_of(residual: np.ndarray) -> Problem:
    """A problem with white noise and no nuisance."""
    rows = rows_of(np.zeros((PRESSES, MARKERS, 3)), None, np.arange(PRESSES))
    size = np.diff(rows.bounds)
    return Problem(
        rows, residual, Covariance(rows, tuple(SIGMA**2 * np.eye(n) for n in size)), Nuisance(np.zeros((rows.n, 0)), ())
    )


def fitted(
    rng: np.random.Generator, *, each_press: float = 0.0, weight: float = 1.0
) -> tuple[Problem, Fit, np.ndarray]:
    """Fit a linear model by least squares. In each press the parameters seem others, by ``each_press``; the first
    press says ``weight`` times as much. Also returns the columns."""
    problem = problem_of(np.zeros(3 * PRESSES * MARKERS))
    press = problem.rows.moment
    J = 1e-4 * rng.normal(size=(problem.rows.n, 2)) * np.where(press == 0, weight, 1.0)[:, None]
    seems = TRUE + each_press * rng.normal(size=(PRESSES, 2))
    y = np.sum(J * seems[press], axis=1) + SIGMA * rng.normal(size=len(J))
    covariance = np.linalg.inv(J.T @ J / SIGMA**2)
    z = covariance @ J.T @ y / SIGMA**2
    fit = Fit(z, covariance, z, np.zeros(2, bool), 0.0, y - J @ z, J, 1, True)
    return problem, fit, J


@pytest.mark.parametrize("weight", [1.0, 8.0])
def test_in_a_right_model_presses_differ_as_expected(weight: float) -> None:
    rng = np.random.default_rng(0)
    ratios = [between_presses(*fitted(rng, weight=weight)[:2], PRIOR)[0] for _ in range(300)]
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.12)


def test_presses_that_disagree_are_seen() -> None:
    rng = np.random.default_rng(1)
    ratios = [between_presses(*fitted(rng, each_press=1.0)[:2], PRIOR)[0] for _ in range(50)]
    assert np.median(ratios) > 4.0


@pytest.mark.parametrize(("each_press", "plain"), [(0.0, (0.93, 0.97)), (0.4, (0.5, 0.8))])
def test_intervals_hold_as_often_as_they_say_where_the_fit_s_own_do_not(
    each_press: float, plain: tuple[float, float]
) -> None:
    rng, held, own = np.random.default_rng(2), [], []
    for _ in range(400):
        problem, fit, _ = fitted(rng, each_press=each_press)
        V = covariance_of_values(problem, fit, PRIOR, np.zeros((2, 0)), toy.SETTINGS.fit)
        held.append(np.abs(fit.z - TRUE) <= 1.96 * np.sqrt(np.diag(V)))
        own.append(np.abs(fit.z - TRUE) <= 1.96 * fit.sigma)
    assert plain[0] <= np.mean(own) <= plain[1]
    assert np.mean(held) >= 0.9


def test_an_estimate_follows_an_error_that_looks_like_its_column() -> None:
    problem, fit, J = fitted(np.random.default_rng(3))
    np.testing.assert_allclose(followed(problem, fit, J @ np.array([[0.3], [0.0]])), [[0.3], [0.0]], atol=1e-9)


def test_known_errors_widen_an_interval_by_themselves() -> None:
    problem, fit, _ = fitted(np.random.default_rng(4))
    plain = covariance_of_values(problem, fit, PRIOR, np.zeros((2, 0)), toy.SETTINGS.fit)
    V = covariance_of_values(problem, fit, PRIOR, np.array([[0.2, 0.0], [0.1, 0.3]]), toy.SETTINGS.fit)
    np.testing.assert_allclose(V - plain, [[0.04, 0.02], [0.02, 0.1]], atol=1e-12)


def test_a_fit_that_has_not_settled_is_off_by_the_step_that_it_would_still_go() -> None:
    problem, fit, J = fitted(np.random.default_rng(6))
    early = replace(fit, z=fit.z - [0.5, 0.0], residual=fit.residual + J @ [0.5, 0.0])
    settled, V = (covariance_of_values(problem, f, PRIOR, np.zeros((2, 0)), toy.SETTINGS.fit) for f in (fit, early))
    step = between_presses(problem, early, PRIOR)[2]
    np.testing.assert_allclose(step, [0.5, 0.0], atol=1e-6)
    np.testing.assert_allclose(V - settled, [[0.25, 0.0], [0.0, 0.0]], atol=1e-3)


def test_what_is_told_with_a_length_follows_it() -> None:
    _, fit, _ = fitted(np.random.default_rng(5))
    along = drawn_along(replace(fit, covariance=np.array([[4.0, -2.0], [-2.0, 1.0]])), 0, 0.1)
    np.testing.assert_allclose(along, [0.1, -0.05])


def test_a_mesh_s_pattern_is_that_of_rest_of_all_presses_and_of_each() -> None:
    o = toy.record([], seed=0)
    rows = rows_of(o.points, None, o.blocks)
    points = {key: np.full((len(o.ids), 3), 1.0 + k) for k, key in enumerate(keys_of(o))}
    empty = Problem(rows, np.zeros(rows.n), Covariance(rows, ()), Nuisance(np.zeros((rows.n, 0)), ()))
    patterns = mesh_patterns(Correction(points), [o], empty, 0.36)
    assert patterns.shape == (rows.n, 2 + o.blocks.max() + 1)
    np.testing.assert_array_equal(patterns[:, 0], 1.0)
    np.testing.assert_allclose(patterns[:, 1], 0.6 * rows.moment)
    for press in range(o.blocks.max() + 1):
        np.testing.assert_allclose(patterns[:, 2 + press], np.where(rows.fold == press, 0.8 * rows.moment, 0.0))
