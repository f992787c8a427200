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
from numba import njit

from fem_node.materials.base import inverse_transpose
from fem_node.physics import Prony
from livedeform_common.types import Array

_NONE = np.zeros((0, 9, 9))


@dataclass(frozen=True)
class Overstress:
    """History of n points and k terms: ``S`` (n, 3, 3) and ``Q`` (k, n, 3, 3), Pa; the committed moment's."""

    S: Array
    Q: Array


@dataclass(frozen=True)
class Step:
    """What a step of length dt does: ``amplification`` of the relaxed response and the constant ``H`` (n, 3, 3)."""

    amplification: float
    H: Array | None
    decay: Array
    weight: Array


def relaxed(n: int, prony: Prony) -> Overstress:
    """No stress, no history."""
    return Overstress(np.zeros((n, 3, 3)), np.zeros((len(prony.g), n, 3, 3)))


def begin(prony: Prony, state: Overstress, dt: float) -> Step:
    """The step of length ``dt`` s from the committed state."""
    tau, beta = np.array(prony.tau), np.array(prony.g) / (1.0 - sum(prony.g))
    if np.isinf(dt):
        return Step(1.0, None, np.zeros(len(tau)), np.zeros(len(tau)))
    x = dt / tau
    decay = np.exp(-x)
    weight = beta * np.where(x > 1e-8, -np.expm1(-x) / np.maximum(x, 1e-300), 1.0 - 0.5 * x)
    H = np.tensordot(decay, state.Q, axes=1) - weight.sum() * state.S
    return Step(1.0 + float(weight.sum()), H, decay, weight)


def end(step: Step, state: Overstress, S: Array) -> Overstress:
    """The history with the relaxed stress ``S`` (n, 3, 3) of the accepted solution."""
    if step.H is None:
        return Overstress(S, np.zeros_like(state.Q))
    change = S - state.S
    return Overstress(S, step.decay[:, None, None, None] * state.Q + step.weight[:, None, None, None] * change)


def isochoric_stress(F: Array, P: Array) -> Array:
    """S = J^2/3 DEV(F^-1 P) (n, 3, 3) of a first Piola-Kirchhoff stress."""
    S = np.linalg.solve(F, P)
    C = F.transpose(0, 2, 1) @ F
    S = S - (np.einsum("nij,nij->n", S, C) / 3.0)[:, None, None] * np.linalg.inv(C)
    S = 0.5 * (S + S.transpose(0, 2, 1))
    return np.cbrt(np.linalg.det(F) ** 2)[:, None, None] * S


def add_finite(H: Array, F: Array, psi: Array, P: Array, A: Array | None) -> None:
    """Adds 1/2 H : Cbar and its derivatives, Cbar = J^-2/3 F^T F."""
    _add_finite(H, F, psi, P, _NONE if A is None else A)


def add_small(H: Array, F: Array, psi: Array, P: Array, A: Array | None) -> None:
    """Adds H : eps, small strain."""
    psi += np.einsum("nij,nij->n", H, F - np.eye(3))
    P += H


@njit(cache=True, fastmath=True, error_model="numpy")
def _add_finite(H, F, psi, P, A):
    """P = j (F H - s/3 T), s = H : C, j = J^-2/3, T = F^-T, and its derivative."""
    T, M = np.empty((3, 3)), np.empty((3, 3))
    for n in range(F.shape[0]):
        f, h = F[n], H[n]
        J = abs(inverse_transpose(f, T))
        j = J ** (-2.0 / 3.0)
        s = 0.0
        for i in range(3):
            for I in range(3):
                M[i, I] = f[i, 0] * h[0, I] + f[i, 1] * h[1, I] + f[i, 2] * h[2, I]
                s += M[i, I] * f[i, I]
        psi[n] += 0.5 * j * s
        for i in range(3):
            for I in range(3):
                P[n, i, I] += j * (M[i, I] - s / 3.0 * T[i, I])
        if A.shape[0] == 0:
            continue
        for i in range(3):
            for I in range(3):
                for k in range(3):
                    for L in range(3):
                        a = -2.0 / 3.0 * (M[i, I] * T[k, L] + T[i, I] * M[k, L])
                        a += s * (2.0 / 9.0 * T[i, I] * T[k, L] + T[i, L] * T[k, I] / 3.0)
                        if i == k:
                            a += h[I, L]
                        A[n, 3 * i + I, 3 * k + L] += j * a
