"""The surface sticks to the retreating probe."""

from __future__ import annotations

from collections.abc import Mapping

from livedeform.common.effect import EffectInfo, Parameter, Surroundings
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics

KICK = 0.5  # Young's moduli: less hardly lifts a surface
# of the strength, in proportion to which a probe pulls: the surface peels over less than the points of contact are
# apart. rms over balls and cylinders, 500 to 4000 Pa and elements of 4 to 10 mm, against Johnson, Kendall & Roberts
# 1971 and Kendall 1971 (tests/fem_node/test_pull_off.py)
WRONG = 0.2


def _kick(around: Surroundings) -> float:
    """Return the strength (Pa) that it is screened and begun at: one that lifts the body by as much, soft or stiff."""
    return KICK * float(around.physics.material.youngs_modulus)


INFO = EffectInfo(
    name="probe_adhesion",
    acts_on="probe",
    summary="the surface sticks to the retreating probe",
    equation="the contact bears tension up to ``strength`` until it lets go",
    source="cohesive zone, Alfano & Crisfield 2001, in its simplest form",
    parameters=(
        Parameter(
            "strength",
            "Pa",
            start=200.0,
            lower=0.0,
            upper=1e5,
            sigma=5000.0,
            neutral=0.0,
            step=50.0,
            kick=_kick,
            wrong_by_elements=WRONG,
        ),
    ),
    shown_by="two retreat speeds",
    confused_with=("time_offset",),
    tangent=False,
    switched=True,
    rubs=True,
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics whose contact bears tension up to ``strength``."""
    return physics.with_probe(adhesion=float(values["strength"]))
