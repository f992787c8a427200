"""The registry of the mechanical effects: every file here, with its card ``INFO`` and ``apply(physics, values)``.

An effect whose neutral values depend on the declared model also has ``declared(physics) -> values``.
"""

from __future__ import annotations

from collections.abc import Iterable
from types import ModuleType

from livedeform.common.effect import effects_in
from livedeform.common.errors import InputError
from livedeform.common.published_effects import impossible, refuse_doubled
from livedeform.common.types import EffectValues
from livedeform.fem_node.physics.record import Physics

EFFECTS: dict[str, ModuleType] = effects_in(__name__, __path__)


def makes_rub(name: str) -> bool:
    """Return whether the effect of that name makes the probe rub on the surface or stick to it."""
    return name in EFFECTS and EFFECTS[name].INFO.rubs


def apply_effects(physics: Physics, effects: Iterable[EffectValues]) -> Physics:
    """Return the physics with every mechanical effect of the list, in the order of their cards and then of the list;
    measuring ones are left to their package. Raises ``InputError`` for values that are physically impossible, and for
    an effect that is there twice and can only be there once, wherever they come from."""
    mechanical = [effect for effect in effects if effect.name in EFFECTS]
    refuse_doubled(mechanical)
    for effect in sorted(mechanical, key=lambda e: EFFECTS[e.name].INFO.order):
        if wrong := impossible(effect.name, effect.values):
            raise InputError(wrong, where="effects", remedy="correct the value, or leave the effect out")
        physics = EFFECTS[effect.name].apply(physics, effect.values)
    return physics
