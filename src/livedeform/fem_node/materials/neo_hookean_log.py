"""Neo-Hookean, compressible: W = mu/2 (I1 - 3) - mu ln J + lambda/2 (ln J)^2 (Bonet & Wood 2008, sec. 6.4.3)."""

from __future__ import annotations

import numpy as np

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.fem_node.element.simd import LANES, collect, gather, load, n_blocks, rows_of, scatter, store, work_array
from livedeform.fem_node.materials.base import LOGARITHMIC, Material, in_blocks, inverse_transpose, product
from livedeform.fem_node.physics.record import MaterialSpec


def make(spec: MaterialSpec) -> Material:
    """Take mu and lambda from E and nu."""
    mu = spec.shear_modulus

    def response(F: Array, factor: Array, psi: Array, P: Array, A: Array | None) -> None:
        J, t = np.empty((2, len(F)))
        _response(F.reshape(-1), mu * factor, J, t, P.reshape(-1), *in_blocks(A))
        with np.errstate(invalid="ignore", divide="ignore"):
            psi[:] = np.where(J > 0.0, mu * factor * (0.5 * (t - 3.0) - np.log(J)), np.inf)

    lame = spec.bulk_modulus - 2.0 / 3.0 * mu
    return Material("neo_hookean_log", mu, lame, response, volumetric=LOGARITHMIC, isochoric=False)


@njit(cache=True, error_model="numpy")
def _response(F, mu, J, t, P, A, q):
    """Compute J, t = tr C (n,), P = mu (F - T), A_iJkL = mu (delta_ik delta_JL + T_iL T_kJ), T = F^-T."""
    rows, f, T = np.empty(LANES, np.int64), work_array(9), work_array(9)
    for block in range(n_blocks(len(mu), q)):
        rows_of(block, len(mu), q, rows)
        collect(F, rows, 9, 0, 9, f)
        scatter(J, rows, 1, 0, inverse_transpose(f, T))
        scatter(t, rows, 1, 0, product(f, 0, f, 0, 3) + product(f, 1, f, 1, 3) + product(f, 2, f, 2, 3))
        m, at = gather(mu, rows, 1, 0), block * 81 * LANES
        for i in range(9):
            scatter(P, rows, 9, i, m * (load(f, i * LANES) - load(T, i * LANES)))
        if len(A) == 0:
            continue
        for i in range(3):
            for I in range(3):
                for k in range(3):
                    for L in range(3):
                        a = m * load(T, (3 * i + L) * LANES) * load(T, (3 * k + I) * LANES)
                        if i == k and I == L:
                            a = a + m
                        store(A, at, a)
                        at += LANES
