"""Say how often stated 95 % intervals have held the truth, for each family of effects (docs/evidence/intervals.md).

What was measured of an effect stands on its card (`common.effect.EffectInfo.proved`). Nothing is decided by it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from livedeform.common.effect import ActsOn, EffectInfo

FAMILIES: Mapping[ActsOn, str] = {
    "body": "the body's material",
    "support": "support and weight",
    "load": "support and weight",
    "probe": "the probe",
    "measuring": "measuring",
}


def family_of(info: EffectInfo) -> str:
    """Return the family of an effect: where it acts; apart are those of the body that have a shape in it, with a place
    or without."""
    shape = [p for p in info.parameters if p.unit == "m" and p.neutral is None]
    if info.acts_on == "body" and shape:
        return "inclusions" if any(p.size is not None for p in shape) else "layers"
    return FAMILIES[info.acts_on]


def coverage_notes(infos: Sequence[EffectInfo], cards: Iterable[EffectInfo]) -> list[str]:
    """Say of each effect that is given how often the intervals of its family have held, once for each family, by all
    effects' ``cards``."""
    known = list(cards)
    return list(dict.fromkeys(_sentence(info, known) for info in infos))


def _sentence(info: EffectInfo, cards: Sequence[EffectInfo]) -> str:
    if not info.proved[1]:
        return f"how often 95 % intervals of {info.name} hold has not been measured"
    family = family_of(info)
    held, n = (sum(card.proved[i] for card in cards if family_of(card) == family) for i in (0, 1))
    share = f"{round(100 * held / n)} % of {n} blind values"
    return f"95 % intervals of this family ({family}) held in {share}, given the effect"
