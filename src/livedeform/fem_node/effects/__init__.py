"""The registry of the mechanical effects: one file each, with ``INFO`` and ``apply(physics, values) -> physics``.

An effect whose neutral values depend on the declared model also has ``declared(physics) -> values``.
"""

from __future__ import annotations

from collections.abc import Iterable
from types import ModuleType

from livedeform.common.types import EffectValues
from livedeform.fem_node.effects import (
    base_debonding,
    base_slip,
    density,
    gravity_tilt,
    inclusion,
    inertia,
    plastic_set,
    poisson_ratio,
    probe_adhesion,
    probe_friction,
    probe_offset,
    scan_gravity,
    skin,
    softening,
    stiffness,
    stiffness_gradient,
    strain_stiffening,
    swelling,
    time_offset,
    viscoelasticity,
)
from livedeform.fem_node.physics.record import Physics

EFFECTS: dict[str, ModuleType] = {
    module.INFO.name: module
    for module in (
        base_debonding,
        base_slip,
        density,
        gravity_tilt,
        inclusion,
        inertia,
        plastic_set,
        poisson_ratio,
        probe_adhesion,
        probe_friction,
        probe_offset,
        scan_gravity,
        skin,
        softening,
        stiffness,
        stiffness_gradient,
        strain_stiffening,
        swelling,
        time_offset,
        viscoelasticity,
    )
}


def apply_effects(physics: Physics, effects: Iterable[EffectValues]) -> Physics:
    """The physics with every mechanical effect of the list, in its order; others (measuring) are left to their
    package."""
    for effect in effects:
        if effect.name in EFFECTS:
            physics = EFFECTS[effect.name].apply(physics, effect.values)
    return physics
