"""The stated rest was not at rest: the markers' places were taken while the body was held, or hung, otherwise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common.effect import EffectInfo, Parameter, Surroundings
from livedeform.common.types import Array
from livedeform.stereo_node.effects.view import View


def _possible(around: Surroundings) -> bool:
    """Return whether a tracker's frame is known without the markers at rest, or by those on the support: cameras that
    are registered to the others take a rigid displacement of these upon themselves."""
    return not around.has_cameras or around.support_makes_a_frame


INFO = EffectInfo(
    name="reference_pose",
    acts_on="measuring",
    summary="the stated rest was not at rest: the body was held off it when the markers' places were taken",
    equation=(
        "X_stated = exp([rotation]x) X_rest + translation, about the phantom frame's origin, of all markers but those "
        "on the support; x_measured = x(X_stated) + X_rest - X_stated"
    ),
    source="rigid motion; definition in interfaces.md section 7",
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
            "rotation", "rad", start=(0.0, 0.0, 0.0), lower=-0.2, upper=0.2, sigma=0.02, neutral=0.0, size=3, step=1e-3
        ),
    ),
    shown_by="a release from the stated rest, or two loads: what is off at rest is off by the same under every load",
    confused_with=("stiffness", "density", "scan_gravity"),
    possible=_possible,
    order=0,
)


def offset(values: Mapping[str, Array], view: View) -> Array:
    """Return X_rest - X_stated (n, 3) m of the view's markers; 0 on the support, which cannot be held off its place."""
    rotation = Rotation.from_rotvec(np.asarray(values["rotation"], float))
    shift = rotation.inv().apply(view.rest - np.asarray(values["translation"], float)) - view.rest
    return np.where((view.kinds == "support")[:, None], 0.0, shift)


def distort(points: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
    """Return where ``points`` (n, 3) m, carried by a body on which the markers sit as stated, really are."""
    return np.asarray(points + offset(values, view))


def correct(points: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
    """Return where measured points (n, 3) m would be if the markers sat as stated: the inverse."""
    return np.asarray(points - offset(values, view))
