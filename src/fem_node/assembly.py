"""The system of equations: a fixed sparsity pattern and kernels that add element blocks straight into it.

Only the upper triangle is stored while every item's tangent is symmetric (that is what the Cholesky solver takes).
"""

from __future__ import annotations

from collections.abc import Sequence

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

    ``safe``: items leave out what can make their tangent indefinite (far from equilibrium, the way still leads downhill).
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
    """F = start + sum_a u_a (x) dN_a: u (n, 3), gradients (e, q, a, 3), start (e, q, 3, 3) or (1, 1, 3, 3), F (e, q, 3, 3)."""
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


@njit(cache=True, fastmath=True)
def add_stiffness(A, weights, gradients, rank_one, rank_one_factor, positions, values):
    """K_aibj += sum_q w dN_a,J A_iJjL dN_b,L + k_e c_ai c_bj, straight into the stored ``values``.

    A (e, q, 9, 9), symmetric; c (e, 3 a), k (e,) (zeros: none); positions (e, 3 a, 3 a), -1 where not stored.
    """
    n_e, n_q, n_a, _ = gradients.shape
    block = np.empty((3 * n_a, 3 * n_a))
    AG = np.empty((9, 3))
    for e in range(n_e):
        k = rank_one_factor[e]
        for a in range(3 * n_a):
            for b in range(3 * n_a):
                block[a, b] = k * rank_one[e, a] * rank_one[e, b]
        for q in range(n_q):
            w = weights[e, q]
            Aq = A[e, q]
            G = gradients[e, q]
            for b in range(n_a):
                gx, gy, gz = w * G[b, 0], w * G[b, 1], w * G[b, 2]
                for m in range(9):
                    for j in range(3):
                        AG[m, j] = Aq[m, 3 * j] * gx + Aq[m, 3 * j + 1] * gy + Aq[m, 3 * j + 2] * gz
                for a in range(b + 1):
                    hx, hy, hz = G[a, 0], G[a, 1], G[a, 2]
                    for i in range(3):
                        for j in range(3):
                            block[3 * a + i, 3 * b + j] += (
                                hx * AG[3 * i, j] + hy * AG[3 * i + 1, j] + hz * AG[3 * i + 2, j]
                            )
        for a in range(n_a):
            for b in range(n_a):
                for i in range(3):
                    for j in range(3):
                        place = positions[e, 3 * a + i, 3 * b + j]
                        if place >= 0:
                            if a <= b:
                                values[place] += block[3 * a + i, 3 * b + j]
                            else:
                                values[place] += block[3 * b + j, 3 * a + i]
