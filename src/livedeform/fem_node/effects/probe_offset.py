"""The tool centre point is off."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="probe_offset",
    acts_on="probe",
    summary="the tool centre point is off",
    equation="true pose = recorded pose displaced by ``translation`` in the probe's frame",
    source="definition",
    parameters=(
        Parameter(
            "translation",
            "m",
            start=(0.0, 0.0, 0.0),
            lower=-0.02,
            upper=0.02,
            sigma=0.002,
            neutral=0.0,
            size=3,
            step=1e-4,
            placed_by_elements=(0, 1),  # across a press: how deep the probe is tells itself
        ),
    ),
    shown_by="frames of first touch, several angles",
    confused_with=("scan_gravity", "skin"),
    like_mesh=True,
    proved=(12, 12),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with the probe displaced in its own frame."""
    return physics.with_probe(offset=np.asarray(values["translation"], float))
