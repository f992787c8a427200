"""The truth's linear solver: it finds what was asked for, also of matrices that change a little or altogether."""

import numpy as np
import pytest
from scipy.sparse import random as random_matrix

from livedeform.synthetic.truth import linear

SIDE = 60


def matrices(symmetric):
    """Return the pattern and the values of matrices that follow each other: near ones, then quite another one."""
    rng = np.random.default_rng(3)
    half = random_matrix(SIDE, SIDE, 0.1, random_state=3)
    pattern = (half + half.T).toarray()
    rows, cols = np.nonzero((pattern != 0.0) | np.eye(SIDE, dtype=bool))
    values = []
    first, other = (rng.normal(size=(SIDE, SIDE)) for _ in range(2))
    for A in (first, first + 0.01 * other, first + 0.03 * other, other, other + 0.01 * first):
        A = A + A.T if symmetric else A
        values.append((A + 8.0 * np.eye(SIDE))[rows, cols])
    return rows, cols, values


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("library", ["pardiso", "superlu"])
def test_each_of_matrices_that_follow_each_other_is_solved(symmetric, library, monkeypatch):
    if library == "superlu":
        monkeypatch.setattr(linear, "PyPardisoSolver", None)
    elif linear.PyPardisoSolver is None:
        pytest.skip("no PARDISO on this platform")
    rows, cols, values = matrices(symmetric)
    factors = linear.Factors(rows, cols, np.arange(len(rows)), SIDE)
    rng = np.random.default_rng(5)
    for data in [*values, values[0], values[3]]:
        A = np.zeros((SIDE, SIDE))
        A[rows, cols] = data
        b = rng.normal(size=SIDE)
        x = factors.solve(data, b, symmetric=symmetric)
        # 4e-15 where it is factored, at most 3e-4 by the factors of another
        assert np.linalg.norm(A @ x - b) < linear.RESIDUAL * np.linalg.norm(b)
    assert not factors.solve(values[0], np.zeros(SIDE), symmetric=symmetric).any()
    factors.close()


def test_what_is_near_is_not_factored_again(monkeypatch):
    monkeypatch.setattr(linear, "PyPardisoSolver", None)
    rows, cols, values = matrices(False)
    factors = linear.Factors(rows, cols, np.arange(len(rows)), SIDE)
    counted = []
    factor = linear._SuperLU.factor
    monkeypatch.setattr(linear._SuperLU, "factor", lambda self, A: (counted.append(1), factor(self, A))[1])
    for data in values:
        factors.solve(data, np.ones(SIDE), symmetric=False)
    assert 2 <= len(counted) <= 4  # of five matrices; 2 here: the first, and quite another one
