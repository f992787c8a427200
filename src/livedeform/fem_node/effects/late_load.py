"""A load pulls later than the body's own weight does.

A body is let go and falls; what hangs on it, held by another hand or by a slack string, pulls some hundredths of a
second later, and until then moves nothing. Pulled by both at once the body would swing further.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from livedeform.common.effect import EffectInfo, Parameter, is_let_go_loaded
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics

INFO = EffectInfo(
    name="late_load",
    acts_on="load",
    summary="loads pull later than the body's own weight",
    equation="loads, and the mass that hangs with them, act from the release + delay on",
    source="definition",
    parameters=(Parameter("delay", "s", start=0.03, lower=0.0, upper=1.0, sigma=0.05, neutral=0.0, step=0.002),),
    shown_by="a release in which the body swings",
    confused_with=("scan_gravity", "inertia", "time_offset"),
    possible=is_let_go_loaded,
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with loads that act later."""
    delay = float(values["delay"])
    return replace(physics, loads=tuple(replace(load, delay=delay) for load in physics.loads))
