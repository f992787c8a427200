"""Measures of volume change theta(F), with c = dtheta/dF and D = dc/dF; theta = 1 at rest."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.fem_node.element.simd import (
    LANES,
    collect,
    gather,
    load,
    n_blocks,
    rows_of,
    side_by_side,
    store,
    work_array,
)


class VolumeMeasure(Protocol):
    """A volume measure; F (n, 3, 3)."""

    def measure(self, F: Array, theta: Array, c: Array) -> None:
        """Overwrite theta (n,) and c (n, 3, 3)."""
        ...

    def add_tangent(self, F: Array, p: Array, k: Array, c: Array, A: Array) -> None:
        """Compute A += p D + k c (x) c, with p, k (n,) Pa; A as a material writes it (`materials.base.Response`)."""
        ...


def add_pressure(p: Array, c: Array, P: Array) -> None:
    """Compute P += p c, with p (n,) Pa."""
    _add_pressure(p, c, P)


def add_outer(k: Array, c: Array, A: Array) -> None:
    """Compute A += k c (x) c, with k (n,) Pa, zero where an element averages its volume."""
    if np.any(k):
        _add_outer(k, c.reshape(-1), A.reshape(-1), A.shape[1])


class Jacobian:
    """theta = det F, c = cof F: large strain."""

    def measure(self, F: Array, theta: Array, c: Array) -> None:
        _cofactor(F, theta, c)

    def add_tangent(self, F: Array, p: Array, k: Array, c: Array, A: Array) -> None:
        _add_cofactor(F.reshape(-1), p, A.reshape(-1), A.shape[1])
        add_outer(k, c, A)


class SmallStrain:
    """theta = 1 + tr(F - I): c = I, D = 0."""

    def measure(self, F: Array, theta: Array, c: Array) -> None:
        theta[:] = np.trace(F, axis1=1, axis2=2) - 2.0
        c[:] = np.eye(3)

    def add_tangent(self, F: Array, p: Array, k: Array, c: Array, A: Array) -> None:
        add_outer(k, c, A)


class GreenStrain:
    """theta = 1 + tr E, E = (F^T F - I)/2: c = F, D = identity."""

    def measure(self, F: Array, theta: Array, c: Array) -> None:
        theta[:] = 0.5 * np.einsum("nij,nij->n", F, F) - 0.5
        c[:] = F

    def add_tangent(self, F: Array, p: Array, k: Array, c: Array, A: Array) -> None:
        add_outer(k, c, A)
        A += side_by_side(p[:, None, None] * np.eye(9), A.shape[1])


class Stretch:
    """theta = tr U - 2, F = R U: c = R, D = dR/dF."""

    def measure(self, F: Array, theta: Array, c: Array) -> None:
        c[:] = polar_rotation(F)
        theta[:] = np.einsum("nij,nij->n", c, F) - 2.0

    def add_tangent(self, F: Array, p: Array, k: Array, c: Array, A: Array) -> None:
        add_outer(k, c, A)
        A += side_by_side(p[:, None, None] * polar_derivative(F), A.shape[1])


JACOBIAN, SMALL_STRAIN, GREEN_STRAIN, STRETCH = Jacobian(), SmallStrain(), GreenStrain(), Stretch()


def polar_rotation(F: Array) -> Array:
    """Return R (n, 3, 3) of F = R U, det R = 1."""
    V, _, Wt = np.linalg.svd(F)
    V = V.copy()
    V[:, :, 2] *= np.sign(np.linalg.det(V @ Wt))[:, None]
    return np.asarray(V @ Wt)


def polar_derivative(F: Array) -> Array:
    """Return dR/dF (n, 9, 9): with F = V S W^T, (V^T dR W)_ij = (V^T dF W - (V^T dF W)^T)_ij / (s_i + s_j)."""
    V, s, Wt = np.linalg.svd(F)
    flip = np.sign(np.linalg.det(V @ Wt))
    V, s = V.copy(), s.copy()
    V[:, :, 2] *= flip[:, None]
    s[:, 2] *= flip
    D = np.zeros((len(F), 9, 9))
    for a, b in ((0, 1), (0, 2), (1, 2)):
        spin = np.einsum("ni,nj->nij", V[:, :, a], Wt[:, b]) - np.einsum("ni,nj->nij", V[:, :, b], Wt[:, a])
        spin = spin.reshape(-1, 9)
        D += spin[:, :, None] * spin[:, None, :] / (s[:, a] + s[:, b])[:, None, None]
    return D


@njit(cache=True, fastmath=True)
def _cofactor(F, theta, c):
    for n in range(F.shape[0]):
        f, o = F[n], c[n]
        o[0, 0] = f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1]
        o[0, 1] = f[1, 2] * f[2, 0] - f[1, 0] * f[2, 2]
        o[0, 2] = f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0]
        o[1, 0] = f[0, 2] * f[2, 1] - f[0, 1] * f[2, 2]
        o[1, 1] = f[0, 0] * f[2, 2] - f[0, 2] * f[2, 0]
        o[1, 2] = f[0, 1] * f[2, 0] - f[0, 0] * f[2, 1]
        o[2, 0] = f[0, 1] * f[1, 2] - f[0, 2] * f[1, 1]
        o[2, 1] = f[0, 2] * f[1, 0] - f[0, 0] * f[1, 2]
        o[2, 2] = f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0]
        theta[n] = f[0, 0] * o[0, 0] + f[0, 1] * o[0, 1] + f[0, 2] * o[0, 2]


@njit(cache=True)
def _add_cofactor(F, p, A, q):
    """Compute A += p D, D_iI,kL = eps_ikm eps_ILN F_mN; F (9 n,), p (n,), A flat."""
    rows, f = np.empty(LANES, np.int64), work_array(9)
    for block in range(n_blocks(len(p), q)):
        rows_of(block, len(p), q, rows)
        collect(F, rows, 9, 0, 9, f)
        pressure, at = gather(p, rows, 1, 0), block * 81 * LANES
        for i in range(3):
            j, m = (i + 1) % 3, (i + 2) % 3
            for I in range(3):
                K, L = (I + 1) % 3, (I + 2) % 3
                row = at + 9 * (3 * i + I) * LANES
                _add(A, row + (3 * j + K) * LANES, pressure * load(f, (3 * m + L) * LANES))
                _add(A, row + (3 * m + L) * LANES, pressure * load(f, (3 * j + K) * LANES))
                _add(A, row + (3 * j + L) * LANES, -1.0 * pressure * load(f, (3 * m + K) * LANES))
                _add(A, row + (3 * m + K) * LANES, -1.0 * pressure * load(f, (3 * j + L) * LANES))


@njit(inline="always")
def _add(A, at, lanes):
    store(A, at, load(A, at) + lanes)


@njit(cache=True)
def _add_outer(k, c, A, q):
    """Compute A += k c (x) c; k (n,), c (9 n,), A flat."""
    rows, o = np.empty(LANES, np.int64), work_array(9)
    for block in range(n_blocks(len(k), q)):
        rows_of(block, len(k), q, rows)
        collect(c, rows, 9, 0, 9, o)
        factor, at = gather(k, rows, 1, 0), block * 81 * LANES
        for m in range(9):
            x = factor * load(o, m * LANES)
            for n in range(9):
                _add(A, at, x * load(o, n * LANES))
                at += LANES


@njit(cache=True, fastmath=True)
def _add_pressure(p, c, P):
    for n in range(P.shape[0]):
        for i in range(3):
            for I in range(3):
                P[n, i, I] += p[n] * c[n, i, I]
