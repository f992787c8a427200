"""The stiffness changes with height."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.fields import HeightGradient
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="stiffness_gradient",
    acts_on="body",
    summary="the stiffness changes with height",
    equation="E(z) = E (1 + slope (z - H/2)), H the unloaded height, z from the lowest point",
    source="gels that set under their own weight; definition",
    parameters=(Parameter("slope", "1/m", start=0.0, lower=-40.0, upper=40.0, sigma=10.0, neutral=0.0, step=0.5),),
    shown_by="turning the phantom over; presses at different heights",
    confused_with=("skin", "strain_stiffening"),
    proved=(6, 6),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with a modulus linear in height."""
    return replace(physics, modulus_fields=(*physics.modulus_fields, HeightGradient(float(values["slope"]))))
