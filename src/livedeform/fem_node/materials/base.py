"""The interface of a material to the solver, and the kernels that several materials share.

A material is split into a part of the size of the shear modulus, evaluated at every quadrature point (``response``),
and a volumetric part U(theta) of the size of the bulk modulus, whose volume measure theta(F) the element may average
or project (that is what keeps nearly incompressible elements from locking).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.fem_node.element.simd import LANES, collect, gather, load, n_blocks, rows_of, scatter, store, work_array
from livedeform.fem_node.materials.volume import JACOBIAN, VolumeMeasure


class Response(Protocol):
    """psi (n,), P (n, 3, 3) and, unless it is None, the tangent A of the shear part at F (n, 3, 3); ``factor`` (n,)
    multiplies the modulus. All three are overwritten. The elements of A are side by side, (e / LANES, q, 9, 9, LANES)
    with n = e q: kernels write it as it is, others as `fem_node.element.simd.side_by_side` of (n, 9, 9)."""

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
    """Return ln theta, undefined where a trial step has turned an element inside out: such a step is turned down."""
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
    """Return the response of W(I1, I2), I1 = J^-2/3 tr C, I2 = J^-4/3 (tr^2 C - tr C^2)/2 (Holzapfel 2000, sec.
    6.4)."""

    def response(F: Array, factor: Array, psi: Array, P: Array, A: Array | None) -> None:
        f, p, (a, q) = F.reshape(-1), P.reshape(-1), in_blocks(A)
        J, t, s = np.empty((3, len(F)))
        _traces(f, J, t, s)
        with np.errstate(divide="ignore"):
            j = np.abs(J) ** (-2.0 / 3.0)
        # turned inside out: no energy is low enough to go there
        w = law(np.where(J > 0.0, j * t, np.inf), np.where(J > 0.0, j * j * s, np.inf))
        psi[:] = factor * w.W
        if w.W2 is None and w.W11 is None:
            _first_invariant(f, factor * w.W1 * j, t, p, a, q)
            return
        W1, W2, W11, W12, W22 = (
            np.zeros(len(F)) if x is None else factor * x for x in (w.W1, w.W2, w.W11, w.W12, w.W22)
        )
        _both_invariants(f, j, t, s, W1, W2, W11, W12, W22, p, a, q)

    return response


def in_blocks(A: Array | None) -> tuple[Array, int]:
    """Return a flat array for the kernels, empty if no tangent is asked for, and the points of an element."""
    return (np.zeros(0), 1) if A is None else (A.reshape(-1), A.shape[1])


@njit(inline="always")
def inverse_transpose(f, T):
    """Compute T = F^-T of eight points, f and T (9 LANES,); return J."""
    for i in range(3):
        j, k = 3 * ((i + 1) % 3), 3 * ((i + 2) % 3)
        for I in range(3):
            J, K = (I + 1) % 3, (I + 2) % 3
            cofactor = load(f, (j + J) * LANES) * load(f, (k + K) * LANES)
            cofactor = cofactor - load(f, (j + K) * LANES) * load(f, (k + J) * LANES)
            store(T, (3 * i + I) * LANES, cofactor)
    J = load(f, 0) * load(T, 0) + load(f, LANES) * load(T, LANES) + load(f, 2 * LANES) * load(T, 2 * LANES)
    d = 1.0 / J
    for m in range(9):
        store(T, m * LANES, d * load(T, m * LANES))
    return J


@njit(inline="always")
def product(x, i, y, j, stride):
    """Return sum_m x_(i + m stride) y_(j + m stride) of eight points, m = 0..2; x, y (9 LANES,)."""
    a = load(x, i * LANES) * load(y, j * LANES)
    a = a + load(x, (i + stride) * LANES) * load(y, (j + stride) * LANES)
    return a + load(x, (i + 2 * stride) * LANES) * load(y, (j + 2 * stride) * LANES)


@njit(cache=True, error_model="numpy")
def _traces(F, J, t, s):
    """Return det F, tr C and (tr^2 C - tr C^2)/2, each (n,), of F (9 n,)."""
    rows, f, T = np.empty(LANES, np.int64), work_array(9), work_array(9)
    for block in range(n_blocks(len(J), 1)):
        rows_of(block, len(J), 1, rows)
        collect(F, rows, 9, 0, 9, f)
        scatter(J, rows, 1, 0, inverse_transpose(f, T))
        xx, yy, zz = product(f, 0, f, 0, 3), product(f, 1, f, 1, 3), product(f, 2, f, 2, 3)
        xy, yz, zx = product(f, 0, f, 1, 3), product(f, 1, f, 2, 3), product(f, 2, f, 0, 3)
        scatter(t, rows, 1, 0, xx + yy + zz)
        scatter(s, rows, 1, 0, xx * yy - xy * xy + yy * zz - yz * yz + zz * xx - zx * zx)


@njit(cache=True, error_model="numpy")
def _first_invariant(F, w, t, P, A, q):
    """Compute P = W1 g, A = W1 dg/dF, g = dI1/dF = J^-2/3 (2 F - 2/3 t F^-T); w = W1 J^-2/3, t = tr C (n,)."""
    rows = np.empty(LANES, np.int64)
    f, T, M = work_array(9), work_array(9), work_array(9)
    for block in range(n_blocks(len(w), q)):
        rows_of(block, len(w), q, rows)
        collect(F, rows, 9, 0, 9, f)
        inverse_transpose(f, T)
        m, third = gather(w, rows, 1, 0), gather(t, rows, 1, 0) / 3.0
        for i in range(9):
            x, y = load(f, i * LANES), load(T, i * LANES)
            scatter(P, rows, 9, i, 2.0 * m * (x - third * y))
            store(M, i * LANES, m * (2.0 / 3.0 * third * y - 4.0 / 3.0 * x))
        if len(A) > 0:
            _first_tangent(T, M, m, third, A, block * 81 * LANES)


@njit(inline="always")
def _first_tangent(T, M, m, third, A, at):
    """Compute A = m (2 1 - 4/3 (F T + T F) + 4/9 t T T + 2/3 t T^t), T = F^-T, M = m (2/9 t T - 4/3 F)."""
    for i in range(3):
        for I in range(3):
            x, y = load(M, (3 * i + I) * LANES), load(T, (3 * i + I) * LANES)
            for k in range(3):
                turned = 2.0 * m * third * load(T, (3 * k + I) * LANES)
                for L in range(3):
                    a = x * load(T, (3 * k + L) * LANES) + y * load(M, (3 * k + L) * LANES)
                    store(A, at, a + turned * load(T, (3 * i + L) * LANES))
                    at += LANES
    for n in range(9):
        place = at - (81 - 10 * n) * LANES
        store(A, place, load(A, place) + 2.0 * m)


@njit(cache=True, error_model="numpy")
def _both_invariants(F, j, t, s, W1, W2, W11, W12, W22, P, A, q):
    """Compute P = W1 g1 + W2 g2, g1 = j (2 F - 2/3 t T), g2 = j^2 (N - 4/3 s T), N = 2 (t F - F C), T = F^-T, j =
    J^-2/3."""
    rows = np.empty(LANES, np.int64)
    f, T, N, C, B, g1, g2 = work_array(63).reshape(7, -1)
    for block in range(n_blocks(len(t), q)):
        rows_of(block, len(t), q, rows)
        collect(F, rows, 9, 0, 9, f)
        inverse_transpose(f, T)
        jj, tt, ss = gather(j, rows, 1, 0), gather(t, rows, 1, 0), gather(s, rows, 1, 0)
        w1, w2 = gather(W1, rows, 1, 0), gather(W2, rows, 1, 0)
        for i in range(3):
            for k in range(3):
                store(C, (3 * i + k) * LANES, product(f, i, f, k, 3))
                store(B, (3 * i + k) * LANES, product(f, 3 * i, f, 3 * k, 1))
        for i in range(3):
            for I in range(3):
                m = (3 * i + I) * LANES
                n = 2.0 * (tt * load(f, m) - product(f, 3 * i, C, 3 * I, 1))
                a = jj * (2.0 * load(f, m) - 2.0 / 3.0 * tt * load(T, m))
                b = jj * jj * (n - 4.0 / 3.0 * ss * load(T, m))
                store(N, m, n)
                store(g1, m, a)
                store(g2, m, b)
                scatter(P, rows, 9, 3 * i + I, w1 * a + w2 * b)
        if len(A) > 0:
            at = block * 81 * LANES
            _second_tangent(f, T, N, C, B, jj * w1, jj * jj * w2, tt, ss, A, at)
            w11, w12, w22 = gather(W11, rows, 1, 0), gather(W12, rows, 1, 0), gather(W22, rows, 1, 0)
            _add_mixed(g1, g2, w11, w12, w22, A, at)


@njit(inline="always")
def _second_tangent(f, T, N, C, B, w1, w2, t, s, A, at):
    """Compute A = w1 dg1/dF + w2 dg2/dF, the powers of J in w1 and w2."""
    for i in range(3):
        for I in range(3):
            m = (3 * i + I) * LANES
            for k in range(3):
                for L in range(3):
                    n = (3 * k + L) * LANES
                    crossed = load(T, (3 * i + L) * LANES) * load(T, (3 * k + I) * LANES)
                    straight = load(T, m) * load(T, n)
                    h1 = t * (4.0 / 9.0 * straight + 2.0 / 3.0 * crossed)
                    h1 = h1 - 4.0 / 3.0 * (load(f, m) * load(T, n) + load(T, m) * load(f, n))
                    h2 = s * (16.0 / 9.0 * straight + 4.0 / 3.0 * crossed)
                    h2 = h2 - 4.0 / 3.0 * (load(N, m) * load(T, n) + load(T, m) * load(N, n))
                    h2 = h2 + 4.0 * load(f, m) * load(f, n)
                    h2 = h2 - 2.0 * load(f, (3 * i + L) * LANES) * load(f, (3 * k + I) * LANES)
                    if i == k:
                        h2 = h2 - 2.0 * load(C, (3 * L + I) * LANES)
                    if I == L:
                        h2 = h2 - 2.0 * load(B, (3 * i + k) * LANES)
                    if i == k and I == L:
                        h1 = h1 + 2.0
                        h2 = h2 + 2.0 * t
                    store(A, at, w1 * h1 + w2 * h2)
                    at += LANES


@njit(inline="always")
def _add_mixed(g1, g2, w11, w12, w22, A, at):
    """Compute A += W11 g1 g1 + W12 (g1 g2 + g2 g1) + W22 g2 g2."""
    for m in range(9):
        a = w11 * load(g1, m * LANES) + w12 * load(g2, m * LANES)
        b = w12 * load(g1, m * LANES) + w22 * load(g2, m * LANES)
        for n in range(9):
            store(A, at, load(A, at) + a * load(g1, n * LANES) + b * load(g2, n * LANES))
            at += LANES
