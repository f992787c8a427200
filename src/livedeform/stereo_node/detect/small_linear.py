"""Small symmetric positive definite systems, compiled."""

from __future__ import annotations

from livedeform.common.compiled import njit


@njit(cache=True)
def copy_part(source, target):
    """Copy the upper left part of ``source`` that fits. Assigning slices takes seconds to compile."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@njit(cache=True, fastmath=True, error_model="numpy")
def solve_spd(A, b, x):
    """Solve A x = b for a symmetric positive definite A, which is overwritten; False if it is not."""
    n = b.size
    for i in range(n):
        x[i] = b[i]
    for j in range(n):  # A = U^T D U, from the upper triangle
        if not A[j, j] > 1e-14:
            return False
        per_d = 1.0 / A[j, j]
        for i in range(j + 1, n):
            share = A[j, i] * per_d
            for k in range(i, n):
                A[i, k] -= share * A[j, k]
            x[i] -= share * x[j]
        A[j, j] = per_d
    for j in range(n - 1, -1, -1):
        for k in range(j + 1, n):
            x[j] -= A[j, k] * x[k]
        x[j] *= A[j, j]
    return True
