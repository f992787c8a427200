"""The scanned shape was (or was not) already loaded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.needs import weighs
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="scan_gravity",
    acts_on="load",
    summary="the scanned shape was (or was not) already loaded",
    equation="the scanned shape is in equilibrium with fraction x scan_gravity (1: declared loaded, 0: unloaded)",
    source="inverse deformation, Govindjee & Mihalic 1996",
    parameters=(Parameter("fraction", "1", start=0.5, lower=0.0, upper=1.0, sigma=0.7, step=0.05),),
    shown_by="two orientations; the shape at rest",
    confused_with=("poisson_ratio", "stereo_scale", "probe_offset"),
    possible=weighs,
    told_apart_by=dict.fromkeys(
        ("stereo_scale", "poisson_ratio"), "record the phantom at rest in a second orientation"
    ),
)


def declared(physics: Physics) -> dict[str, Array]:
    """Return the value at which the model is as declared."""
    return {"fraction": np.array(physics.scan_fraction)}


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with another share of gravity during the scan."""
    return replace(physics, scan_fraction=float(values["fraction"]))
