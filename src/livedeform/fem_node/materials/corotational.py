"""Corotational Hooke: W = mu |F - R|^2 + lambda/2 (tr U - 3)^2, F = R U, with the exact tangent (Sifakis & Barbic
2012).

For comparison with real-time codes, which use it with an approximate tangent.
"""

from __future__ import annotations

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.element.simd import side_by_side
from livedeform.fem_node.materials.base import Material
from livedeform.fem_node.materials.volume import STRETCH, polar_derivative, polar_rotation
from livedeform.fem_node.physics.record import MaterialSpec


def make(spec: MaterialSpec) -> Material:
    """Take mu and lambda from E and nu."""
    mu = spec.shear_modulus

    def response(F: Array, factor: Array, psi: Array, P: Array, A: Array | None) -> None:
        D = F - polar_rotation(F)
        P[:] = 2.0 * mu * factor[:, None, None] * D
        psi[:] = mu * factor * np.einsum("nij,nij->n", D, D)
        if A is not None:
            A[:] = side_by_side(2.0 * mu * factor[:, None, None] * (np.eye(9) - polar_derivative(F)), A.shape[1])

    lame = spec.bulk_modulus - 2.0 / 3.0 * mu
    return Material("corotational", mu, lame, response, volume=STRETCH, isochoric=False)
