"""Exponential stiffening: W = mu/2b (exp(b (I1 - 3)) - 1) + K/2 (J - 1)^2, isochoric I1 (Demiray 1972)."""

from __future__ import annotations

import numpy as np

from livedeform.common.types import Array
from livedeform.fem_node.materials.base import Invariants, Material, invariant_response
from livedeform.fem_node.physics.record import MaterialSpec

LARGEST_EXPONENT = (
    50.0  # beyond it W goes on as a parabola, so that a wild trial step gives a large number, not infinity
)


def make(spec: MaterialSpec) -> Material:
    """Take mu and K from E and nu; ``b`` (default 1; 0 is neo-Hookean)."""
    mu, b = spec.shear_modulus, float(spec.extra.get("b", 1.0))

    def law(I1: Array, I2: Array) -> Invariants:
        x = I1 - 3.0
        y = np.minimum(b * x, LARGEST_EXPONENT)
        beyond = b * x - y
        e = np.exp(y)
        W = 0.5 * mu * x if b == 0.0 else 0.5 * mu / b * (np.expm1(y) + e * beyond * (1.0 + 0.5 * beyond))
        return Invariants(W=W, W1=0.5 * mu * e * (1.0 + beyond), W11=0.5 * mu * b * e)

    return Material("exponential", mu, spec.bulk_modulus, invariant_response(law))
