"""Neo-Hookean, compressible: W = mu/2 (I1 - 3) - mu ln J + lambda/2 (ln J)^2 (Bonet & Wood 2008, sec. 6.4.3)."""

from __future__ import annotations

import numpy as np
from numba import njit

from fem_node.materials.base import LOGARITHMIC, Material, inverse_transpose
from fem_node.physics import MaterialSpec
from livedeform_common.types import Array

_NONE = np.zeros((0, 9, 9))


def make(spec: MaterialSpec) -> Material:
    """mu and lambda from E and nu."""
    mu = spec.shear_modulus

    def response(F: Array, factor: Array, psi: Array, P: Array, A: Array | None) -> None:
        _response(F, mu * factor, psi, P, _NONE if A is None else A)

    lame = spec.bulk_modulus - 2.0 / 3.0 * mu
    return Material("neo_hookean_log", mu, lame, response, volumetric=LOGARITHMIC, isochoric=False)


@njit(cache=True, error_model="numpy")
def _response(F, mu, psi, P, A):
    """P = mu (F - F^-T), A_iJkL = mu (delta_ik delta_JL + F^-T_iL F^-T_kJ)."""
    T = np.empty((3, 3))
    for n in range(F.shape[0]):
        J = inverse_transpose(F[n], T)
        trace = 0.0
        for i in range(3):
            for I in range(3):
                trace += F[n, i, I] ** 2
                P[n, i, I] = mu[n] * (F[n, i, I] - T[i, I])
        psi[n] = mu[n] * (0.5 * (trace - 3.0) - np.log(J)) if J > 0.0 else np.inf
        if A.shape[0] == 0:
            continue
        for i in range(3):
            for I in range(3):
                for k in range(3):
                    for L in range(3):
                        A[n, 3 * i + I, 3 * k + L] = mu[n] * T[i, L] * T[k, I]
        for m in range(9):
            A[n, m, m] += mu[n]
