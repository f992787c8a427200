"""A surface layer has another stiffness."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from livedeform.common.effect import EffectInfo, Parameter, Start, Surroundings, Together
from livedeform.common.types import Array
from livedeform.fem_node.physics.fields import Skin
from livedeform.fem_node.physics.record import Physics


def _starts(around: Surroundings) -> list[Start]:
    return [{"thickness": thickness} for thickness in (0.002, 0.005)]


def _membrane(values: Mapping[str, Array]) -> Array:
    return np.asarray(values["thickness"] * (values["ratio"] - 1.0))


INFO = EffectInfo(
    name="skin",
    acts_on="body",
    summary="a surface layer has another stiffness (drying)",
    equation="E(X) = ratio E within ``thickness`` of the free (unheld) surface",
    source="definition",
    parameters=(
        Parameter("thickness", "m", start=0.004, lower=0.0005, upper=0.03, sigma=1.0, scale="log"),
        Parameter("ratio", "1", start=1.0, lower=0.05, upper=50.0, sigma=1.5, neutral=1.0, scale="log", step=0.1),
    ),
    shown_by="a small probe",
    confused_with=("stiffness_gradient", "strain_stiffening"),
    starts=_starts,
    told_apart_by={"stiffness_gradient": "press with a smaller probe, or turn the phantom over"},
    together=Together("thickness x (ratio - 1)", "m", _membrane),
    proved=(24, 24),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with a layer of another modulus."""
    layer = Skin(float(values["thickness"]), float(values["ratio"]))
    return replace(physics, modulus_fields=(*physics.modulus_fields, layer))
