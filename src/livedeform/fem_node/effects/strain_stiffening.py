"""The material stiffens at large strain, beyond a neo-Hookean one."""

from __future__ import annotations

from collections.abc import Mapping

from livedeform.common.effect import EffectInfo, Parameter, Surroundings
from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics

MODELS = ("neo_hookean", "exponential")


def _extends(around: Surroundings) -> bool:
    """Return whether the declared material is one that this extends."""
    return around.physics.material.model in MODELS


INFO = EffectInfo(
    name="strain_stiffening",
    acts_on="body",
    summary="the material stiffens at large strain, beyond a neo-Hookean one",
    equation="W = mu/2b (exp(b (I1_iso - 3)) - 1) + volumetric part; b = 0 is neo-Hookean",
    source="Fung 1967; Demiray 1972",
    parameters=(Parameter("b", "1", start=1.0, lower=0.0, upper=30.0, sigma=10.0, neutral=0.0, step=0.1),),
    shown_by="two press depths",
    confused_with=("stiffness_gradient", "skin"),
    possible=_extends,
    proved=(5, 6),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with the exponential material with the declared small-strain constants."""
    material = physics.material
    if material.model not in MODELS:
        raise InputError(
            f"strain_stiffening extends a neo-Hookean material, and this is '{material.model}'",
            where="effects",
            remedy="declare neo_hookean, or leave strain_stiffening out",
        )
    return physics.with_material(model="exponential", extra={**material.extra, "b": float(values["b"])})
