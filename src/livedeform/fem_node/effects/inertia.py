"""The body moves dynamically."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Inertia, Physics

INFO = EffectInfo(
    name="inertia",
    acts_on="body",
    summary="the body moves dynamically: it rings after fast moves and releases",
    equation="M a + C v + r(u) = f, C = rayleigh_beta K; M holds the body, and each load along gravity as a hung mass",
    source="Hilber, Hughes & Taylor 1977; Bathe 1996, section 9.3",
    parameters=(Parameter("rayleigh_beta", "s", start=0.003, lower=0.0, upper=0.2, sigma=0.01),),
    shown_by="fast stops; a release",
    confused_with=("time_offset", "viscoelasticity"),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Implicit dynamics with damping in proportion to the stiffness."""
    return replace(physics, inertia=Inertia(rayleigh_beta=float(values["rayleigh_beta"])))
