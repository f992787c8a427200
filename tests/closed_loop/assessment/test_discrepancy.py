"""What the black box says is left."""

import numpy as np
import pytest

from livedeform.closed_loop.assessment.discrepancy import discrepancy
from livedeform.closed_loop.evidence.noise import Covariance, Nuisance, Rows, rows_of
from livedeform.closed_loop.inference.gauss_newton import Problem
from livedeform.closed_loop.settings import Settings
from livedeform.common.types import Array

MOMENTS, MARKERS, NOISE = 30, 6, 5e-5


def problem(residual: Array, columns: Array, rows: Rows) -> Problem:
    blocks = tuple(NOISE**2 * np.eye(n) for n in np.diff(rows.bounds))
    return Problem(
        rows, residual, Covariance(rows, blocks), Nuisance(columns, tuple(map(str, range(columns.shape[1]))))
    )


def size(values: Array) -> float:
    """Return the rms of vectors whose components are ``values`` (n,)."""
    return float(np.sqrt(3.0 * np.mean(values**2)))


@pytest.mark.parametrize("seed", range(5))
def test_what_is_told_to_be_left_is_not_more_than_is_there(seed: int) -> None:
    """The same motion is nearly a column of the black box and of what is allowed for: both large, and cancelled."""
    rng = np.random.default_rng(seed)
    rows = rows_of(np.zeros((MOMENTS, MARKERS, 3)), None, np.zeros(MOMENTS, int))
    swing = rng.normal(size=(rows.n, 2))
    rough = rng.normal(size=(rows.n, 2))
    allowed = 3e-3 * (swing + 0.02 * rough)
    left = 3e-3 * 0.04 * rough.sum(axis=1)  # 0.3 mm, which the black box can have with 50 times of it, cancelled
    found = discrepancy(problem(left, allowed, rows), swing, (MOMENTS, MARKERS), Settings())
    assert found.p_value < 0.02
    assert found.excess <= size(left)  # the black box alone: 14 to 15 mm
    assert size(found.smooth.ravel()) == pytest.approx(found.excess)


def test_a_smooth_field_is_told_with_its_size() -> None:
    rng = np.random.default_rng(7)
    rows = rows_of(np.zeros((MOMENTS, MARKERS, 3)), None, np.zeros(MOMENTS, int))
    basis = rng.normal(size=(rows.n, 3))
    field = basis @ [3e-4, -2e-4, 4e-4]
    noisy = field + NOISE * rng.normal(size=rows.n)
    found = discrepancy(problem(noisy, np.zeros((rows.n, 1)), rows), basis, (MOMENTS, MARKERS), Settings())
    assert found.excess == pytest.approx(size(field), rel=0.02)  # measured 0.0044


@pytest.mark.parametrize("step", [1, 2, 3])
def test_what_was_not_seen_does_not_make_what_is_left_smaller(step: int) -> None:
    """It was averaged over all declared markers: with one in four seen, half of what is left of these."""
    rng = np.random.default_rng(8)
    points = np.full((MOMENTS, MARKERS, 3), np.nan)
    points[::2, ::step] = 0.0
    rows = rows_of(points, None, np.zeros(MOMENTS, int))
    basis = rng.normal(size=(rows.n, 3))
    field = basis @ [3e-4, -2e-4, 4e-4]
    noisy = field + NOISE * rng.normal(size=rows.n)
    found = discrepancy(problem(noisy, np.zeros((rows.n, 1)), rows), basis, (MOMENTS, MARKERS), Settings())
    assert found.excess == pytest.approx(size(field), rel=0.02)  # measured 0.0039, 0.0026, 0.0003
    assert found.rms() == pytest.approx(found.excess)
    assert found.rms_at(found.seen.any(axis=1)) == pytest.approx(found.excess, rel=1e-12)
    assert np.sqrt(np.mean(found.rms(axis=0)[::step] ** 2)) == pytest.approx(found.excess)
    assert not found.rms(axis=0)[np.arange(MARKERS) % step > 0].any()
