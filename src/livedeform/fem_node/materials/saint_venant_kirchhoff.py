"""Saint-Venant-Kirchhoff: W = mu E:E + lambda/2 (tr E)^2, E = (F^T F - I)/2. For comparison: it collapses under
pressure."""

from __future__ import annotations

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.element.simd import side_by_side
from livedeform.fem_node.materials.base import Material
from livedeform.fem_node.materials.volume import GREEN_STRAIN
from livedeform.fem_node.physics.record import MaterialSpec


def make(spec: MaterialSpec) -> Material:
    """Take mu and lambda from E and nu."""
    mu = spec.shear_modulus

    def response(F: Array, factor: Array, psi: Array, P: Array, A: Array | None) -> None:
        E = 0.5 * (F.transpose(0, 2, 1) @ F - np.eye(3))
        m = 2.0 * mu * factor[:, None, None]
        P[:] = m * (F @ E)
        psi[:] = mu * factor * np.einsum("nij,nij->n", E, E)
        if A is not None:
            I = np.eye(3)
            B = F @ F.transpose(0, 2, 1)
            full = np.einsum("ik,nLJ->niJkL", I, E)
            full += 0.5 * (np.einsum("niL,nkJ->niJkL", F, F) + np.einsum("nik,JL->niJkL", B, I))
            A[:] = side_by_side(m * full.reshape(-1, 9, 9), A.shape[1])

    lame = spec.bulk_modulus - 2.0 / 3.0 * mu
    return Material("saint_venant_kirchhoff", mu, lame, response, volume=GREEN_STRAIN, isochoric=False)
