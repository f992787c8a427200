"""Element integrals: deformation gradients, nodal forces and stiffness.

All of them work in the coordinates xi of the reference tetrahedron, where the slopes d_qa = dN_a/dxi (q, a, 3) are the
same numbers in every element; an element enters with its frames M = dxi/dX (e, q, 3, 3) alone. Weights are (e, q) m3.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.fem_node.element.simd import (
    LANES,
    collect,
    gather,
    load,
    n_blocks,
    rows_of,
    scatter,
    side_by_side,
    spread,
    store,
    work_array,
)
from livedeform.fem_node.solve.assembly import Positions

Entries = NDArray[np.uint32]
Indices = NDArray[np.int64]


def deformation_gradients(u: Array, cells: Indices, slopes: Array, frames: Array, start: Array, F: Array) -> None:
    """F = start + sum_a u_a (x) d_qa M: u (n, 3), start (e, q, 3, 3) or (1, 1, 3, 3), F (e, q, 3, 3)."""
    _deformation_gradients(u.reshape(-1), cells, slopes, frames.reshape(-1), start.reshape(-1), F.reshape(-1))


@njit(cache=True, error_model="numpy")
def _deformation_gradients(u, cells, slopes, frames, start, F):
    n_e, n_a = cells.shape
    n_q = len(slopes)
    elements, rows = np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    U, M = work_array(3 * n_a), work_array(9)
    stride = 9 if len(start) > 9 else 0
    for batch in range(n_blocks(n_e, 1)):
        rows_of(batch, n_e, 1, elements)
        for a in range(n_a):
            for lane in range(LANES):
                rows[lane] = cells[elements[lane], a]
            for i in range(3):
                store(U, (3 * a + i) * LANES, gather(u, rows, 3, i))
        for q in range(n_q):
            rows_of(batch * n_q + q, n_e * n_q, n_q, rows)
            collect(frames, rows, 9, 0, 9, M)
            for i in range(3):
                x, y, z = spread(0.0), spread(0.0), spread(0.0)
                for a in range(n_a):
                    v = load(U, (3 * a + i) * LANES)
                    x, y, z = x + v * slopes[q, a, 0], y + v * slopes[q, a, 1], z + v * slopes[q, a, 2]
                for J in range(3):
                    g = x * load(M, J * LANES) + y * load(M, (3 + J) * LANES) + z * load(M, (6 + J) * LANES)
                    scatter(F, rows, 9, 3 * i + J, gather(start, rows, stride, 3 * i + J) + g)


def determinants(F: Array) -> Array:
    """det F (n,) of F (n, 3, 3)."""
    out = np.empty(len(F))
    _determinants(F.reshape(-1, 9), out)
    return out


@njit(cache=True)
def _determinants(F, out):
    for n in range(len(F)):
        a, b, c, d, e, f, g, h, i = F[n]
        out[n] = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def nodal_forces(P: Array, weights: Array, slopes: Array, frames: Array, out: Array) -> None:
    """out_e,ai = sum_q w P_iJ M_kJ d_qak, with P (e, q, 3, 3), out (e, 3 a)."""
    _nodal_forces(P.reshape(-1), weights.reshape(-1), frames.reshape(-1), slopes, out.reshape(-1))


@njit(cache=True, error_model="numpy")
def _nodal_forces(P, weights, frames, slopes, out):
    n, (n_q, n_a, _) = len(weights), slopes.shape
    rows, M, R = np.empty(LANES, np.int64), work_array(9), work_array(3 * n_a)
    for batch in range(n_blocks(n // n_q, 1)):
        R[:] = 0.0
        for q in range(n_q):
            rows_of(batch * n_q + q, n, n_q, rows)
            collect(frames, rows, 9, 0, 9, M)
            w = gather(weights, rows, 1, 0)
            for i in range(3):
                p0, p1, p2 = gather(P, rows, 9, 3 * i), gather(P, rows, 9, 3 * i + 1), gather(P, rows, 9, 3 * i + 2)
                x, y, z = (
                    w * _dot(p0, p1, p2, M, 0),
                    w * _dot(p0, p1, p2, M, 3 * LANES),
                    w * _dot(p0, p1, p2, M, 6 * LANES),
                )
                for a in range(n_a):
                    at = (3 * a + i) * LANES
                    r = load(R, at) + x * slopes[q, a, 0] + y * slopes[q, a, 1] + z * slopes[q, a, 2]
                    store(R, at, r)
        rows_of(batch, n // n_q, 1, rows)
        for m in range(3 * n_a):
            scatter(out, rows, 3 * n_a, m, load(R, m * LANES))


def upper_positions(positions: Positions) -> tuple[Entries, Positions]:
    """Return where the upper halves of blocks at positions (m, k, k) go, (m / LANES, k (k + 1) / 2, LANES), and the
    lower halves' mirror images, -1 for the diagonal ((0, ...) where the pattern stores one half only)."""
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

    A (e / LANES, q, 9, 9, LANES), symmetric, eight elements side by side, as they are in the processor's registers; c =
    ``vectors`` (e, 3 a), f = ``factors`` (e,); ``upper``, ``lower`` from `upper_positions`.
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
        M, B, T = work_array(9), work_array(54 * n_q), work_array(3 * n_q * n_a)
        C, K = work_array(n), work_array((n * (n + 1)) // 2)
        C[:] = 0.0
        f = spread(0.0)
        for batch in range(len(upper)):
            rows_of(batch, n_e, 1, elements)
            for lane in range(LANES):
                real[lane] = 1.0 if batch * LANES + lane < n_e else 0.0  # the last element counts once
            for q in range(n_q):
                collect(frames, elements, 9 * n_q, 9 * q, 9, M)
                w = load(real, 0) * gather(weights, elements, n_q, q)
                _pull_back(A, 81 * (batch * n_q + q), w, M, B, 9 * q, 9 * n_q)
            if len(factors) > 0:
                f = load(real, 0) * gather(factors, elements, 1, 0)
                collect(vectors, elements, n, 0, n, C)
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
    """Return, in the order in which the kernel finds the numbers, their places in the upper half of an (n, n)
    matrix."""
    place = np.empty((n, n), np.int64)
    p, q = np.triu_indices(n)
    place[p, q] = place[q, p] = np.arange(len(p))
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    return np.concatenate([place[i::3, j::3][np.triu_indices(n // 3) if i == j else ...].ravel() for i, j in pairs])


@njit(inline="always")
def _pull_back(A, start, w, M, B, to, step):
    """B_kl = w M_kI A_IJ M_lJ for each pair of components of the A at ``start``, the results ``step`` vectors apart."""
    for i in range(3):
        for j in range(i, 3):
            for I in range(3):
                at = (start + 9 * (3 * i + I) + 3 * j) * LANES
                x, y, z = w * load(A, at), w * load(A, at + LANES), w * load(A, at + 2 * LANES)
                for l in range(3):
                    store(B, (to + 3 * I + l) * LANES, _dot(x, y, z, M, 3 * l * LANES))
            for l in range(3):
                at = (to + l) * LANES
                x, y, z = load(B, at), load(B, at + 3 * LANES), load(B, at + 6 * LANES)
                for k in range(3):
                    store(B, at + 3 * k * LANES, _dot(x, y, z, M, 3 * k * LANES))
            to += step


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
