"""A load rubs where it hangs on the body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from livedeform.common.effect import EffectInfo, Parameter, is_let_go_loaded
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="load_friction",
    acts_on="load",
    summary="what hangs on the body rubs where it hangs: each swing loses as much, and the last ones end soon",
    equation="f = F z along the load, against its motion; dz/du = (1 - z sgn du) / give, F = ratio times the load",
    source="Dahl 1968",
    parameters=(
        Parameter("ratio", "1", start=0.001, lower=0.0, upper=0.5, sigma=0.01, neutral=0.0, step=0.0005),
        Parameter("give", "m", start=2e-5, lower=1e-6, upper=1e-4, sigma=1.0, scale="log"),
    ),
    shown_by="a release in which the body swings to rest",
    confused_with=("inertia", "viscoelasticity"),
    possible=is_let_go_loaded,
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with friction along each load, in proportion to it, from when it acts."""
    ratio, give = float(values["ratio"]), float(values["give"])
    rubbing = [replace(p, friction=ratio * float(np.linalg.norm(p.force)), give=give) for p in physics.loads]
    return replace(physics, loads=tuple(rubbing))
