"""A region has another stiffness."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.effects.fields import Ball
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="inclusion",
    acts_on="body",
    summary="a region has another stiffness",
    equation="E(X) = ratio E inside |X - centre| < radius (unloaded places)",
    source="definition; tumours are 2 to 20 times as stiff as their surroundings (Krouskop 1998)",
    parameters=(
        Parameter("centre", "m", start=(0.0, 0.0, 0.0), lower=-1.0, upper=1.0, sigma=0.05, size=3),
        Parameter("radius", "m", start=0.01, lower=0.002, upper=0.1, sigma=0.01),
        Parameter("ratio", "1", start=1.0, lower=0.05, upper=50.0, sigma=1.5, neutral=1.0),
    ),
    shown_by="a raster of presses",
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """A ball of other modulus."""
    centre = np.asarray(values["centre"], float)
    ball = Ball((centre[0], centre[1], centre[2]), float(values["radius"]), float(values["ratio"]))
    return replace(physics, modulus_fields=(*physics.modulus_fields, ball))
