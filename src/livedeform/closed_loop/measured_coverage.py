"""Say how often stated 95 % intervals have held the truth, for each family of effects.

The numbers are printed by ``python -m benchmarks.coverage table --half proof`` (docs/evidence/blind-test.md). Nothing
is decided by them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from livedeform.common.effect import ActsOn, EffectInfo

FAMILIES: Mapping[ActsOn, str] = {
    "body": "the body's material",
    "support": "support and weight",
    "load": "support and weight",
    "probe": "the probe",
    "measuring": "measuring",
}


@dataclass(frozen=True)
class Proved:
    """The number of blind values of which the stated interval ``held`` the truth, among ``n`` of these ``effects``."""

    held: int
    n: int
    effects: tuple[str, ...]


MEASURED: Mapping[str, Proved] = {
    "inclusions": Proved(18, 30, ("inclusion",)),
    "layers": Proved(8, 8, ("skin",)),
    "measuring": Proved(28, 28, ("camera_motion",)),
    "support and weight": Proved(4, 4, ("gravity_tilt",)),
    "the probe": Proved(18, 18, ("probe_offset",)),
}


def family_of(info: EffectInfo) -> str:
    """Return the family of an effect: where it acts; apart are those of the body that have a shape in it, with a place
    or without."""
    shape = [p for p in info.parameters if p.unit == "m" and p.neutral is None]
    if info.acts_on == "body" and shape:
        return "inclusions" if any(p.size is not None for p in shape) else "layers"
    return FAMILIES[info.acts_on]


def coverage_notes(infos: Sequence[EffectInfo], measured: Mapping[str, Proved] = MEASURED) -> list[str]:
    """Say of each effect that is given how often the intervals of its family have held, once for each family."""
    return list(dict.fromkeys(_sentence(info, measured) for info in infos))


def _sentence(info: EffectInfo, measured: Mapping[str, Proved]) -> str:
    family = family_of(info)
    proved = measured.get(family)
    if proved is None or info.name not in proved.effects:
        return f"how often 95 % intervals of {info.name} hold has not been measured"
    share = round(100.0 * proved.held / proved.n)
    return f"95 % intervals of this family ({family}) held in {share} % of {proved.n} blind values"
