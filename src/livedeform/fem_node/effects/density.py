"""The weight (or buoyancy) is another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.needs import weighs
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="density",
    acts_on="load",
    summary="the weight (or buoyancy) is another",
    equation="rho = ratio rho_declared",
    source="definition",
    parameters=(
        Parameter(
            "ratio",
            "1",
            start=1.0,
            lower=0.0,
            upper=5.0,
            sigma=0.3,
            neutral=1.0,
            scale="log",
            step=0.02,
            stated_by="phantom.density",
        ),
    ),
    shown_by="weighing; a wrench",
    confused_with=("stiffness",),
    possible=weighs,
    proved=(5, 5),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with another density."""
    return replace(physics, density=physics.density * float(values["ratio"]))
