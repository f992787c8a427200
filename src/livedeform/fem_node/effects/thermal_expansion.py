"""The body grows as it warms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from livedeform.common.effect import EffectInfo, Parameter, Surroundings
from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics, TemperatureCurve, VolumeRatio


def _possible(around: Surroundings) -> bool:
    """Return whether a temperature other than the scan's is declared: nothing is known of any other expansion."""
    temperature = around.physics.temperature
    return temperature is not None and (temperature.varies or temperature.above_reference(0.0) != 0.0)


INFO = EffectInfo(
    name="thermal_expansion",
    acts_on="body",
    summary="the body grows as it warms",
    equation="F = F_e J_T^(1/3), J_T(t) = 1 + 3 alpha (T(t) - T0), T(t) the declared temperature, T0 its reference",
    source="Holzapfel 2000, section 7.8, to first order in alpha; silicones 2e-4 to 3e-4, water-based gels 1e-4 1/K",
    parameters=(Parameter("alpha", "1/K", start=0.0, lower=-0.01, upper=0.01, sigma=5e-4, neutral=0.0, step=2e-5),),
    shown_by="a temperature that changes while lengths at rest are measured",
    confused_with=("swelling", "stereo_scale"),
    possible=_possible,
    told_apart_by={"swelling": "record the phantom once more at the first temperature: what swells stays"},
)


@dataclass(frozen=True)
class Expansion(VolumeRatio):
    """J_T(t) = 1 + 3 alpha (T(t) - T0)."""

    alpha: float
    temperature: TemperatureCurve

    @property
    def changes_with_time(self) -> bool:
        return self.alpha != 0.0 and self.temperature.varies

    def __call__(self, t: float) -> float:
        return 1.0 + 3.0 * self.alpha * self.temperature.above_reference(t)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with another stress-free volume ratio, from the declared temperature."""
    if physics.temperature is None:
        raise InputError(
            "thermal_expansion needs to know how warm the body was",
            where="effects",
            remedy="declare 'temperature' in the experiment, or leave thermal_expansion out",
        )
    growth = Expansion(float(values["alpha"]), physics.temperature)
    return replace(physics, volume_ratios=(*physics.volume_ratios, growth))
