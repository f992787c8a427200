"""Finite-strain viscoelasticity: an isochoric Prony series on top of the relaxed material (Simo 1987; Simo & Hughes
1998, 10.3).

With S the isochoric second Piola-Kirchhoff stress of the relaxed material, pulled back by J^2/3 (so that DEV S = S),
each term carries an overstress Q_i with dQ_i/dt + Q_i/tau_i = beta_i dS/dt, beta_i = g_i / (1 - sum g). For S linear
in time over the step dt, exactly:

    Q_i(n+1) = exp(-dt/tau_i) Q_i(n) + beta_i a_i (S(n+1) - S(n)),     a_i = (1 - exp(-dt/tau_i)) tau_i / dt.

So the step has the potential (1 + sum beta_i a_i) psi + 1/2 H : Cbar with the constant H = sum exp(-dt/tau_i) Q_i(n) -
beta_i a_i S(n): symmetric, and solved like an elastic body. dt = inf: relaxed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.fem_node.element.simd import LANES, collect, gather, load, n_blocks, rows_of, scatter, store, work_array
from livedeform.fem_node.materials.base import in_blocks, inverse_transpose, product
from livedeform.fem_node.physics.record import Prony

SHARE_OF_TAU = 0.25  # of the shortest relaxation time, that steps may be long where stress begins to fade
MOST_LONGER = 2.0  # than the step before, that one may be without being cut: input whose intervals scatter is not


@dataclass(frozen=True)
class Overstress:
    """History of n points and k terms: ``S`` (n, 3, 3) and ``Q`` (k, n, 3, 3), Pa; the committed moment's."""

    S: Array
    Q: Array


@dataclass(frozen=True)
class Step:
    """The effect of a step of length dt: ``amplification`` of the relaxed response and the constant ``H`` (n, 3, 3)."""

    amplification: float
    H: Array | None
    decay: Array
    weight: Array


def relaxed(n: int, prony: Prony) -> Overstress:
    """Return a state without stress and history."""
    return Overstress(np.zeros((n, 3, 3)), np.zeros((len(prony.g), n, 3, 3)))


def begin(prony: Prony, state: Overstress, dt: float) -> Step:
    """Return the step of length ``dt`` s from the committed state."""
    tau, beta = np.array(prony.tau), np.array(prony.g) / (1.0 - sum(prony.g))
    if np.isinf(dt):
        return Step(1.0, None, np.zeros(len(tau)), np.zeros(len(tau)))
    x = dt / tau
    decay = np.exp(-x)
    weight = beta * np.where(x > 1e-8, -np.expm1(-x) / np.maximum(x, 1e-300), 1.0 - 0.5 * x)
    H = np.tensordot(decay, state.Q, axes=1) - weight.sum() * state.S
    return Step(1.0 + float(weight.sum()), H, decay, weight)


def longest_step(prony: Prony | None, dt: float) -> float:
    """Return how long (s) the next step may be that is as good as those of a run of the whole, after one of ``dt`` s
    (0, inf: something has just changed); inf where nothing relaxes."""
    if prony is None:
        return np.inf
    return max(SHARE_OF_TAU * min(prony.tau), MOST_LONGER * dt if np.isfinite(dt) else 0.0)


def end(step: Step, state: Overstress, S: Array) -> Overstress:
    """Return the history with the relaxed stress ``S`` (n, 3, 3) of the accepted solution."""
    if step.H is None:
        return Overstress(S, np.zeros_like(state.Q))
    change = S - state.S
    return Overstress(S, step.decay[:, None, None, None] * state.Q + step.weight[:, None, None, None] * change)


def isochoric_stress(F: Array, P: Array) -> Array:
    """Compute S = J^2/3 DEV(F^-1 P) (n, 3, 3) of a first Piola-Kirchhoff stress."""
    S = np.empty(F.shape)
    _isochoric_stress(F.reshape(-1, 9), P.reshape(-1, 9), S.reshape(-1, 9))
    return S


def add_finite(H: Array, F: Array, psi: Array, P: Array, A: Array | None) -> None:
    """Add 1/2 H : Cbar and its derivatives, Cbar = J^-2/3 F^T F."""
    j, s = np.empty((2, len(F)))
    _measure(H.reshape(-1, 9), F.reshape(-1, 9), j, s)
    psi += 0.5 * j * s
    _add_finite(H.reshape(-1), F.reshape(-1), j, s, P.reshape(-1), *in_blocks(A))


def add_small(H: Array, F: Array, psi: Array, P: Array, A: Array | None) -> None:
    """Add H : eps, small strain."""
    psi += np.einsum("nij,nij->n", H, F - np.eye(3))
    P += H


@njit(cache=True, error_model="numpy")
def _measure(H, F, j, s):
    """Compute j = |J|^-2/3 and s = H : C, each (n,), of symmetric H (n, 9) and F (n, 9)."""
    for n in range(len(F)):
        a, b, c, d, e, f, g, h, i = F[n]
        J = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        j[n] = abs(J) ** (-2.0 / 3.0)
        sides = (
            H[n, 0] * (a * a + d * d + g * g) + H[n, 4] * (b * b + e * e + h * h) + H[n, 8] * (c * c + f * f + i * i)
        )
        between = (
            H[n, 1] * (a * b + d * e + g * h) + H[n, 5] * (b * c + e * f + h * i) + H[n, 2] * (c * a + f * d + i * g)
        )
        s[n] = sides + 2.0 * between


@njit(cache=True, error_model="numpy")
def _isochoric_stress(F, P, S):
    """Compute S = J^2/3 sym(F^-1 P - 1/3 (P : F) C^-1), each (n, 9)."""
    G, M = np.empty(9), np.empty(9)
    for n in range(len(F)):
        a, b, c, d, e, f, g, h, i = F[n]
        G[0], G[1], G[2] = e * i - f * h, c * h - b * i, b * f - c * e
        G[3], G[4], G[5] = f * g - d * i, a * i - c * g, c * d - a * f
        G[6], G[7], G[8] = d * h - e * g, b * g - a * h, a * e - b * d
        J = a * G[0] + b * G[3] + c * G[6]
        G /= J
        third = 0.0
        for m in range(9):
            third += P[n, m] * F[n, m] / 3.0
        for I in range(3):
            for K in range(3):
                M[3 * I + K] = 0.0
                for m in range(3):
                    M[3 * I + K] += G[3 * I + m] * (P[n, 3 * m + K] - third * G[3 * K + m])
        scale = 0.5 * (J * J) ** (1.0 / 3.0)
        for I in range(3):
            for K in range(3):
                S[n, 3 * I + K] = scale * (M[3 * I + K] + M[3 * K + I])


@njit(cache=True, error_model="numpy")
def _add_finite(H, F, j, s, P, A, q):
    """Compute P += j (M - s/3 T), M = F H, s = H : C, j = J^-2/3, T = F^-T, and its derivative."""
    rows = np.empty(LANES, np.int64)
    f, h, T, M = work_array(36).reshape(4, -1)
    for block in range(n_blocks(len(j), q)):
        rows_of(block, len(j), q, rows)
        collect(F, rows, 9, 0, 9, f)
        collect(H, rows, 9, 0, 9, h)
        inverse_transpose(f, T)
        m, third = gather(j, rows, 1, 0), gather(s, rows, 1, 0) / 3.0
        for i in range(3):
            for I in range(3):
                n = 3 * i + I
                stress, y = product(f, 3 * i, h, 3 * I, 1), load(T, n * LANES)  # H is symmetric
                scatter(P, rows, 9, n, gather(P, rows, 9, n) + m * (stress - third * y))
                store(M, n * LANES, m * (third / 3.0 * y - 2.0 / 3.0 * stress))
        if len(A) > 0:
            _add_tangent(T, M, h, m, third, A, block * 81 * LANES)


@njit(inline="always")
def _add_tangent(T, M, h, m, third, A, at):
    """Compute A += m (H - 2/3 (F H T + T F H) + s (2/9 T T + 1/3 T^t)), M = m (s/9 T - 2/3 F H)."""
    for i in range(3):
        for I in range(3):
            x, y = load(M, (3 * i + I) * LANES), load(T, (3 * i + I) * LANES)
            for k in range(3):
                turned = m * third * load(T, (3 * k + I) * LANES)
                for L in range(3):
                    a = x * load(T, (3 * k + L) * LANES) + y * load(M, (3 * k + L) * LANES)
                    a = a + turned * load(T, (3 * i + L) * LANES)
                    if i == k:
                        a = a + m * load(h, (3 * I + L) * LANES)
                    store(A, at, load(A, at) + a)
                    at += LANES
