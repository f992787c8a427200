"""Mooney-Rivlin: W = C10 (I1 - 3) + C01 (I2 - 3) + K/2 (J - 1)^2, isochoric invariants (Mooney 1940, Rivlin 1948).

mu = 2 (C10 + C01). ``ratio`` = C01 / (C10 + C01), default 0.2; or ``c10`` and ``c01`` in Pa, scaled with E where an
effect changes E.
"""

from __future__ import annotations

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.materials.base import Invariants, Material, invariant_response
from livedeform.fem_node.physics.record import MaterialSpec


def make(spec: MaterialSpec) -> Material:
    """Take mu and K from E and nu; the split of mu from ``ratio``, or from c10 : c01."""
    mu = spec.shear_modulus
    ratio = float(spec.extra.get("ratio", 0.2))
    if "c10" in spec.extra:
        ratio = spec.extra["c01"] / (spec.extra["c10"] + spec.extra["c01"])
    C10, C01 = 0.5 * mu * (1.0 - ratio), 0.5 * mu * ratio

    def law(I1: Array, I2: Array) -> Invariants:
        W = C10 * (I1 - 3.0) + C01 * (I2 - 3.0)
        return Invariants(W=W, W1=np.full_like(I1, C10), W2=np.full_like(I1, C01))

    return Material("mooney_rivlin", mu, spec.bulk_modulus, invariant_response(law))
