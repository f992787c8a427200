"""Sparse factors of the truth's tangent: MKL's PARDISO where it is installed, SuperLU (slow) elsewhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import splu

from livedeform.common.types import Array

try:
    from pypardiso.pardiso_wrapper import PyPardisoSolver
except ImportError:  # not on this platform, or not installed
    PyPardisoSolver = None

IntArray = NDArray[np.int64]


class Factors:
    """Solve with a matrix of fixed pattern: ``rows``, ``cols`` (k,) of the entries ``taken`` (k,) of all values."""

    def __init__(self, rows: IntArray, cols: IntArray, taken: IntArray, n: int) -> None:
        upper = cols >= rows
        self._kinds = {kind: _Pattern(rows[mask], cols[mask], taken[mask], n) for kind, mask in
                       ((True, upper), (False, np.ones(len(rows), bool)))}  # fmt: skip
        self._solvers: dict[bool, object] = {}

    def solve(self, data: Array, b: Array, *, symmetric: bool) -> Array:
        """Return x of A x = b for the values ``data`` of the whole pattern."""
        x: Array
        if PyPardisoSolver is None:
            x = splu(self._kinds[False].matrix(data).tocsc()).solve(b)
            return x
        A = self._kinds[symmetric].matrix(data)
        solver = self._solvers.get(symmetric)
        if solver is None:
            solver = PyPardisoSolver(mtype=-2 if symmetric else 11)
            solver.set_phase(11)
            solver._call_pardiso(A, b)
            self._solvers[symmetric] = solver
        solver.set_phase(23)  # type: ignore[attr-defined]
        x = solver._call_pardiso(A, b)  # type: ignore[attr-defined]
        return x

    def close(self) -> None:
        """Give MKL's memory back."""
        for solver in self._solvers.values():
            solver.free_memory(everything=True)  # type: ignore[attr-defined]
        self._solvers.clear()


class _Pattern:
    def __init__(self, rows: IntArray, cols: IntArray, taken: IntArray, n: int) -> None:
        order = np.lexsort((cols, rows))
        self.taken = taken[order]
        self.indices = cols[order].astype(np.int32)
        self.indptr = np.searchsorted(rows[order], np.arange(n + 1)).astype(np.int32)
        self.shape = (n, n)

    def matrix(self, data: Array) -> csr_matrix:
        return csr_matrix((data[self.taken], self.indices, self.indptr), shape=self.shape)
