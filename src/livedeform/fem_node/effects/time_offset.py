"""Probe and camera clocks differ."""

from __future__ import annotations

from collections.abc import Mapping

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics

CLOCK = 2e-3  # s: stamps are of an exposure's beginning, middle or end

INFO = EffectInfo(
    name="time_offset",
    acts_on="probe",
    summary="probe and camera clocks differ",
    equation="the probe is at time t where its record says at t + seconds (> 0: its stamps are late)",
    source="definition; u(t + dt) - u(t) = v dt",
    parameters=(
        Parameter("seconds", "s", start=0.0, lower=-0.5, upper=0.5, sigma=0.05, neutral=0.0, step=5e-3, known_to=CLOCK),
    ),
    shown_by="reversals, two speeds",
    confused_with=("viscoelasticity", "probe_adhesion"),
    proved=(4, 5),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with another clock of the probe."""
    return physics.with_probe(time_offset=float(values["seconds"]))
