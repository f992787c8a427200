"""The system of equations: a fixed sparsity pattern and kernels that add element blocks straight into it.

Only the upper triangle is stored while every item's tangent is symmetric (that is what the Cholesky solver takes).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from livedeform_common.types import Array

Indices = NDArray[np.int64]
Positions = NDArray[np.int32]


class Pattern:
    """Where the tangent has entries: ``indptr``, ``indices`` (CSR, sorted, int32, every diagonal present).

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
        pattern = (pattern + csr_array((np.ones(n_dof, np.int8), (range(n_dof), range(n_dof))))).tocsr()
        pattern.sort_indices()
        self.indptr, self.indices = pattern.indptr.astype(np.int32), pattern.indices.astype(np.int32)
        self.rows = np.repeat(np.arange(n_dof, dtype=np.int32), np.diff(self.indptr))
        self.diagonal = np.flatnonzero(self.rows == self.indices)

    @property
    def nnz(self) -> int:
        """Stored entries."""
        return len(self.indices)

    def positions(self, dofs: Indices) -> Positions:
        """Where the blocks of ``dofs`` (m, k) go: (m, k, k) indices into the values, -1 for what is not stored."""
        out = np.empty((*dofs.shape, dofs.shape[1]), np.int32)
        _find_positions(self.indptr, self.indices, dofs, self.symmetric, out)
        return out

    def touching(self, dofs: Indices) -> Indices:
        """The stored entries in the rows and columns of ``dofs``."""
        held = np.zeros(self.n_dof, bool)
        held[dofs] = True
        return np.flatnonzero(held[self.rows] | held[self.indices])


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
        """Zero again."""
        self.r[:] = 0.0
        if tangent:
            self.values[:] = 0.0

    def add_blocks(self, positions: Positions, blocks: Array) -> None:
        """Adds blocks (m, k, k) at ``positions`` to the tangent."""
        _add_blocks(self.values, positions, blocks)

    def add_vectors(self, dofs: Indices, vectors: Array) -> None:
        """Adds vectors (m, k) at ``dofs`` to the residual."""
        _add_vectors(self.r, dofs, vectors)

    def times(self, v: Array) -> Array:
        """The tangent times ``v`` (n_dof,)."""
        p = self.pattern
        stored = csr_array((self.values, p.indices, p.indptr), shape=(p.n_dof, p.n_dof))
        return stored @ v + (stored.T @ v - self.values[p.diagonal] * v if p.symmetric else 0.0)

    def matrix(self) -> csr_array:
        """The tangent as a full scipy matrix (for tests and the scipy solver)."""
        p = self.pattern
        stored = csr_array((self.values, p.indices, p.indptr), shape=(p.n_dof, p.n_dof))
        if not p.symmetric:
            return stored
        lower = stored.T.tocsr()
        lower.setdiag(0.0)
        return (stored + lower).tocsr()


def node_dofs(nodes: Indices) -> Indices:
    """Dofs (m, 3 k) of nodes (m, k): node by node, x y z."""
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
def _add_vectors(r, dofs, vectors):
    for m in range(dofs.shape[0]):
        for a in range(dofs.shape[1]):
            r[dofs[m, a]] += vectors[m, a]


@njit(cache=True, fastmath=True)
def deformation_gradients(u, cells, gradients, start, F):
    """F = start + sum_a u_a (x) dN_a: u (n, 3), gradients (e, q, a, 3), start (e, q, 3, 3) or (1, 1, 3, 3), F (e, q,
    3, 3)."""
    n_e, n_q, n_a, _ = gradients.shape
    same = start.shape[0] == 1
    for e in range(n_e):
        for q in range(n_q):
            s = start[0, 0] if same else start[e, q]
            f00, f01, f02 = s[0, 0], s[0, 1], s[0, 2]
            f10, f11, f12 = s[1, 0], s[1, 1], s[1, 2]
            f20, f21, f22 = s[2, 0], s[2, 1], s[2, 2]
            for a in range(n_a):
                node = cells[e, a]
                gx, gy, gz = gradients[e, q, a, 0], gradients[e, q, a, 1], gradients[e, q, a, 2]
                ux, uy, uz = u[node, 0], u[node, 1], u[node, 2]
                f00 += ux * gx
                f01 += ux * gy
                f02 += ux * gz
                f10 += uy * gx
                f11 += uy * gy
                f12 += uy * gz
                f20 += uz * gx
                f21 += uz * gy
                f22 += uz * gz
            F[e, q, 0, 0], F[e, q, 0, 1], F[e, q, 0, 2] = f00, f01, f02
            F[e, q, 1, 0], F[e, q, 1, 1], F[e, q, 1, 2] = f10, f11, f12
            F[e, q, 2, 0], F[e, q, 2, 1], F[e, q, 2, 2] = f20, f21, f22


@njit(cache=True, fastmath=True)
def add_forces(P, weights, cells, gradients, r):
    """r_ai += sum_q w P_iJ dN_a,J, with P (e, q, 3, 3)."""
    n_e, n_q, n_a, _ = gradients.shape
    for e in range(n_e):
        for q in range(n_q):
            w = weights[e, q]
            p = P[e, q]
            for a in range(n_a):
                gx, gy, gz = w * gradients[e, q, a, 0], w * gradients[e, q, a, 1], w * gradients[e, q, a, 2]
                place = 3 * cells[e, a]
                r[place] += p[0, 0] * gx + p[0, 1] * gy + p[0, 2] * gz
                r[place + 1] += p[1, 0] * gx + p[1, 1] * gy + p[1, 2] * gz
                r[place + 2] += p[2, 0] * gx + p[2, 1] * gy + p[2, 2] * gz


def upper_positions(positions: Positions) -> tuple[Positions, Positions]:
    """Of blocks' positions (m, k, k): where their upper halves go, (m, k (k + 1) / 2), and the lower halves' mirror
    images ((0, 0) where the pattern stores one half only)."""
    p, q = np.triu_indices(positions.shape[1])
    upper, lower = positions[:, p, q], positions[:, q, p]
    if np.any(positions < 0):
        return np.ascontiguousarray(np.maximum(upper, lower)), np.zeros((0, 0), np.int32)
    return np.ascontiguousarray(upper), np.ascontiguousarray(np.where(p == q, -1, lower))


def add_stiffness(A, weights, gradients, rank_one, rank_one_factor, upper, lower, values) -> None:
    """K_aibj += sum_q w dN_a,J A_iJjL dN_b,L + k_e c_ai c_bj, straight into the stored ``values``.

    A (e, q, 9, 9), symmetric; c (e, 3 a), k (e,) (zeros: none); ``upper``, ``lower`` from `upper_positions`.
    """
    kernel = _stiffness_kernel(gradients.shape[2])
    kernel(A, weights, gradients, rank_one, rank_one_factor, upper, lower, values)


@lru_cache
def _stiffness_kernel(n_a: int):
    """The kernel for elements of ``n_a`` nodes: a constant, so that the inner loops become vector instructions."""
    n = 3 * n_a

    @njit(cache=True, fastmath=True)
    def kernel(A, weights, gradients, rank_one, rank_one_factor, upper, lower, values):
        n_e, n_q = weights.shape
        block = np.empty((3, 3, n_a, n_a))
        G, T = np.empty((3, n_a)), np.empty((3, n_a))
        half = np.empty((n * (n + 1)) // 2)
        for e in range(n_e):
            block[:] = 0.0
            for q in range(n_q):
                w = weights[e, q]
                for a in range(n_a):
                    for I in range(3):
                        G[I, a] = gradients[e, q, a, I]
                for i in range(3):
                    for j in range(i, 3):
                        for I in range(3):
                            row = A[e, q, 3 * i + I]
                            x, y, z = w * row[3 * j], w * row[3 * j + 1], w * row[3 * j + 2]
                            for b in range(n_a):
                                T[I, b] = x * G[0, b] + y * G[1, b] + z * G[2, b]
                        part = block[i, j]
                        for a in range(n_a):
                            x, y, z = G[0, a], G[1, a], G[2, a]
                            for b in range(n_a):
                                part[a, b] += x * T[0, b] + y * T[1, b] + z * T[2, b]
            k = rank_one_factor[e]
            m = 0
            for a in range(n_a):
                for i in range(3):
                    c = k * rank_one[e, 3 * a + i]
                    for j in range(i, 3):
                        half[m] = block[i, j, a, a] + c * rank_one[e, 3 * a + j]
                        m += 1
                    for b in range(a + 1, n_a):
                        for j in range(3):
                            stiffness = block[i, j, a, b] if i <= j else block[j, i, b, a]
                            half[m] = stiffness + c * rank_one[e, 3 * b + j]
                            m += 1
            for m in range(len(half)):
                values[upper[e, m]] += half[m]
            if lower.shape[0] > 0:
                for m in range(len(half)):
                    if lower[e, m] >= 0:
                        values[lower[e, m]] += half[m]

    return kernel
