"""Yeoh: W = c1 (I1 - 3) + c2 (I1 - 3)^2 + c3 (I1 - 3)^3 + K/2 (J - 1)^2, isochoric I1 (Yeoh 1993).

c1 = mu / 2 always follows E and nu; ``c2`` and ``c3`` are relative to c1 (``c2_ratio``, ``c3_ratio``), or in Pa
together with ``c1`` in Pa, and then scale with E.
"""

from __future__ import annotations

from livedeform.common.experiment.constants import shear_modulus_of
from livedeform.common.types import Array
from livedeform.fem_node.materials.base import Invariants, Material, invariant_response
from livedeform.fem_node.physics.record import MaterialSpec


def make(spec: MaterialSpec) -> Material:
    """Take mu and K from E and nu; c2 and c3 relative to c1."""
    mu = spec.shear_modulus
    c1 = 0.5 * mu
    scale = mu / (shear_modulus_of(spec.model, spec.extra) or mu)
    c2 = float(spec.extra.get("c2", 0.0)) * scale + float(spec.extra.get("c2_ratio", 0.0)) * c1
    c3 = float(spec.extra.get("c3", 0.0)) * scale + float(spec.extra.get("c3_ratio", 0.0)) * c1

    def law(I1: Array, I2: Array) -> Invariants:
        x = I1 - 3.0
        W = x * (c1 + x * (c2 + x * c3))
        return Invariants(W=W, W1=c1 + x * (2.0 * c2 + 3.0 * c3 * x), W11=2.0 * c2 + 6.0 * c3 * x)

    return Material("yeoh", mu, spec.bulk_modulus, invariant_response(law))
