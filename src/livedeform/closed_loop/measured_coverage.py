"""How often stated 95 % intervals held the truth, of each family of effects: what a report says of its own intervals.

Printed by ``python -m benchmarks.coverage table --half proof`` (docs/evidence/blind-test.md). Nothing is decided by
these numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from livedeform.common.effect import EffectInfo


@dataclass(frozen=True)
class Held:
    """The number of blind values of which the stated interval ``held`` the truth, among ``n``."""

    held: int
    n: int


MEASURED: Mapping[str, Held] = {}


def family_of(info: EffectInfo) -> str:
    """Return the family of an effect: where it acts; apart are those of the body that have a shape in it."""
    shaped = any(p.unit == "m" and p.neutral is None for p in info.parameters)
    return "layers and inclusions" if info.acts_on == "body" and shaped else FAMILIES[info.acts_on]


FAMILIES = {
    "body": "the body's material",
    "support": "support and weight",
    "load": "support and weight",
    "probe": "the probe",
    "measuring": "measuring",
}


def coverage_notes(infos: Sequence[EffectInfo]) -> list[str]:
    """Say how often intervals of such effects held, a line for each family."""
    return [_sentence(family) for family in dict.fromkeys(family_of(info) for info in infos)]


def _sentence(family: str) -> str:
    measured = MEASURED.get(family)
    if measured is None:
        return f"95 % intervals of {family} have not been proved on blind values"
    share = round(100.0 * measured.held / measured.n)
    return f"95 % intervals of {family} held in {share} % of {measured.n} blind values"
