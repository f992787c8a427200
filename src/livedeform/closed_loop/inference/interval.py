"""Say how sure fitted values are: beyond noise, what the elements get wrong, press by press.

A fit's own covariance knows the elements' error as smooth fields of some per cent of the motion. What the refined mesh
tells differently is a pattern of its own, and a part of it stays after it was taken off. The estimate follows any error
d of the prediction by

    dz = A^-1 J~^T d~,    A = J~^T J~ + prior^-1,

so an error d = a D, D the difference of the two meshes and a ~ N(0, remains) of each press, in part the same in all,
adds the sum of dz dz^T over its parts (a covariance of low rank; finite elements whose error is left out make estimates
overconfident: Poot, Kerfriden, Rocha & van der Meer 2025).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtri, stdtrit

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Correction
from livedeform.closed_loop.inference.gauss_newton import RANK, Fit, Marginal, Prior, Problem
from livedeform.closed_loop.inference.problem import blocks_of, recordings_of
from livedeform.closed_loop.settings import FitSettings
from livedeform.common.types import Array

LEVEL = 0.975  # an interval of 95 %
SIGMAS = float(ndtri(LEVEL))  # of a normal distribution, to either side


def mesh_patterns(
    correction: Correction, observations: Sequence[Observation], problem: Problem, common: float
) -> Array:
    """Return by what the refined mesh differs (rows, b + 2): while the body is at rest, in all recordings alike, and
    beyond that in all presses alike, with a share ``common`` of the square, and in each of the b presses."""
    points, forces = correction.of_points(observations), correction.of_forces(observations)
    presses, recordings = blocks_of(observations), recordings_of(observations)
    first = np.searchsorted(recordings, recordings)  # moments of a recording follow each other
    rest, rest_forces = points[first], forces[first]
    moved = problem.rows.take(points - rest, forces - rest_forces)
    parts = [problem.rows.take(rest, rest_forces), np.sqrt(common) * moved]
    for press in np.unique(presses):
        here = (presses == press)[problem.rows.moment]
        parts.append(np.sqrt(1.0 - common) * moved * here)
    return np.column_stack(parts)


def followed(problem: Problem, fit: Fit, errors: Array) -> Array:
    """Return by how much the coordinates (p, k) of a fit follow ``errors`` (rows, k) of the prediction."""
    marginal = problem.marginal
    return np.asarray(fit.covariance @ (marginal(fit.columns).T @ marginal(errors)))


def between_presses(problem: Problem, fit: Fit, prior: Prior) -> tuple[Array, int, Array]:
    """Return how much further the coordinates (p,) move when a press is left out than the covariance expects, in
    squares, how many presses there are, and the step (p,) that the fit would still go with all of them.

    Without press b the estimate moves by d_b, and in a right model with variance V_-b - V, of what is known without
    and with it. The ratio of the sums over the presses is 1 then, however much a single press tells; it is larger
    where presses disagree for a reason that the model does not have: a probe that seems to press beside its place by
    another amount on each spot of a coarse surface. Each estimate is one step from the fit.
    """
    stiffness, slope = np.diag(prior.precision(fit.z)), prior.slope(fit.z)

    def step(marginal: Marginal) -> tuple[Array, Array]:
        r, J = marginal(fit.residual), marginal(fit.columns)
        covariance = np.linalg.inv(J.T @ J + stiffness)
        return covariance @ (J.T @ r - slope), np.diag(covariance)

    whole, variance = step(problem.marginal)
    folds = np.unique(problem.rows.fold)
    moved, expected = np.zeros(len(whole)), np.zeros(len(whole))
    for fold in folds:
        without, larger = step(problem.marginal_of(problem.rows.fold != fold))
        moved += (without - whole) ** 2
        expected += larger - variance
    ratio = np.divide(moved, expected, out=np.ones_like(moved), where=expected > RANK * variance)
    return ratio, len(folds), whole


def drawn_along(fit: Fit, number: int, by: float) -> Array:
    """Return by how much the coordinates (p,) are off where number ``number`` is off ``by`` so much: the others follow
    it as the data ask, as the modulus of a layer that seems too thick."""
    return np.asarray(fit.covariance[:, number] / fit.covariance[number, number] * by)


def covariance_of_values(problem: Problem, fit: Fit, prior: Prior, errors: Array, settings: FitSettings) -> Array:
    """Return the covariance (p, p) of a fit's coordinates with all that is known of its errors; ``errors`` (p, k): by
    how much the coordinates are off, one sigma each. Its sigmas are those of normal distributions whose intervals of
    95 % are as wide.

    A fit that has not settled is off by the step that it would still go. Its own variance is known up to a factor, of
    which few presses tell little: its prior counts as ``settings.presses_known`` of them (a scaled inverse chi-square,
    hence Student's t; Gelman et al. 2013, 3.3).
    """
    ratio, n, step = between_presses(problem, fit, prior)
    prior_freedom, freedom = settings.presses_known, n - 1
    both = prior_freedom + freedom
    wider = float(stdtrit(both, LEVEL) / SIGMAS)
    factor = wider * np.sqrt((prior_freedom + freedom * ratio) / both)
    errors = np.column_stack([errors, step])
    return np.asarray(fit.covariance * np.outer(factor, factor) + errors @ errors.T)
