"""Sparse direct solver: MKL's PARDISO through pypardiso where installed, scipy's SuperLU otherwise (and says that it
is slow).

The symbolic analysis of a sparsity pattern is done once, also for solvers that come one after another; the numerical
factor is kept until the next ``factorise``. A factor in single precision (`SinglePrecision`) takes 0.6 of the time: it
leads Newton's iterations as well, whose residuals are in double precision, and what has to be exact is refined
(Wilkinson 1963).
"""

from __future__ import annotations

import ctypes
import os
import sys
import warnings
import weakref
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from livedeform.common.processes import stated_threads
from livedeform.common.types import Array
from livedeform.fem_node.solve.assembly import Pattern, System

# where MKL's wheel puts its library: pypardiso would search the whole Python installation for it, a third of a second
for _library in Path(sys.prefix, "lib").glob("libmkl_rt.so*"):
    os.environ.setdefault("PYPARDISO_MKL_RT", str(_library))

try:
    from pypardiso import PyPardisoSolver
except (ImportError, OSError):  # not installed, or without its library
    PyPardisoSolver = None

DEFAULT_THREADS = stated_threads("MKL_NUM_THREADS", "OMP_NUM_THREADS") or 2
_SPD, _SYMMETRIC, _GENERAL = 2, -2, 11  # PARDISO's matrix types
_ANALYSE, _FACTORISE, _SOLVE, _RELEASE = 11, 22, 33, -1
MOST_LOST = 1e-2  # of a known solution: a factor in single precision that is no more exact is none (usual: 1e-5)
MOST_FAILURES = 3  # in a row, of which a nearly singular tangent may be the cause: then in double
REFINEMENTS = 3  # of such a solution at most, each of which takes off at least that share
REFINED = 1e-3  # of the solution, a change after which its square is left


Kind = tuple[int, bool, int]  # PARDISO's type of matrix, whether in single precision, and on how many threads
# handles that solvers have done with, by their pattern: with it analysed, which takes as long as some factors
_given_back: weakref.WeakKeyDictionary[Pattern, dict[Kind, Any]] = weakref.WeakKeyDictionary()


class FactorisationError(Exception):
    """The matrix is singular, or not positive definite where it should be."""


class Factor(Protocol):
    """A kept factorisation K."""

    def solve(self, right_hand_side: Array) -> Array:
        """Return K^-1 b for b (n,) or (n, k), as exactly as Newton's iterations need it."""
        ...

    def solve_exactly(self, right_hand_side: Array) -> Array:
        """Return K^-1 b for b (n,) or (n, k), to a millionth of the largest number at least."""
        ...


class LinearSolver(Factor, Protocol):
    """A kept factorisation of the tangent."""

    def begin_anew(self) -> None:
        """Forget which tangents came before."""
        ...

    def factorise(self, system: System) -> None:
        """Factorise the system's values; `FactorisationError` if that cannot be."""
        ...


def make_linear_solver(
    pattern: Pattern,
    *,
    n_negative: int = 0,
    threads: int | None = None,
    single: bool = False,
    nearly_symmetric: bool = False,
) -> LinearSolver:
    """Make the fastest solver that is installed. ``n_negative``: how many negative eigenvalues a stable symmetric
    tangent has (0: positive definite, Cholesky; as many as there are pressures: a saddle point). ``single``: with a
    factor in single precision where that is possible; ``nearly_symmetric``: of a matrix that is not, but has
    pivots on its diagonal."""
    if PyPardisoSolver is not None:
        threads = threads or DEFAULT_THREADS
        try:
            if single and pattern.symmetric and not n_negative:
                return SinglePrecision(pattern, threads)
            return Pardiso(pattern, n_negative=n_negative, threads=threads, nearly_symmetric=nearly_symmetric)
        except ImportError:  # pypardiso without the MKL library
            pass
    _warn_slow()
    return SuperLU(pattern)


class Pardiso:
    """PARDISO with its symbolic analysis reused: Cholesky, symmetric indefinite LDL^T or LU, as the pattern allows."""

    def __init__(
        self,
        pattern: Pattern,
        *,
        n_negative: int = 0,
        threads: int = DEFAULT_THREADS,
        single: bool = False,
        nearly_symmetric: bool = False,
    ) -> None:
        self.pattern, self.n_negative = pattern, n_negative
        self._type: Any = np.float32 if single else np.float64
        self.mtype = (_SYMMETRIC if n_negative else _SPD) if pattern.symmetric else _GENERAL
        self._matches = self.mtype != _SPD and not nearly_symmetric  # looks at the values when it analyses
        kind = self.mtype, single, threads
        self._handle = _lent(pattern, kind)
        os.environ.setdefault("PYPARDISO_MKL_RT", self._handle.libmkl._name)  # wherever else it was found
        self._handle.libmkl.MKL_Set_Num_Threads(threads)
        iparm = self._handle.iparm
        iparm[0] = 1  # the values below, not the defaults
        iparm[1] = 2  # nested dissection (METIS)
        iparm[9] = 8 if self.mtype == _SYMMETRIC else 13  # pivot perturbation 1e-8, 1e-13
        iparm[10] = iparm[12] = int(self._matches)  # scaling and matching
        iparm[20] = 1  # Bunch-Kaufman
        iparm[27] = int(single)
        iparm[34] = 1  # indices from 0
        self._values: Array = np.zeros(pattern.nnz, self._type)
        self._finalizer = weakref.finalize(self, _give_back, self._handle, pattern, kind)

    def begin_anew(self) -> None:
        """See `LinearSolver`: no factor depends on the one before."""

    def factorise(self, system: System) -> None:
        self._values[:] = system.values
        if not np.all(np.isfinite(self._values)):
            raise FactorisationError("the tangent is not finite")
        if not self._handle.analysed or self._matches:
            self._call(_ANALYSE, np.zeros(self.pattern.n_dof, self._type))
            self._handle.analysed = True
        self._call(_FACTORISE, np.zeros(self.pattern.n_dof, self._type))
        if self.mtype == _SYMMETRIC and self._handle.iparm[22] != self.n_negative:
            raise FactorisationError("the tangent is not stable")

    def solve(self, right_hand_side: Array) -> Array:
        b = np.asfortranarray(right_hand_side, dtype=self._type)
        return np.ascontiguousarray(self._call(_SOLVE, b), dtype=np.float64)

    def solve_exactly(self, right_hand_side: Array) -> Array:
        return self.solve(right_hand_side)

    def _call(self, phase: int, b: Array) -> Array:
        x = np.zeros_like(b, order="F")
        error = _call_pardiso(self._handle, self.pattern, self.mtype, phase, self._values, b, x)
        if error:
            raise FactorisationError(f"PARDISO error {error} in phase {phase}")
        return x


class SinglePrecision:
    """Cholesky in single precision; in double where that loses too much, as of a nearly singular tangent."""

    def __init__(self, pattern: Pattern, threads: int) -> None:
        self._single, self._threads = Pardiso(pattern, threads=threads, single=True), threads
        self._double: Pardiso | None = None
        self._factor: Pardiso = self._single
        self._failures = 0  # in a row
        self._tangent = System(pattern)
        signs = np.random.default_rng(0).integers(0, 2, pattern.n_dof)
        # (n,) a solution that tells how exact the factor is
        self._known: Array = np.asarray(2.0 * signs - 1.0, np.float64)

    def begin_anew(self) -> None:
        """See `LinearSolver`: single precision is tried again."""
        self._failures = 0

    def factorise(self, system: System) -> None:
        self._factor = self._single
        self._tangent.values[:] = system.values
        if self._failures < MOST_FAILURES:
            self._failures += 1
            self._single.factorise(system)
            self._failures = 0
            lost = float(np.abs(self._single.solve(system.times(self._known)) - self._known).max())
            if lost <= MOST_LOST:
                return
        self._double = self._double or Pardiso(self._single.pattern, threads=self._threads)
        self._factor = self._double
        self._double.factorise(system)

    def solve(self, right_hand_side: Array) -> Array:
        return self._factor.solve(right_hand_side)

    def solve_exactly(self, right_hand_side: Array) -> Array:
        x = self._factor.solve(right_hand_side)
        if self._factor is self._single:
            for _ in range(REFINEMENTS):
                change = self._factor.solve(right_hand_side - self._tangent.times(x))
                x += change
                if np.abs(change).max() <= REFINED * np.abs(x).max():
                    break
        return x


class CondensingSolver(Protocol):
    """A kept factorisation that tells the compliance of some ``dofs``; ``ahead``: for nearly nothing, so that others
    may as well come with it that are needed later."""

    dofs: NDArray[np.int64]
    ahead: bool

    def cover(self, dofs: NDArray[np.int64]) -> None:
        """Let the next factor come with the compliance of the ``dofs`` (m,), which rise."""

    def factorise(self, system: System) -> Array:
        """Factorise the system's values; return the compliance (m, m) m/N. `FactorisationError` if that cannot be."""
        ...

    def solve(self, right_hand_side: Array) -> Array:
        """Return K^-1 b for b (n,) or (n, k)."""
        ...


def make_condensing(pattern: Pattern, *, n_negative: int = 0, threads: int | None = None) -> CondensingSolver:
    """Make the fastest one that is installed, for tangents as in `make_linear_solver`."""
    if pattern.symmetric and not n_negative:
        try:
            return Condensing(pattern, threads)
        except ImportError:
            pass
    return SolvedColumns(pattern, n_negative, threads)


class SolvedColumns:
    """A factor of any kind, with the compliance solved for, dof by dof."""

    ahead = False

    def __init__(self, pattern: Pattern, n_negative: int = 0, threads: int | None = None) -> None:
        self.pattern, self.dofs = pattern, np.zeros(0, np.int64)
        self._linear = make_linear_solver(pattern, n_negative=n_negative, threads=threads)

    def cover(self, dofs: NDArray[np.int64]) -> None:
        """See `CondensingSolver`."""
        self.dofs = dofs

    def factorise(self, system: System) -> Array:
        """See `CondensingSolver`."""
        self._linear.factorise(system)
        unit = np.zeros((self.pattern.n_dof, len(self.dofs)), order="F")
        unit[self.dofs, np.arange(len(self.dofs))] = 1.0
        return np.array(self._linear.solve(unit)[self.dofs])

    def solve(self, right_hand_side: Array) -> Array:
        """See `CondensingSolver`."""
        return self._linear.solve(right_hand_side)


class Condensing:
    """A Cholesky factor in single precision that comes with the compliance of some dofs: their Schur complement is a
    part of PARDISO's factor, for a half more of its time. `ImportError` without PARDISO."""

    ahead = True

    def __init__(self, pattern: Pattern, threads: int | None = None) -> None:
        if PyPardisoSolver is None:
            raise ImportError("pypardiso")
        self.pattern, self.dofs = pattern, np.zeros(0, np.int64)
        self._handle = PyPardisoSolver(mtype=_SPD)
        self._handle.libmkl.MKL_Set_Num_Threads(threads or DEFAULT_THREADS)
        iparm = self._handle.iparm
        iparm[0], iparm[1], iparm[9], iparm[27], iparm[34] = 1, 2, 13, 1, 1  # as `Pardiso`, in single precision
        iparm[35] = 2  # the Schur complement, and a factor that solves
        self._values: NDArray[np.float32] = np.zeros(pattern.nnz, np.float32)
        self._analysed = False
        self._finalizer = weakref.finalize(self, _release, self._handle, pattern)

    def cover(self, dofs: NDArray[np.int64]) -> None:
        """Let the next factor come with the compliance of the ``dofs`` (m,), which rise."""
        if np.array_equal(dofs, self.dofs):
            return
        if self._analysed:
            self._call(_RELEASE, np.zeros(1, np.float32), np.zeros(1, np.float32))
        self.dofs, self._analysed = dofs, False
        self._handle.perm = np.zeros(self.pattern.n_dof, np.int32)
        self._handle.perm[dofs] = 1

    def factorise(self, system: System) -> Array:
        """Factorise the system's values; return the compliance (m, m) m/N. `FactorisationError` if that cannot be."""
        self._values[:] = system.values
        if not np.all(np.isfinite(self._values)):
            raise FactorisationError("the tangent is not finite")
        nothing, m = np.zeros(self.pattern.n_dof, np.float32), len(self.dofs)
        if not self._analysed:
            self._call(_ANALYSE, nothing, nothing.copy())
            self._analysed = True
        schur = np.zeros((m, m), np.float32)
        self._call(_FACTORISE, nothing, schur)
        S = schur.astype(np.float64)
        try:
            C: Array = np.asarray(np.linalg.inv(0.5 * (S + S.T)), np.float64)
        except np.linalg.LinAlgError as error:
            raise FactorisationError("the surface is not held") from error
        return 0.5 * (C + C.T)

    def solve(self, right_hand_side: Array) -> Array:
        """Return K^-1 b for b (n,) or (n, k), as exactly as Newton's iterations need it."""
        b = np.asfortranarray(right_hand_side, dtype=np.float32)
        x = np.zeros_like(b, order="F")
        self._call(_SOLVE, b, x)
        return np.ascontiguousarray(x, dtype=np.float64)

    def _call(self, phase: int, b: Any, x: Any) -> None:
        error = _call_pardiso(self._handle, self.pattern, _SPD, phase, self._values, b, x)
        if error:
            raise FactorisationError(f"PARDISO error {error} in phase {phase}")


def _call_pardiso(handle: Any, pattern: Any, mtype: int, phase: int, values: Any, b: Any, x: Any) -> int:
    integer, real = ctypes.POINTER(ctypes.c_int32), ctypes.c_void_p
    error = ctypes.c_int32(0)

    def number(value: int) -> Any:
        return ctypes.byref(ctypes.c_int32(value))

    handle._mkl_pardiso(
        handle.pt.ctypes.data_as(ctypes.POINTER(ctypes.c_int64)),
        number(1),
        number(1),
        number(mtype),
        number(phase),
        number(pattern.n_dof),
        values.ctypes.data_as(real),
        pattern.indptr.ctypes.data_as(integer),
        pattern.indices.ctypes.data_as(integer),
        handle.perm.ctypes.data_as(integer),
        number(1 if b.ndim == 1 else b.shape[1]),
        handle.iparm.ctypes.data_as(integer),
        number(0),
        b.ctypes.data_as(real),
        x.ctypes.data_as(real),
        ctypes.byref(error),
    )
    return error.value


def _lent(pattern: Pattern, kind: Kind) -> Any:
    """Return a handle of PARDISO: one that another solver of this pattern has given back is ``analysed`` already."""
    kept = _given_back.get(pattern, {})
    if kind in kept:
        return kept.pop(kind)
    handle = PyPardisoSolver(mtype=kind[0])
    handle.analysed = False
    return handle


def _give_back(handle: Any, pattern: Pattern, kind: Kind) -> None:
    """Keep one handle of a kind, factor and all, for the next solver of its pattern as long as that lives."""
    if pattern not in _given_back:
        kept = _given_back[pattern] = {}
        arrays = SimpleNamespace(n_dof=pattern.n_dof, indptr=pattern.indptr, indices=pattern.indices)
        weakref.finalize(pattern, _release_all, kept, arrays)
    if kind in _given_back[pattern] or not handle.analysed:
        _release(handle, pattern)
    else:
        _given_back[pattern][kind] = handle


def _release_all(kept: dict[Kind, Any], pattern: Any) -> None:
    for handle in kept.values():
        _release(handle, pattern)


def _release(handle: Any, pattern: Any) -> None:
    empty = np.zeros(1)
    _call_pardiso(handle, pattern, handle.mtype, _RELEASE, empty, empty, empty)


class SuperLU:
    """scipy's own sparse LU: always there, 20 to 30 times slower."""

    def __init__(self, pattern: Pattern) -> None:
        self.pattern = pattern
        self._factor: Any = None

    def begin_anew(self) -> None:
        """See `LinearSolver`: no factor depends on the one before."""

    def factorise(self, system: System) -> None:
        self._factor = None
        if not np.all(np.isfinite(system.values)):
            raise FactorisationError("the tangent is not finite")
        options = {"SymmetricMode": True} if self.pattern.symmetric else {}
        try:
            self._factor = splu(csc_array(system.matrix()), permc_spec="MMD_AT_PLUS_A", options=options)
        except RuntimeError as error:
            raise FactorisationError(str(error)) from error

    def solve(self, right_hand_side: Array) -> Array:
        solution: Array = self._factor.solve(np.ascontiguousarray(right_hand_side))
        return solution

    def solve_exactly(self, right_hand_side: Array) -> Array:
        return self.solve(right_hand_side)


_warned = False


def _warn_slow() -> None:
    global _warned
    if not _warned:
        _warned = True
        text = "pypardiso is not installed: scipy's sparse solver is used, 20 to 30 times slower; pip install pypardiso"
        warnings.warn(text, RuntimeWarning, stacklevel=3)
