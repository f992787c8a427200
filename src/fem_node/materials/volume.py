"""Measures of volume change theta(F), with c = dtheta/dF and D = dc/dF; theta = 1 at rest."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numba import njit

from livedeform_common.types import Array


class VolumeMeasure(Protocol):
    """A volume measure; F (n, 3, 3)."""

    def measure(self, F: Array, theta: Array, c: Array) -> None:
        """Overwrites theta (n,) and c (n, 3, 3)."""
        ...

    def add_tangent(self, F: Array, p: Array, k: Array, c: Array, A: Array) -> None:
        """A += p D + k c (x) c, with p, k (n,) Pa."""
        ...


def add_pressure(p: Array, c: Array, P: Array) -> None:
    """P += p c, with p (n,) Pa."""
    _add_pressure(p, c, P)


class Jacobian:
    """theta = det F, c = cof F: large strain."""

    def measure(self, F: Array, theta: Array, c: Array) -> None:
        _cofactor(F, theta, c)

    def add_tangent(self, F: Array, p: Array, k: Array, c: Array, A: Array) -> None:
        _add_cofactor(F, p, k, c, A)


class SmallStrain:
    """theta = 1 + tr(F - I): c = I, D = 0."""

    def measure(self, F: Array, theta: Array, c: Array) -> None:
        theta[:] = np.trace(F, axis1=1, axis2=2) - 2.0
        c[:] = np.eye(3)

    def add_tangent(self, F: Array, p: Array, k: Array, c: Array, A: Array) -> None:
        _add_outer(k, c, A)


class GreenStrain:
    """theta = 1 + tr E, E = (F^T F - I)/2: c = F, D = identity."""

    def measure(self, F: Array, theta: Array, c: Array) -> None:
        theta[:] = 0.5 * np.einsum("nij,nij->n", F, F) - 0.5
        c[:] = F

    def add_tangent(self, F: Array, p: Array, k: Array, c: Array, A: Array) -> None:
        _add_outer(k, c, A)
        A += p[:, None, None] * np.eye(9)


class Stretch:
    """theta = tr U - 2, F = R U: c = R, D = dR/dF."""

    def measure(self, F: Array, theta: Array, c: Array) -> None:
        c[:] = polar_rotation(F)
        theta[:] = np.einsum("nij,nij->n", c, F) - 2.0

    def add_tangent(self, F: Array, p: Array, k: Array, c: Array, A: Array) -> None:
        _add_outer(k, c, A)
        A += p[:, None, None] * polar_derivative(F)


JACOBIAN, SMALL_STRAIN, GREEN_STRAIN, STRETCH = Jacobian(), SmallStrain(), GreenStrain(), Stretch()


def polar_rotation(F: Array) -> Array:
    """R (n, 3, 3) of F = R U, det R = 1."""
    V, _, Wt = np.linalg.svd(F)
    V = V.copy()
    V[:, :, 2] *= np.sign(np.linalg.det(V @ Wt))[:, None]
    return V @ Wt


def polar_derivative(F: Array) -> Array:
    """dR/dF (n, 9, 9): with F = V S W^T, (V^T dR W)_ij = (V^T dF W - (V^T dF W)^T)_ij / (s_i + s_j)."""
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


@njit(cache=True, fastmath=True)
def _add_cofactor(F, p, k, c, A):
    """D_iI,kL = eps_ikm eps_ILN F_mN."""
    for n in range(F.shape[0]):
        f, o, q = F[n], c[n], p[n]
        if k[n] != 0.0:
            for i in range(3):
                for I in range(3):
                    for m in range(3):
                        for L in range(3):
                            A[n, 3 * i + I, 3 * m + L] += k[n] * o[i, I] * o[m, L]
        for i in range(3):
            j, m = (i + 1) % 3, (i + 2) % 3
            for I in range(3):
                K, L = (I + 1) % 3, (I + 2) % 3
                A[n, 3 * i + I, 3 * j + K] += q * f[m, L]
                A[n, 3 * i + I, 3 * m + L] += q * f[j, K]
                A[n, 3 * i + I, 3 * j + L] -= q * f[m, K]
                A[n, 3 * i + I, 3 * m + K] -= q * f[j, L]


@njit(cache=True, fastmath=True)
def _add_pressure(p, c, P):
    for n in range(P.shape[0]):
        for i in range(3):
            for I in range(3):
                P[n, i, I] += p[n] * c[n, i, I]


@njit(cache=True, fastmath=True)
def _add_outer(k, c, A):
    for n in range(A.shape[0]):
        for i in range(9):
            for j in range(9):
                A[n, i, j] += k[n] * c[n, i // 3, i % 3] * c[n, j // 3, j % 3]
