"""The body is less (or more) compressible than declared."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="poisson_ratio",
    acts_on="body",
    summary="the body is less (or more) compressible than declared",
    equation="K = E / 3(1 - 2 nu) with nu = value, E unchanged",
    source="linear elasticity; gels are 0.45 to 0.4999",
    parameters=(
        Parameter(
            "value",
            "1",
            start=0.48,
            lower=0.2,
            upper=0.4995,
            sigma=0.03,
            step=0.002,
            stated_by="phantom.material.poisson_ratio",
        ),
    ),
    shown_by="sideways bulging under several presses",
    confused_with=("density", "stereo_scale", "scan_gravity"),
    proved=(15, 16),
)


def declared(physics: Physics) -> dict[str, Array]:
    """Return the value at which the model is as declared."""
    return {"value": np.array(physics.material.poisson_ratio)}


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with Poisson's ratio ``value``."""
    return physics.with_material(poisson_ratio=float(values["value"]))
