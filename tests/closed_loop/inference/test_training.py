"""Products over all data and over training sets are those of data whitened one set at a time."""

from __future__ import annotations

import numpy as np
import pytest

from livedeform.closed_loop.evidence.noise import Covariance, ModelErrors, Nuisance, covariance_of, rows_of
from livedeform.closed_loop.inference.gauss_newton import Marginal, Problem
from livedeform.closed_loop.inference.training import Products
from livedeform.closed_loop.settings import AllowanceSettings

MOMENTS, MARKERS, GROUPS = 9, 7, 3


def stated(force: bool, hidden: bool, n_nuisance: int) -> tuple[np.random.Generator, Problem]:
    """State a problem of some presses, with places of markers that all moments share."""
    rng = np.random.default_rng(4)
    points = np.zeros((MOMENTS, MARKERS, 3))
    if hidden:
        points[rng.random((MOMENTS, MARKERS)) < 0.4] = np.nan
        points[:, 3] = np.nan
    forces = np.zeros((MOMENTS, 3)) if force else None
    rows = rows_of(points, forces, np.repeat([0, 1, 2], MOMENTS // 3))
    size = 1e-10 * rng.random((MOMENTS, MARKERS))[..., None, None] * np.eye(3)
    errors = ModelErrors(np.full(MARKERS, 1e-4), 0.02)
    motion, presses = 1e-3 * rng.random((MOMENTS, MARKERS)), np.repeat([0, 1, 2], MOMENTS // 3)
    covariance: Covariance = covariance_of(
        rows, size, motion, presses, errors, force=forces, force_sigma=1e-4, settings=AllowanceSettings()
    )
    columns = 1e-2 * rng.normal(size=(rows.n, n_nuisance))  # far above the noise, as a registration is
    names = tuple(str(i) for i in range(n_nuisance))
    return rng, Problem(rows, 1e-4 * rng.normal(size=rows.n), covariance, Nuisance(columns, names))


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("hidden", [False, True])
@pytest.mark.parametrize("n_nuisance", [0, 5])
def test_each_training_set_has_the_products_of_what_it_keeps(force: bool, hidden: bool, n_nuisance: int) -> None:
    rng, problem = stated(force, hidden, n_nuisance)
    rows, columns = problem.rows, 1e-4 * rng.normal(size=(problem.rows.n, 3))
    products = Products.of(problem, columns, GROUPS)
    time = [rows.fold != fold for fold in (0, 1, 2)]
    markers = [(rows.marker < 0) | (rows.marker % GROUPS != group) for group in range(GROUPS)]
    assert len(products.time) == len(time) and len(products.markers) == len(markers)
    for product, keep in zip(products.all, [np.ones(rows.n, bool), *time, *markers], strict=True):
        white = Marginal(problem.covariance, problem.nuisance, keep)(columns)
        np.testing.assert_allclose(product, white.T @ white, rtol=1e-7, atol=1e-7 * np.abs(product).max())
