"""Gravity points elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from scipy.spatial.transform import Rotation

from livedeform.common.effect import EffectInfo, Parameter
from livedeform.common.types import Array
from livedeform.fem_node.physics.needs import weighs
from livedeform.fem_node.physics.record import Physics

# rad: no table is level to better, and no mesh symmetric: a slender soft body, near buckling, makes millimetres of that
LEVEL = 0.002

INFO = EffectInfo(
    name="gravity_tilt",
    acts_on="load",
    summary="gravity points elsewhere than declared (the table is not level)",
    equation="g = exp([a]x) g_declared with the rotation vector a = (angle_x, angle_y, 0); loads along g turn with it",
    source="definition",
    parameters=(
        Parameter(
            "angle_x", "rad", start=0.0, lower=-0.8, upper=0.8, sigma=0.1, neutral=0.0, step=0.01, known_to=LEVEL
        ),
        Parameter(
            "angle_y", "rad", start=0.0, lower=-0.8, upper=0.8, sigma=0.1, neutral=0.0, step=0.01, known_to=LEVEL
        ),
    ),
    shown_by="turning the phantom by 180 degrees; markers on the support",
    confused_with=("base_slip",),
    possible=weighs,
    told_apart_by={"base_slip": "turn the phantom by 180 degrees on its table and record it at rest"},
    proved=(6, 6),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with gravity turned, and with it the weights that hang on the body; the direction during the
    scan stays as declared."""
    turn = Rotation.from_rotvec([float(values["angle_x"]), float(values["angle_y"]), 0.0])
    loads = tuple(
        replace(load, force=turn.apply(load.force)) if load.is_weight(physics.gravity) else load
        for load in physics.loads
    )
    return replace(physics, gravity=turn.apply(physics.gravity), loads=loads)
