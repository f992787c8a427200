"""Hooke's law at small strain: W = mu dev(eps):dev(eps) + K/2 (tr eps)^2, eps = sym(F - I). For comparison: it does
not turn."""

from __future__ import annotations

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.element.simd import side_by_side
from livedeform.fem_node.materials.base import Material
from livedeform.fem_node.materials.volume import SMALL_STRAIN
from livedeform.fem_node.physics.record import MaterialSpec

_I = np.eye(3)
_SYMMETRIC = 0.5 * (np.einsum("ik,JL->iJkL", _I, _I) + np.einsum("iL,Jk->iJkL", _I, _I))
_DEVIATOR = (_SYMMETRIC - np.einsum("iJ,kL->iJkL", _I, _I) / 3.0).reshape(9, 9)


def make(spec: MaterialSpec) -> Material:
    """Take mu and K from E and nu."""
    mu = spec.shear_modulus

    def response(F: Array, factor: Array, psi: Array, P: Array, A: Array | None) -> None:
        H = (F - _I).reshape(-1, 9)
        strain = H @ _DEVIATOR
        P[:] = (2.0 * mu * factor[:, None] * strain).reshape(-1, 3, 3)
        psi[:] = mu * factor * np.einsum("nm,nm->n", strain, strain)
        if A is not None:
            A[:] = side_by_side(2.0 * mu * factor[:, None, None] * _DEVIATOR, A.shape[1])

    return Material("linear", mu, spec.bulk_modulus, response, volume=SMALL_STRAIN)
