"""Measured lengths are off by a factor: the calibration board's squares are not as long as they were said to be."""

from __future__ import annotations

from collections.abc import Mapping

from livedeform.common.effect import EffectInfo, Parameter, is_filmed
from livedeform.common.frames import apply, inverse
from livedeform.common.types import Array
from livedeform.stereo_node.effects.view import View, reregistration, through_left

INFO = EffectInfo(
    name="stereo_scale",
    acts_on="measuring",
    summary="measured lengths are off by a factor",
    equation="x_measured = T scale x_true about the left camera, T the rigid registration at rest",
    source=(
        "definition; a calibration cannot see its own scale (Hartley & Zisserman, 10.2); 4 % in the thesis, section 3.1"
    ),
    parameters=(Parameter("scale", "1", start=1.0, lower=0.8, upper=1.25, sigma=0.03, neutral=1.0, step=1e-3),),
    shown_by="markers all over the body, also at rest",
    confused_with=("swelling", "poisson_ratio", "scan_gravity"),
    told_apart_by={"swelling": "measure a second known length (a caliper between two markers on the support)"},
    possible=is_filmed,
    order=1,
    proved=(5, 5),
)


def distort(points: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
    """Return what an uncorrected rig reports for true ``points`` (n, 3) m in phantom."""
    scale = float(values["scale"])
    T = reregistration(view, lambda x: scale * x)
    return through_left(points, view, lambda x: apply(T, scale * x))


def correct(points: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
    """Correct reported points to true ones."""
    scale = float(values["scale"])
    T = inverse(reregistration(view, lambda x: scale * x))
    return through_left(points, view, lambda x: apply(T, x) / scale)
