"""The stiffness drifts over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.fields import Drift
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="softening",
    acts_on="body",
    summary="the stiffness drifts over time (warming, damage)",
    equation="E(t) = E exp(-rate t), t from the first stamp of the earliest recording",
    source="gelatin softens by 1-3 % per kelvin; definition",
    parameters=(Parameter("rate", "1/s", start=0.002, lower=-0.1, upper=0.1, sigma=0.01, neutral=0.0, step=5e-4),),
    shown_by="coming back to an earlier state later",
    confused_with=("viscoelasticity", "swelling"),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with a modulus that decays."""
    return replace(physics, modulus_fields=(*physics.modulus_fields, Drift(float(values["rate"]))))
