"""Element integrals: deformation gradients, nodal forces and stiffness.

All of them work in the coordinates xi of the reference tetrahedron, where the slopes d_qa = dN_a/dxi (q, a, 3) are the
same numbers in every element; an element enters with its frames M = dxi/dX (e, q, 3, 3) alone. Weights are (e, q) m3.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fem_node.assembly import Positions
from fem_node.lanes import LANES, gather, load, rows_of, side_by_side, spread, store
from livedeform_common.types import Array

Entries = NDArray[np.uint32]
PAIRS = [(i, j) for i in range(3) for j in range(i, 3)]  # of the components that a symmetric stiffness couples


@njit(cache=True, fastmath=True)
def deformation_gradients(u, cells, slopes, frames, start, F):
    """F = start + sum_a u_a (x) d_qa M: u (n, 3), start (e, q, 3, 3) or (1, 1, 3, 3), F (e, q, 3, 3)."""
    n_e, n_q = frames.shape[:2]
    same = start.shape[0] == 1
    h = np.empty((3, 3))
    for e in range(n_e):
        for q in range(n_q):
            h[:] = 0.0
            for a in range(cells.shape[1]):
                node = cells[e, a]
                for i in range(3):
                    for k in range(3):
                        h[i, k] += u[node, i] * slopes[q, a, k]
            s, m, f = start[0, 0] if same else start[e, q], frames[e, q], F[e, q]
            for i in range(3):
                for J in range(3):
                    f[i, J] = s[i, J] + h[i, 0] * m[0, J] + h[i, 1] * m[1, J] + h[i, 2] * m[2, J]


@njit(cache=True, fastmath=True)
def nodal_forces(P, weights, slopes, frames, out):
    """out_e,ai = sum_q w P_iJ M_kJ d_qak, with P (e, q, 3, 3), out (e, 3 a)."""
    h = np.empty((3, 3))
    for e in range(frames.shape[0]):
        out[e] = 0.0
        for q in range(frames.shape[1]):
            p, m, w = P[e, q], frames[e, q], weights[e, q]
            for i in range(3):
                for k in range(3):
                    h[i, k] = w * (p[i, 0] * m[k, 0] + p[i, 1] * m[k, 1] + p[i, 2] * m[k, 2])
            for a in range(slopes.shape[1]):
                x, y, z = slopes[q, a, 0], slopes[q, a, 1], slopes[q, a, 2]
                for i in range(3):
                    out[e, 3 * a + i] += h[i, 0] * x + h[i, 1] * y + h[i, 2] * z


def upper_positions(positions: Positions) -> tuple[Entries, Positions]:
    """Of blocks' positions (m, k, k): where their upper halves go, (m / LANES, k (k + 1) / 2, LANES), and the lower
    halves' mirror images, -1 for the diagonal ((0, ...) where the pattern stores one half only)."""
    p, q = np.triu_indices(positions.shape[1])
    upper, lower = side_by_side(positions[:, p, q]), side_by_side(positions[:, q, p])
    if np.any(positions < 0):
        return np.maximum(upper, lower).astype(np.uint32), lower[:0]
    return upper.astype(np.uint32), np.where((p == q)[:, None], -1, lower)


def add_stiffness(
    A: Array,
    weights: Array,
    slopes: Array,
    frames: Array,
    vectors: Array,
    factors: Array,
    upper: Entries,
    lower: Positions,
    values: Array,
) -> None:
    """K_aibj += sum_q w d_ak M_kJ A_iJjL M_lL d_bl + f_e c_ai c_bj, straight into the stored ``values``.

    A (e q, 9, 9), symmetric; c = ``vectors`` (e, 3 a), f = ``factors`` (e,); ``upper``, ``lower`` from
    `upper_positions`. Eight elements at a time, side by side in vector registers.
    """
    n_q, n_a, _ = slopes.shape
    flat = (array.reshape(-1) for array in (A, weights, frames, vectors))
    _stiffness_kernel(n_q, n_a)(*flat, factors, slopes, upper, lower, values)


@lru_cache
def _stiffness_kernel(n_q: int, n_a: int):
    """The kernel for elements of ``n_a`` nodes and ``n_q`` points: constants, so that the inner loops are unrolled.

    Work arrays hold vectors of LANES numbers: M (3, 3) a point's frame, C (3 a,) the vectors c,
    B (pair, q, 3, 3) is A in the reference tetrahedron, T (q, 3, a) a pair's part of it times the slopes, K the upper
    half of the stiffness.
    """
    n = 3 * n_a
    slots = _slots(n)

    @njit(cache=True, error_model="numpy")
    def kernel(A, weights, frames, vectors, factors, slopes, upper, lower, values):
        n_e = len(weights) // n_q
        elements, real = np.empty(LANES, np.int64), np.ones(LANES)
        M, C = np.empty(9 * LANES), np.zeros(n * LANES)
        B, T = np.empty(54 * n_q * LANES), np.empty(3 * n_q * n_a * LANES)
        K = np.empty((n * (n + 1)) // 2 * LANES)
        f = spread(0.0)
        for batch in range(len(upper)):
            rows_of(batch, n_e, elements)
            for lane in range(LANES):
                real[lane] = 1.0 if batch * LANES + lane < n_e else 0.0  # the last element counts once
            for q in range(n_q):
                _collect(frames, elements, 9 * n_q, 9 * q, 9, M)
                _pull_back(A, load(real, 0) * gather(weights, elements, n_q, q), elements, n_q, q, M, B)
            if len(factors) > 0:
                f = load(real, 0) * gather(factors, elements, 1, 0)
                _collect(vectors, elements, n, 0, n, C)
            pair, done = 0, 0
            for i in range(3):
                for j in range(i, 3):
                    for q in range(n_q):
                        _times_slopes(B, 9 * (n_q * pair + q), slopes, q, n_a, T)
                    for a in range(n_a):
                        c = f * load(C, (3 * a + i) * LANES)
                        for b in range(a if i == j else 0, n_a):
                            k = c * load(C, (3 * b + j) * LANES)
                            for q in range(n_q):
                                for m in range(3):
                                    k = k + slopes[q, a, m] * load(T, ((3 * q + m) * n_a + b) * LANES)
                            store(K, slots[done] * LANES, k)
                            done += 1
                    pair += 1
            _scatter(K, upper, lower, batch, values)

    return kernel


def _slots(n: int) -> NDArray[np.int64]:
    """In the order in which the kernel finds the numbers: their places in the upper half of an (n, n) matrix."""
    place = np.empty((n, n), np.int64)
    p, q = np.triu_indices(n)
    place[p, q] = place[q, p] = np.arange(len(p))
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    return np.concatenate([place[i::3, j::3][np.triu_indices(n // 3) if i == j else ...].ravel() for i, j in pairs])


@njit(inline="always")
def _collect(array, elements, stride, at, n, out):
    """``n`` numbers of each element, from ``at`` on, side by side."""
    for m in range(n):
        store(out, m * LANES, gather(array, elements, stride, at + m))


@njit(inline="always")
def _pull_back(A, w, elements, n_q, q, M, B):
    """B_kl = w M_kI A_IJ M_lJ of point ``q``, for each pair of components."""
    to = 9 * q * LANES
    for i in range(3):
        for j in range(i, 3):
            for I in range(3):
                at = 81 * q + 9 * (3 * i + I) + 3 * j
                x = w * gather(A, elements, 81 * n_q, at)
                y = w * gather(A, elements, 81 * n_q, at + 1)
                z = w * gather(A, elements, 81 * n_q, at + 2)
                for l in range(3):
                    store(B, to + (3 * I + l) * LANES, _dot(x, y, z, M, 3 * l * LANES))
            for l in range(3):
                at = to + l * LANES
                x, y, z = load(B, at), load(B, at + 3 * LANES), load(B, at + 6 * LANES)
                for k in range(3):
                    store(B, at + 3 * k * LANES, _dot(x, y, z, M, 3 * k * LANES))
            to += 9 * n_q * LANES


@njit(inline="always")
def _dot(x, y, z, row, at):
    """x, y, z times the three vectors of ``row`` from ``at`` on."""
    return x * load(row, at) + y * load(row, at + LANES) + z * load(row, at + 2 * LANES)


@njit(inline="always")
def _times_slopes(B, at, slopes, q, n_a, T):
    """T_kb = B_kl d_bl."""
    for k in range(3):
        x, y, z = load(B, at * LANES), load(B, (at + 1) * LANES), load(B, (at + 2) * LANES)
        at += 3
        for b in range(n_a):
            t = slopes[q, b, 0] * x + slopes[q, b, 1] * y + slopes[q, b, 2] * z
            store(T, ((3 * q + k) * n_a + b) * LANES, t)


@njit(inline="always")
def _scatter(K, upper, lower, batch, values):
    """Adds the upper halves where they belong, and their mirror images where those are stored."""
    for m in range(upper.shape[1]):
        for lane in range(LANES):
            values[upper[batch, m, lane]] += K[m * LANES + lane]
    if len(lower) > 0:
        for m in range(upper.shape[1]):
            for lane in range(LANES):
                if lower[batch, m, lane] >= 0:
                    values[lower[batch, m, lane]] += K[m * LANES + lane]
