"""Radial distortion that the calibration left in both cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from livedeform.common.effect import EffectInfo, Parameter, Surroundings
from livedeform.common.frames import apply, inverse
from livedeform.common.types import Array
from livedeform.stereo_node.camera.rays import meet
from livedeform.stereo_node.camera.rig import StereoRig
from livedeform.stereo_node.effects.view import View, invert, reregistration, through_left


def _has_cameras(around: Surroundings) -> bool:
    return around.has_cameras


INFO = EffectInfo(
    name="lens_distortion",
    acts_on="measuring",
    summary="radial distortion left by the calibration",
    equation=(
        "x_seen = x (1 + k1 |x|^2) in both cameras, x the ideal image point at depth 1; then "
        "the rigid registration at rest"
    ),
    source="Brown 1966, first radial term; Zhang 2000",
    parameters=(Parameter("k1", "1", start=0.0, lower=-0.5, upper=0.5, sigma=0.1, neutral=0.0, step=2e-3),),
    shown_by="markers over the whole picture, or a body that moves through it",
    possible=_has_cameras,
    model_error=0.2,  # one term stands for all that a lens has
    order=2,
)


def _bend(rig: StereoRig, k1: float) -> Callable[[Array], Array]:
    """Return the function from points in the left frame to where a rig that ignores ``k1`` finds them."""
    T = rig.T_right_left
    right_centre = inverse(T)[:3, 3]

    def seen(x: Array) -> Array:
        ideal = x[:, :2] / x[:, 2:]
        return np.hstack([ideal * (1 + k1 * (ideal**2).sum(axis=1, keepdims=True)), np.ones((len(x), 1))])

    def bend(x: Array) -> Array:
        return meet(np.zeros(3), seen(x), right_centre, seen(apply(T, x)) @ T[:3, :3])

    return bend


def distort(points: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
    """Return what an uncorrected rig reports for true ``points`` (n, 3) m in phantom."""
    bend = _bend(view.cameras(INFO.name), float(values["k1"]))
    T = reregistration(view, bend)
    return through_left(points, view, lambda x: apply(T, bend(x)))


def correct(points: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
    """Correct reported points to true ones."""
    bend = _bend(view.cameras(INFO.name), float(values["k1"]))
    T = inverse(reregistration(view, bend))
    return through_left(points, view, lambda x: invert(apply(T, x), bend))
