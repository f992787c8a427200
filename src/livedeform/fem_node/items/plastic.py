"""Plastic set: isochoric plastic Hencky strain h_p = fraction (1 - threshold/|h|) h at the largest Hencky strain h so
far.

h = dev(1/2 ln F^T F) of the deformation from the unloaded shape, |h| its Frobenius norm; Fp = exp(h_p), F_e = F Fp^-1.

Where a strain outgrows an earlier one of another direction, the set turns at once, and the strain may fall below the
earlier one again: no equilibrium has either set. What has outgrown it stays, as it would on a path in small steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livedeform.common.compiled import njit
from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import PlasticSet

LEAST_STRETCH = 1e-12  # squared: of an element that a search has turned inside out
MOST_SWEEPS, ROUND_OFF = 12, 1e-17  # of rotations, of which four or five are usual; of the largest number


@dataclass(frozen=True)
class SetState:
    """Hencky strains (n, 3, 3): the ``largest`` that is committed, and what the present moment has ``reached`` so far;
    ``inverse`` (n, 3, 3): Fp^-1 in force."""

    largest: Array
    reached: Array
    inverse: Array


def unstrained(n: int) -> SetState:
    """Return a state in which nothing has been strained yet."""
    return SetState(np.zeros((n, 3, 3)), np.zeros((n, 3, 3)), np.broadcast_to(np.eye(3), (n, 3, 3)).copy())


def hencky(F: Array) -> Array:
    """Return dev(1/2 ln F^T F) (n, 3, 3); `ConvergenceError` where a search has led to no deformation at all."""
    if not np.all(np.isfinite(F)):
        raise ConvergenceError(
            "a strain is not finite", where="solver", remedy="move the body in smaller steps, or refine the mesh"
        )
    out = np.empty(F.shape)
    _log_strains(F, out)
    return out


def strained(state: SetState, h: Array) -> Array:
    """Return what is reached (n, 3, 3) as an iteration comes by the strains ``h`` (n, 3, 3)."""
    grows = np.einsum("nij,nij->n", h, h) > np.einsum("nij,nij->n", state.largest, state.largest)
    return np.where(grows[:, None, None], h, state.reached)


def inverse_set(law: PlasticSet, largest: Array) -> Array:
    """Return Fp^-1 = exp(-h_p) (n, 3, 3)."""
    size = np.sqrt(np.einsum("nij,nij->n", largest, largest))
    share = law.fraction * np.maximum(1.0 - law.threshold / np.maximum(size, 1e-300), 0.0)
    out = np.empty(largest.shape)
    _exponentials(largest, -share, out)
    return out


@njit(cache=True)
def _log_strains(F, out):
    """Finds dev(1/2 ln F^T F) of deformations ``F`` (n, 3, 3)."""
    C, vectors, logs = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for k in range(len(F)):
        for i in range(3):
            for j in range(3):
                C[i, j] = F[k, 0, i] * F[k, 0, j] + F[k, 1, i] * F[k, 1, j] + F[k, 2, i] * F[k, 2, j]
        _diagonalise(C, vectors)
        mean = 0.0
        for i in range(3):
            logs[i] = 0.5 * np.log(max(C[i, i], LEAST_STRETCH))
            mean += logs[i] / 3.0
        for i in range(3):
            logs[i] -= mean
        _compose(vectors, logs, out[k])


@njit(cache=True)
def _exponentials(matrices, factors, out):
    """Finds exp(factor x matrix) of symmetric ``matrices`` (n, 3, 3)."""
    A, vectors, values = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for k in range(len(matrices)):
        for i in range(3):
            for j in range(3):
                A[i, j] = factors[k] * matrices[k, i, j]
        _diagonalise(A, vectors)
        for i in range(3):
            values[i] = np.exp(A[i, i])
        _compose(vectors, values, out[k])


@njit(cache=True)
def _compose(vectors, values, out):
    """Sums value v v^T over the columns v of the ``vectors`` (3, 3)."""
    for i in range(3):
        for j in range(i + 1):
            total = 0.0
            for k in range(3):
                total += vectors[i, k] * values[k] * vectors[j, k]
            out[i, j] = out[j, i] = total


@njit(cache=True)
def _diagonalise(A, vectors):
    """Turns a symmetric ``A`` (3, 3) to its eigenvalues on the diagonal, with the eigenvectors as columns, by Jacobi's
    rotations (Golub & Van Loan, Matrix Computations, 8.5)."""
    scale = 0.0
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
            scale = max(scale, abs(A[i, j]))
    for _ in range(MOST_SWEEPS):
        if max(abs(A[0, 1]), abs(A[0, 2]), abs(A[1, 2])) <= ROUND_OFF * scale:
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if A[p, q] == 0.0:
                    continue
                theta = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
                t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                A[p, p], A[q, q] = A[p, p] - t * A[p, q], A[q, q] + t * A[p, q]
                A[p, q] = A[q, p] = 0.0
                r = 3 - p - q
                A[r, p], A[r, q] = c * A[r, p] - s * A[r, q], s * A[r, p] + c * A[r, q]
                A[p, r], A[q, r] = A[r, p], A[r, q]
                for k in range(3):
                    one, other = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = c * one - s * other, s * one + c * other
