"""The registry of the measuring effects: every file here with a card ``INFO``, ``distort`` and ``correct``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import cast

from livedeform.common.effect import effects_in
from livedeform.common.published_effects import refuse_doubled
from livedeform.common.types import Array, EffectValues
from livedeform.stereo_node.effects.view import MeasuringEffect, Surface, View

__all__ = ["EFFECTS", "Surface", "View", "correct_all", "distort_all"]

EFFECTS = cast(dict[str, MeasuringEffect], effects_in(__name__, __path__))
"""In the order in which they act on the way from the true point to the reported one."""


def distort_all(points: Array, stamp_ns: int, effects: Iterable[EffectValues], view: View) -> Array:
    """Return what an uncorrected rig reports for true ``points`` (n, 3) m; other effects are passed over. Raises
    ``InputError`` for an effect that is there twice."""
    values = _of_each(effects)
    for name, module in EFFECTS.items():
        if name in values:
            points = module.distort(points, stamp_ns, values[name], view)
    return points


def correct_all(points: Array, stamp_ns: int, effects: Iterable[EffectValues], view: View) -> Array:
    """Correct reported points (n, 3) m to true ones: the inverse of ``distort_all``, errors included."""
    values = _of_each(effects)
    for name, module in reversed(EFFECTS.items()):
        if name in values:
            points = module.correct(points, stamp_ns, values[name], view)
    return points


def _of_each(effects: Iterable[EffectValues]) -> dict[str, Mapping[str, Array]]:
    measuring = [effect for effect in effects if effect.name in EFFECTS]
    refuse_doubled(measuring)
    return {effect.name: effect.values for effect in measuring}
