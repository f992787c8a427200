"""What a material is for the solver, and the kernels that several materials share.

A material is split into a part of the size of the shear modulus, evaluated at every quadrature point (``response``),
and a volumetric part U(theta) of the size of the bulk modulus, whose volume measure theta(F) the element may average
or project (that is what keeps nearly incompressible elements from locking).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit

from fem_node.materials.volume import JACOBIAN, VolumeMeasure
from livedeform_common.types import Array


class Response(Protocol):
    """psi (n,), P (n, 3, 3) and, unless it is None, the tangent A (n, 9, 9) of the shear part at F (n, 3, 3);
    ``factor`` (n,) multiplies the modulus. All three are overwritten."""

    def __call__(self, F: Array, factor: Array, psi: Array, P: Array, A: Array | None) -> None: ...


@dataclass(frozen=True)
class Volumetric:
    """U(theta) per unit of the bulk modulus: value, first and second derivative, and the inverse of U'."""

    value: Callable[[Array], Array]
    slope: Callable[[Array], Array]
    curvature: Callable[[Array], Array]


QUADRATIC = Volumetric(
    value=lambda theta: 0.5 * (theta - 1.0) ** 2,
    slope=lambda theta: theta - 1.0,
    curvature=lambda theta: np.ones_like(theta),
)


def _log(theta: Array) -> Array:
    """ln theta, undefined where a trial step has turned an element inside out: such a step is turned down."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.log(theta)


LOGARITHMIC = Volumetric(
    value=lambda theta: 0.5 * _log(theta) ** 2,
    slope=lambda theta: _log(theta) / theta,
    curvature=lambda theta: (1.0 - _log(theta)) / theta**2,
)


@dataclass(frozen=True)
class Material:
    """A material with its constants in.

    ``shear`` Pa: the small-strain shear modulus; ``bulk`` Pa: the coefficient of U (K or Lame's lambda, as the model
    says); ``isochoric``: the response depends on J^-1/3 F only, or on the deviator of small strain.
    """

    name: str
    shear: float
    bulk: float
    response: Response
    volume: VolumeMeasure = JACOBIAN
    volumetric: Volumetric = QUADRATIC
    isochoric: bool = True


@dataclass(frozen=True)
class Invariants:
    """W and its derivatives with respect to the isochoric invariants, each (n,) Pa; None means zero everywhere."""

    W: Array
    W1: Array
    W2: Array | None = None
    W11: Array | None = None
    W12: Array | None = None
    W22: Array | None = None


def invariant_response(law: Callable[[Array, Array], Invariants]) -> Response:
    """The response of W(I1, I2), I1 = J^-2/3 tr C, I2 = J^-4/3 (tr^2 C - tr C^2)/2 (Holzapfel 2000, sec. 6.4)."""

    def response(F: Array, factor: Array, psi: Array, P: Array, A: Array | None) -> None:
        I1, I2 = np.empty(len(F)), np.empty(len(F))
        _invariants(F, I1, I2)
        w = law(I1, I2)
        psi[:] = factor * w.W
        if w.W2 is None and w.W11 is None:
            _first_invariant(F, factor * w.W1, P, _NONE if A is None else A)
            return
        W1, W2, W11, W12, W22 = (
            np.zeros(len(F)) if t is None else factor * t for t in (w.W1, w.W2, w.W11, w.W12, w.W22)
        )
        _both_invariants(F, W1, W2, W11, W12, W22, P, _NONE if A is None else A)

    return response


_NONE = np.zeros((0, 9, 9))


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def inverse_transpose(F, T):
    """T = F^-T; returns J."""
    c00 = F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1]
    c01 = F[1, 2] * F[2, 0] - F[1, 0] * F[2, 2]
    c02 = F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0]
    J = F[0, 0] * c00 + F[0, 1] * c01 + F[0, 2] * c02
    d = 1.0 / J
    T[0, 0], T[0, 1], T[0, 2] = c00 * d, c01 * d, c02 * d
    T[1, 0] = (F[0, 2] * F[2, 1] - F[0, 1] * F[2, 2]) * d
    T[1, 1] = (F[0, 0] * F[2, 2] - F[0, 2] * F[2, 0]) * d
    T[1, 2] = (F[0, 1] * F[2, 0] - F[0, 0] * F[2, 1]) * d
    T[2, 0] = (F[0, 1] * F[1, 2] - F[0, 2] * F[1, 1]) * d
    T[2, 1] = (F[0, 2] * F[1, 0] - F[0, 0] * F[1, 2]) * d
    T[2, 2] = (F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]) * d
    return J


@njit(cache=True, error_model="numpy")
def _invariants(F, I1, I2):
    T = np.empty((3, 3))
    for n in range(F.shape[0]):
        f = F[n]
        J = inverse_transpose(f, T)
        if not J > 0.0:  # turned inside out: no energy is low enough to go there
            I1[n], I2[n] = np.inf, np.inf
            continue
        trace, square = 0.0, 0.0
        for I in range(3):
            for K in range(3):
                c = f[0, I] * f[0, K] + f[1, I] * f[1, K] + f[2, I] * f[2, K]
                square += c * c
                if I == K:
                    trace += c
        j = J ** (-2.0 / 3.0)
        I1[n], I2[n] = j * trace, 0.5 * j * j * (trace * trace - square)


@njit(cache=True, fastmath=True, error_model="numpy")
def _first_invariant(F, W1, P, A):
    """P = W1 g, A = W1 dg/dF with g = dI1/dF = J^-2/3 (2 F - 2/3 (F:F) F^-T)."""
    T = np.empty((3, 3))
    for n in range(F.shape[0]):
        f = F[n]
        J = abs(inverse_transpose(f, T))
        w = W1[n] * J ** (-2.0 / 3.0)
        t = 0.0
        for i in range(3):
            for I in range(3):
                t += f[i, I] * f[i, I]
        for i in range(3):
            for I in range(3):
                P[n, i, I] = 2.0 * w * (f[i, I] - t / 3.0 * T[i, I])
        if A.shape[0] == 0:
            continue
        a, b, c = -4.0 / 3.0 * w, 4.0 / 9.0 * t * w, 2.0 / 3.0 * t * w
        for i in range(3):
            for I in range(3):
                for k in range(3):
                    for L in range(3):
                        A[n, 3 * i + I, 3 * k + L] = (
                            a * (f[i, I] * T[k, L] + T[i, I] * f[k, L]) + b * T[i, I] * T[k, L] + c * T[i, L] * T[k, I]
                        )
        for m in range(9):
            A[n, m, m] += 2.0 * w


@njit(cache=True, fastmath=True, error_model="numpy")
def _both_invariants(F, W1, W2, W11, W12, W22, P, A):
    """P = W1 g1 + W2 g2; A = W1 dg1 + W2 dg2 + W11 g1 g1 + W12 (g1 g2 + g2 g1) + W22 g2 g2."""
    T, M, B, C = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    g1, g2 = np.empty((3, 3)), np.empty((3, 3))
    for n in range(F.shape[0]):
        f = F[n]
        J = abs(inverse_transpose(f, T))
        j = J ** (-2.0 / 3.0)
        t, s = 0.0, 0.0
        for I in range(3):
            for K in range(3):
                C[I, K] = f[0, I] * f[0, K] + f[1, I] * f[1, K] + f[2, I] * f[2, K]
                B[I, K] = f[I, 0] * f[K, 0] + f[I, 1] * f[K, 1] + f[I, 2] * f[K, 2]
                s += C[I, K] * C[I, K]
            t += C[I, I]
        s = 0.5 * (t * t - s)
        for i in range(3):
            for I in range(3):
                M[i, I] = 2.0 * (t * f[i, I] - f[i, 0] * C[0, I] - f[i, 1] * C[1, I] - f[i, 2] * C[2, I])
                g1[i, I] = j * (2.0 * f[i, I] - 2.0 / 3.0 * t * T[i, I])
                g2[i, I] = j * j * (M[i, I] - 4.0 / 3.0 * s * T[i, I])
                P[n, i, I] = W1[n] * g1[i, I] + W2[n] * g2[i, I]
        if A.shape[0] == 0:
            continue
        w1, w2 = j * W1[n], j * j * W2[n]
        for i in range(3):
            for I in range(3):
                for k in range(3):
                    for L in range(3):
                        h1 = -4.0 / 3.0 * (f[i, I] * T[k, L] + T[i, I] * f[k, L])
                        h1 += 4.0 / 9.0 * t * T[i, I] * T[k, L] + 2.0 / 3.0 * t * T[i, L] * T[k, I]
                        h2 = 4.0 * f[i, I] * f[k, L] - 2.0 * f[i, L] * f[k, I]
                        h2 += -4.0 / 3.0 * (M[i, I] * T[k, L] + T[i, I] * M[k, L])
                        h2 += 16.0 / 9.0 * s * T[i, I] * T[k, L] + 4.0 / 3.0 * s * T[i, L] * T[k, I]
                        if i == k:
                            h2 -= 2.0 * C[L, I]
                        if I == L:
                            h2 -= 2.0 * B[i, k]
                        if i == k and I == L:
                            h1 += 2.0
                            h2 += 2.0 * t
                        A[n, 3 * i + I, 3 * k + L] = (
                            w1 * h1
                            + w2 * h2
                            + W11[n] * g1[i, I] * g1[k, L]
                            + W12[n] * (g1[i, I] * g2[k, L] + g2[i, I] * g1[k, L])
                            + W22[n] * g2[i, I] * g2[k, L]
                        )
