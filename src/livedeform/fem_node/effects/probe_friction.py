"""The probe drags the surface."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="probe_friction",
    acts_on="probe",
    summary="the probe drags the surface",
    equation="|t_t| <= mu t_n (Coulomb)",
    source="Wriggers 2006, chapter 5",
    parameters=(Parameter("mu", "1", start=0.3, lower=0.0, upper=3.0, sigma=0.5, step=0.05, kick=0.05),),
    shown_by="off-centre presses, or presses that slide sideways",
    tangent=False,
    rubs=True,
)


def declared(physics: Physics) -> dict[str, Array]:
    """Return the value at which the model is as declared."""
    return {"mu": np.array(physics.probe.friction if physics.probe is not None else 0.0)}


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with Coulomb friction under the probe."""
    return physics.with_probe(friction=float(values["mu"]))
