"""A surface layer has another stiffness."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.effects.fields import Skin
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="skin",
    acts_on="body",
    summary="a surface layer has another stiffness (drying)",
    equation="E(X) = ratio E within ``thickness`` of the free (unheld) surface",
    source="definition",
    parameters=(
        Parameter("thickness", "m", start=0.004, lower=0.0005, upper=0.03, sigma=0.005),
        Parameter("ratio", "1", start=1.0, lower=0.05, upper=50.0, sigma=1.5, neutral=1.0),
    ),
    shown_by="a small probe",
    confused_with=("stiffness_gradient", "strain_stiffening"),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """A layer of other modulus."""
    layer = Skin(float(values["thickness"]), float(values["ratio"]))
    return replace(physics, modulus_fields=(*physics.modulus_fields, layer))
