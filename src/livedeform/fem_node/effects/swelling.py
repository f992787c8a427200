"""The body grows or shrinks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics, VolumeRatio

INFO = EffectInfo(
    name="swelling",
    acts_on="body",
    summary="the body grows or shrinks (water, drying)",
    equation="F = F_e J_s^(1/3), J_s(t) = 1 + offset + rate t, stress-free and isotropic",
    source="Flory & Rehner 1943, kinematics only",
    parameters=(
        Parameter("rate", "1/s", start=0.0, lower=-0.01, upper=0.01, sigma=0.002, neutral=0.0, step=5e-5),
        Parameter("offset", "1", start=0.0, lower=-0.5, upper=0.5, sigma=0.05, neutral=0.0, step=2e-3),
    ),
    shown_by="long recordings; lengths at rest",
    confused_with=("stereo_scale",),
)


@dataclass(frozen=True)
class Growth(VolumeRatio):
    """J_s(t) = 1 + offset + rate t."""

    rate: float
    offset: float

    @property
    def changes_with_time(self) -> bool:
        return self.rate != 0.0

    def __call__(self, t: float) -> float:
        return 1.0 + self.offset + self.rate * t


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with a stress-free volume ratio in time."""
    growth = Growth(float(values["rate"]), float(values["offset"]))
    return replace(physics, volume_ratios=(*physics.volume_ratios, growth))
