"""A part of the deformation does not come back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from livedeform.common.effect import EffectInfo, Parameter, Start, Surroundings
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics, PlasticSet


def _starts(around: Surroundings) -> list[Start]:
    return [{"threshold": strain} for strain in (0.02, 0.1, 0.25)]


INFO = EffectInfo(
    name="plastic_set",
    acts_on="body",
    summary="a part of the deformation does not come back",
    equation="isochoric plastic Hencky strain h_p = fraction (1 - threshold/|h|) h at the largest |h| so far, "
    "beyond the threshold",
    source="Mullins-type residual strain, Dorfmann & Ogden 2004, in its simplest form",
    parameters=(
        Parameter("fraction", "1", start=0.1, lower=0.0, upper=0.9, sigma=0.2, neutral=0.0, step=0.03),
        Parameter("threshold", "1", start=0.05, lower=0.0, upper=1.0, sigma=1.0, scale="log"),
    ),
    shown_by="dwelling after the retreat: the dimple stays",
    confused_with=("viscoelasticity",),
    starts=_starts,
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with a plastic set; none where ``fraction`` is 0."""
    fraction = float(values["fraction"])
    plastic = PlasticSet(fraction, float(values["threshold"])) if fraction != 0.0 else None
    return replace(physics, plastic_set=plastic)
