"""The material models: one file each, one row here."""

from __future__ import annotations

from livedeform.common.errors import InputError
from livedeform.common.experiment.constants import nonsense_of
from livedeform.fem_node.materials import (
    corotational,
    exponential,
    linear,
    mooney_rivlin,
    neo_hookean,
    neo_hookean_log,
    ogden,
    saint_venant_kirchhoff,
    yeoh,
)
from livedeform.fem_node.materials.base import Material
from livedeform.fem_node.physics.record import MaterialSpec

MATERIALS = {
    "linear": linear,
    "saint_venant_kirchhoff": saint_venant_kirchhoff,
    "corotational": corotational,
    "neo_hookean": neo_hookean,
    "neo_hookean_log": neo_hookean_log,
    "mooney_rivlin": mooney_rivlin,
    "yeoh": yeoh,
    "exponential": exponential,
    "ogden": ogden,
}


def make_material(spec: MaterialSpec) -> Material:
    """Return the material of a specification; ``InputError`` for an unknown model, or constants that cannot be."""
    if spec.model not in MATERIALS:
        raise InputError(f"unknown material model '{spec.model}'", remedy=f"use one of {', '.join(MATERIALS)}")
    wrong, remedy = nonsense_of(spec.model, spec.extra)
    if wrong:
        raise InputError(wrong, remedy=remedy)
    material: Material = MATERIALS[spec.model].make(spec)
    return material
