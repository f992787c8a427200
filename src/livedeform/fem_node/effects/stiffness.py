"""The Young's modulus is another than declared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.fields import Uniform
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="stiffness",
    acts_on="body",
    summary="the Young's modulus is another than declared",
    equation="E = ratio E_declared (all elastic constants of the material alike)",
    source="definition; literature values of phantoms scatter by a factor of two and more",
    parameters=(
        Parameter(
            "ratio",
            "1",
            start=1.0,
            lower=0.05,
            upper=20.0,
            sigma=0.7,
            neutral=1.0,
            scale="log",
            step=0.02,
            stated_by="phantom.material.youngs_modulus",
        ),
    ),
    shown_by="weight (sag), or a wrench; a body pressed by a displacement alone does not show it",
    confused_with=("density",),
    told_apart_by={
        "density": "weigh the phantom, or record the probe's force: displacements alone give only density / stiffness"
    },
    proved=(5, 5),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with all moduli times ``ratio``."""
    return replace(physics, modulus_fields=(*physics.modulus_fields, Uniform(float(values["ratio"]))))
