"""Sparse factors of the truth's tangent: MKL's PARDISO where it is installed, SuperLU (slow) elsewhere.

A matrix near the one that was factored last is not factored: GMRES solves with it, preconditioned by those factors.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import LinearOperator, gmres, splu

from livedeform.common.types import Array

try:
    from pypardiso.pardiso_wrapper import PyPardisoSolver
except ImportError:  # not on this platform, or not installed
    PyPardisoSolver = None

IntArray = NDArray[np.int64]
MOST_STEPS = 14  # of GMRES at a time; factors take as long as 20 to 30
FEW_STEPS, SPARE_STEPS = 5, 6  # what a near matrix takes, and what all may take beyond that until one is factored anew
AIM, RESIDUAL = 1e-5, 1e-2  # of GMRES, preconditioned, and of its result at most: shares of the right side


class Factors:
    """Solve with a matrix of fixed pattern: ``rows``, ``cols`` (k,) of the entries ``taken`` (k,) of all values."""

    def __init__(self, rows: IntArray, cols: IntArray, taken: IntArray, n: int) -> None:
        upper = cols >= rows
        self._patterns = {kind: _Pattern(rows[mask], cols[mask], taken[mask], n) for kind, mask in
                          ((True, upper), (False, np.ones(len(rows), bool)))}  # fmt: skip
        self._solvers: dict[bool, _Solver] = {}

    def solve(self, data: Array, b: Array, *, symmetric: bool) -> Array:
        """Return x of A x = b for the values ``data`` of the whole pattern: a correction of Newton's method.

        The residual is mostly 1e-5 of b and at most ``RESIDUAL`` of it.
        """
        symmetric = symmetric and PyPardisoSolver is not None
        A = self._patterns[symmetric].matrix(data)
        if symmetric not in self._solvers:
            self._solvers[symmetric] = _Solver(symmetric=symmetric)
        return self._solvers[symmetric].solve(A, b)

    def close(self) -> None:
        """Give MKL's memory back."""
        for solver in self._solvers.values():
            solver.direct.close()
        self._solvers.clear()


class _Solver:
    """Hold the last factors; of a ``symmetric`` matrix only the upper half is given."""

    def __init__(self, *, symmetric: bool) -> None:
        self.direct = _SuperLU() if PyPardisoSolver is None else _Pardiso(symmetric=symmetric)
        self._symmetric = symmetric
        self._spare = 0  # steps of GMRES; none without factors

    def solve(self, A: csr_matrix, b: Array) -> Array:
        if self._spare > 0 and b.any():
            x = self._near(A, b)
            if x is not None:
                return x
        self._spare = SPARE_STEPS
        self.direct.factor(A)
        return self.direct.solve(b)

    def _near(self, A: csr_matrix, b: Array) -> Array | None:
        """Return x of A x = b by the last factors; None where they are too far off."""
        steps = 0

        def by_factors(r: Array) -> Array:
            nonlocal steps
            steps += 1
            return self.direct.solve(r)

        times = _symmetric_product(A) if self._symmetric else A.dot
        product, inverse = (LinearOperator(A.shape, f, dtype=float) for f in (times, by_factors))
        x: Array = gmres(product, b, rtol=AIM, restart=MOST_STEPS, maxiter=1, M=inverse)[0]
        self._spare -= max(0, steps - FEW_STEPS)
        return x if np.linalg.norm(b - times(x)) < RESIDUAL * np.linalg.norm(b) else None


def _symmetric_product(upper: csr_matrix) -> Callable[[Array], Array]:
    lower, diagonal = upper.T, upper.diagonal()
    return lambda v: upper @ v + lower @ v - diagonal * v


class _Pardiso:
    def __init__(self, *, symmetric: bool) -> None:
        self._solver = PyPardisoSolver(mtype=-2 if symmetric else 11)
        self._matrix: csr_matrix | None = None

    def factor(self, A: csr_matrix) -> None:
        zeros = np.zeros(A.shape[0])
        if self._matrix is None:
            self._call(11, A, zeros)
            self._solver.set_iparm(1, 1)  # the settings that it has filled in hold, but without refinement
            self._solver.set_iparm(8, 0)
        self._call(22, A, zeros)
        self._matrix = A

    def solve(self, b: Array) -> Array:
        return self._call(33, self._matrix, b)

    def close(self) -> None:
        self._solver.free_memory(everything=True)

    def _call(self, phase: int, A: csr_matrix | None, b: Array) -> Array:
        self._solver.set_phase(phase)
        x: Array = self._solver._call_pardiso(A, b)
        return x


class _SuperLU:
    def factor(self, A: csr_matrix) -> None:
        self._factors = splu(A.tocsc())

    def solve(self, b: Array) -> Array:
        x: Array = self._factors.solve(b)
        return x

    def close(self) -> None:
        pass


class _Pattern:
    def __init__(self, rows: IntArray, cols: IntArray, taken: IntArray, n: int) -> None:
        order = np.lexsort((cols, rows))
        self.taken = taken[order]
        self.indices = cols[order].astype(np.int32)
        self.indptr = np.searchsorted(rows[order], np.arange(n + 1)).astype(np.int32)
        self.shape = (n, n)

    def matrix(self, data: Array) -> csr_matrix:
        return csr_matrix((data[self.taken], self.indices, self.indptr), shape=self.shape)
