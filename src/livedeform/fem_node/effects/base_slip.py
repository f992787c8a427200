"""The support holds the base less than declared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from livedeform.common.effect import EffectInfo, Parameter, Surroundings
from livedeform.common.types import Array
from livedeform.fem_node.physics.needs import is_bonded
from livedeform.fem_node.physics.record import Physics

COMPLIANCE = 1e-5  # m/Pa: what a body of 4 kPa and 5 cm has itself
SOFT_BASE = 0.4  # of height over modulus


def _soft_base(around: Surroundings) -> float:
    """Return the compliance (m/Pa) of springs about as soft as the body: the first bit of slip only relaxes the
    singular edge of a bonded base, and says nothing of the rest."""
    return float(SOFT_BASE * (around.upper[2] - around.lower[2]) / around.physics.material.youngs_modulus)


INFO = EffectInfo(
    name="base_slip",
    acts_on="support",
    summary="the base gives way sideways",
    equation="tangential traction = -stiffness u_t over every fixed support, u from the unloaded shape; the normal "
    "stays held",
    source="Winkler springs; definition",
    parameters=(
        Parameter(
            "stiffness",
            "Pa/m",
            start=3e5,
            lower=1e3,
            upper=1e9,
            sigma=COMPLIANCE,
            neutral=float("inf"),
            scale="inverse",
            step=3e-7,
            kick=_soft_base,
        ),
    ),
    shown_by="an off-centre press, markers near the foot",
    confused_with=("gravity_tilt", "base_debonding"),
    possible=is_bonded,
    tangent=False,
    switched=True,
    proved=(5, 5),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics whose fixed supports are springs along the surface."""
    stiffness = float(values["stiffness"])
    if stiffness == float("inf"):
        return physics
    supports = tuple(
        replace(s, type="spring", stiffness=stiffness) if s.type == "fixed" else s for s in physics.supports
    )
    return replace(physics, supports=supports)
