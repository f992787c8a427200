"""The support holds the base less than declared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="base_slip",
    acts_on="support",
    summary="the base gives way sideways",
    equation="tangential traction = -stiffness u_t over every fixed support, u from the unloaded shape; the normal "
    "stays held",
    source="Winkler springs; definition",
    parameters=(Parameter("stiffness", "Pa/m", start=3e5, lower=1e3, upper=1e9, sigma=2.0, neutral=float("inf")),),
    shown_by="an off-centre press, markers near the foot",
    confused_with=("gravity_tilt", "base_debonding"),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Fixed supports become springs along the surface."""
    stiffness = float(values["stiffness"])
    if stiffness == float("inf"):
        return physics
    supports = tuple(
        replace(s, type="spring", stiffness=stiffness) if s.type == "fixed" else s for s in physics.supports
    )
    return replace(physics, supports=supports)
