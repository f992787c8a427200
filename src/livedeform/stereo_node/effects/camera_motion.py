"""The cameras moved against the phantom after they were registered."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common.effect import EffectInfo, Parameter, Start, Surroundings, is_filmed
from livedeform.common.frames import apply, inverse, transform
from livedeform.common.types import Array
from livedeform.stereo_node.effects.view import View, through_left


def _starts(around: Surroundings) -> list[Start]:
    """Return onsets in the middle between two key moments."""
    t = around.times
    return [{"onset": float(middle)} for middle in 0.5 * (t[1:] + t[:-1])]


INFO = EffectInfo(
    name="camera_motion",
    acts_on="measuring",
    summary="the cameras moved (once, as one rigid body) against the phantom",
    equation=(
        "x_left = T_old_new^-1 x_left for t >= onset, T_old_new = (exp [rotation]x, "
        "translation) in the left optical frame"
    ),
    source="rigid motion; definition in interfaces.md section 6",
    parameters=(
        Parameter(
            "translation",
            "m",
            start=(0.0, 0.0, 0.0),
            lower=-0.02,
            upper=0.02,
            sigma=1e-3,
            neutral=0.0,
            size=3,
            step=1e-4,
        ),
        Parameter(
            "rotation", "rad", start=(0.0, 0.0, 0.0), lower=-0.1, upper=0.1, sigma=3e-3, neutral=0.0, size=3, step=5e-4
        ),
        Parameter("onset", "s", start=0.0, lower=0.0, upper=1e5, sigma=1e5, step=1e-6, between_moments=True),
    ),
    shown_by="markers on the support, or any that the probe does not move",
    confused_with=("gravity_tilt",),
    possible=is_filmed,
    starts=_starts,
    order=4,
    proved=(21, 21),
    once=True,
)


def motion(stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
    """Return T_old_new (4, 4) of the left optical frame at ``stamp_ns``; ``onset`` counts from the clock's start."""
    if (stamp_ns - view.start_ns) * 1e-9 < float(values.get("onset", np.zeros(()))):
        return np.eye(4)
    rotation = Rotation.from_rotvec(np.asarray(values["rotation"], float)).as_matrix()
    return transform(rotation, np.asarray(values["translation"], float))


def distort(points: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
    """Return what an uncorrected rig reports for true ``points`` (n, 3) m in phantom."""
    T = inverse(motion(stamp_ns, values, view))
    return through_left(points, view, lambda x: apply(T, x))


def correct(points: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
    """Correct reported points to true ones."""
    T = motion(stamp_ns, values, view)
    return through_left(points, view, lambda x: apply(T, x))
