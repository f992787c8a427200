"""Neo-Hookean, isochoric: W = mu/2 (J^-2/3 I1 - 3) + K/2 (J - 1)^2. The default."""

from __future__ import annotations

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.materials.base import Invariants, Material, invariant_response
from livedeform.fem_node.physics.record import MaterialSpec


def make(spec: MaterialSpec) -> Material:
    """Take mu and K from E and nu."""
    mu = spec.shear_modulus

    def law(I1: Array, I2: Array) -> Invariants:
        return Invariants(W=0.5 * mu * (I1 - 3.0), W1=np.full_like(I1, 0.5 * mu))

    return Material("neo_hookean", mu, spec.bulk_modulus, invariant_response(law))
