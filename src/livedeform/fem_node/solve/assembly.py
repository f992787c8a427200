"""The system of equations: a fixed sparsity pattern, and blocks that are added straight into it.

Only the upper triangle is stored while every item's tangent is symmetric (that is what the Cholesky solver takes).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, tril

from livedeform.common.compiled import njit
from livedeform.common.types import Array

Indices = NDArray[np.int64]
Positions = NDArray[np.int32]

MOST_PATTERNS = 2  # that are kept: some 50 MB each on a mesh of 1800 vertices


class Pattern:
    """The tangent's sparsity pattern: ``indptr``, ``indices`` (CSR, sorted, int32, every diagonal present).

    ``groups`` are arrays (m, k) of dofs, each row coupling all its dofs with each other.
    """

    def __init__(self, n_dof: int, groups: Sequence[Indices], *, symmetric: bool = True) -> None:
        self.n_dof, self.symmetric = n_dof, symmetric
        pattern = csr_array((n_dof, n_dof), dtype=np.int8)
        for group in groups:
            k = group.shape[1]
            rows, columns = np.repeat(group, k, axis=1).ravel(), np.tile(group, (1, k)).ravel()
            if symmetric:
                kept = columns >= rows
                rows, columns = rows[kept], columns[kept]
            part = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=pattern.shape).tocsr()
            pattern = pattern + part
        self._take((pattern + csr_array((np.ones(n_dof, np.int8), (range(n_dof), range(n_dof))))).tocsr())

    def _take(self, pattern: csr_array) -> None:
        """Take the entries that a ``pattern`` (n_dof, n_dof) stores."""
        pattern.sort_indices()
        self.indptr, self.indices = pattern.indptr.astype(np.int32), pattern.indices.astype(np.int32)
        self.rows = np.repeat(np.arange(self.n_dof, dtype=np.int32), np.diff(self.indptr))
        self.diagonal = np.flatnonzero(self.rows == self.indices)
        self._positions: dict[bytes, Positions] = {}  # by what tells the dofs apart

    def whole(self) -> tuple[Pattern, Indices]:
        """Return the pattern with both triangles, and where each of its entries is stored in this one (nnz,)."""
        numbers = csr_array((np.arange(1, self.nnz + 1), self.indices, self.indptr), shape=(self.n_dof, self.n_dof))
        if self.symmetric:
            numbers = (numbers + tril(numbers.T, -1)).tocsr()
        out = Pattern(self.n_dof, (), symmetric=False)
        out._take(numbers)
        return out, numbers.data - 1

    @property
    def nnz(self) -> int:
        """The number of stored entries."""
        return len(self.indices)

    def positions(self, dofs: Indices) -> Positions:
        """Return where the blocks of ``dofs`` (m, k) go: (m, k, k) indices into the values, -1 for what is not
        stored. They are kept, and not to be written to."""
        key = _told_apart_by([dofs])
        if key not in self._positions:
            out = np.empty((*dofs.shape, dofs.shape[1]), np.int32)
            _find_positions(self.indptr, self.indices, dofs, self.symmetric, out)
            self._positions[key] = out
        return self._positions[key]

    def touching(self, dofs: Indices) -> Indices:
        """Return the stored entries in the rows and columns of ``dofs``."""
        held = np.zeros(self.n_dof, bool)
        held[dofs] = True
        return np.flatnonzero(held[self.rows] | held[self.indices])


def pattern_of(n_dof: int, groups: Sequence[Indices], *, symmetric: bool = True) -> Pattern:
    """Return the pattern of the ``groups``; of the last few, which many bodies on one mesh share, the same one."""
    key = n_dof, symmetric, _told_apart_by(groups)
    pattern = _patterns.pop(key, None) or Pattern(n_dof, groups, symmetric=symmetric)
    _patterns[key] = pattern  # the latest last
    for old in list(_patterns)[:-MOST_PATTERNS]:
        _patterns.pop(old, None)
    return pattern


_patterns: dict[tuple[int, bool, bytes], Pattern] = {}


def _told_apart_by(arrays: Sequence[Indices]) -> bytes:
    """Return what arrays of the same shapes and numbers have in common, and others do not."""
    told = hashlib.blake2b(repr([(a.shape, a.dtype.str) for a in arrays]).encode())
    for a in arrays:
        told.update(np.ascontiguousarray(a).data)
    return told.digest()


class Feedback(NamedTuple):
    """Blocks (m, k, k) N/m at ``dofs`` (m, k) of a tangent, not symmetric."""

    dofs: Indices
    blocks: Array


class System:
    """A residual ``r`` (n_dof,) and the ``values`` (nnz,) of the tangent in ``pattern``.

    ``safe``: items leave out what can make their tangent indefinite (far from equilibrium, the way still leads
    downhill).
    """

    def __init__(self, pattern: Pattern) -> None:
        self.pattern, self.safe = pattern, False
        self.r = np.zeros(pattern.n_dof)
        self.values = np.zeros(pattern.nnz)

    def clear(self, *, tangent: bool) -> None:
        """Set everything to zero."""
        self.r[:] = 0.0
        if tangent:
            self.values[:] = 0.0

    def add_blocks(self, positions: Positions, blocks: Array) -> None:
        """Add blocks (m, k, k) at ``positions`` to the tangent."""
        _add_blocks(self.values, positions, blocks)

    def add_vectors(self, dofs: Indices, vectors: Array) -> None:
        """Add vectors (m, k) at ``dofs`` to the residual."""
        add_vectors(self.r, dofs, vectors)

    def times(self, v: Array) -> Array:
        """Return the tangent times ``v`` (n_dof,) or (n_dof, k)."""
        p = self.pattern
        stored = csr_array((self.values, p.indices, p.indptr), shape=(p.n_dof, p.n_dof))
        upper: Array = stored @ v
        diagonal = (self.values[p.diagonal] * v.T).T
        return upper + (stored.T @ v - diagonal) if p.symmetric else upper

    def matrix(self) -> csr_array:
        """Return the tangent as a full scipy matrix (for tests and the scipy solver)."""
        p = self.pattern
        stored = csr_array((self.values, p.indices, p.indptr), shape=(p.n_dof, p.n_dof))
        if not p.symmetric:
            return stored
        lower = stored.T.tocsr()
        lower.setdiag(0.0)
        return (stored + lower).tocsr()


def node_dofs(nodes: Indices) -> Indices:
    """Return dofs (m, 3 k) of nodes (m, k): node by node, x y z."""
    return (3 * nodes[..., None] + np.arange(3)).reshape(len(nodes), -1)


@njit(cache=True)
def _find_positions(indptr, indices, dofs, symmetric, out):
    for m in range(dofs.shape[0]):
        for a in range(dofs.shape[1]):
            row = dofs[m, a]
            first, last = indptr[row], indptr[row + 1]
            for b in range(dofs.shape[1]):
                column = dofs[m, b]
                if symmetric and column < row:
                    out[m, a, b] = -1
                    continue
                low, high = first, last
                while low < high:
                    middle = (low + high) // 2
                    if indices[middle] < column:
                        low = middle + 1
                    else:
                        high = middle
                if low == last or indices[low] != column:
                    raise ValueError("a block lies outside the sparsity pattern")
                out[m, a, b] = low


@njit(cache=True)
def _add_blocks(values, positions, blocks):
    for m in range(positions.shape[0]):
        for a in range(positions.shape[1]):
            for b in range(positions.shape[2]):
                place = positions[m, a, b]
                if place >= 0:
                    values[place] += blocks[m, a, b]


@njit(cache=True)
def add_vectors(r, dofs, vectors):
    """Add vectors (m, k) at ``dofs`` to ``r``."""
    for m in range(dofs.shape[0]):
        for a in range(dofs.shape[1]):
            r[dofs[m, a]] += vectors[m, a]
