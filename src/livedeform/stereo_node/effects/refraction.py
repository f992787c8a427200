"""Internal markers are seen through the body's surface, which refracts the rays."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from livedeform.common.effect import EffectInfo, Parameter, Surroundings
from livedeform.common.errors import InputError
from livedeform.common.frames import apply, inverse
from livedeform.common.types import Array
from livedeform.stereo_node.camera.rays import TriangleSurface, apparent, meet, refract
from livedeform.stereo_node.effects.view import View


def _looks_inside(around: Surroundings) -> bool:
    return around.internal and around.has_cameras


INFO = EffectInfo(
    name="refraction",
    acts_on="measuring",
    summary="internal markers are seen through the surface and seem nearer than they are",
    equation=(
        "the rays from both cameras to the point are refracted at the predicted surface, "
        "sin(i) = index sin(r); the rig "
        "reports where their outer parts meet"
    ),
    source="Snell's law; Glassner 1989; depth seems divided by the index for small angles (thesis, chapter 4)",
    parameters=(Parameter("index", "1", start=1.0, lower=1.0, upper=1.7, sigma=0.2, neutral=1.0, step=0.02),),
    shown_by="internal and surface markers together",
    possible=_looks_inside,
    order=3,
)


def _surface(stamp_ns: int, view: View) -> TriangleSurface:
    surface = None if view.surface is None else view.surface(stamp_ns)
    if surface is None:
        raise InputError(
            "the effect 'refraction' needs the predicted surface",
            where="refraction",
            remedy="run it with the fem node's prediction",
        )
    return TriangleSurface(*surface)


def _centres(view: View) -> tuple[Array, Array]:
    """Return the cameras' places (3,) in phantom."""
    rig = view.cameras(INFO.name)
    right = apply(view.T_phantom_left, inverse(rig.T_right_left)[:3, 3][None])[0]
    return view.T_phantom_left[:3, 3], right


def _seen(true: Array, index: float, centres: tuple[Array, Array], surface: TriangleSurface) -> Array:
    """Return where the lines of sight to ``true`` (k, 3) seem to meet. A point stays that is not behind the surface, or
    that no light comes from."""
    a, b = centres
    out = meet(a, apparent(a, true, surface, index), b, apparent(b, true, surface, index))
    return np.where(_behind(true, a, surface)[:, None] & np.isfinite(out), out, true)


def _straightened(seen: Array, index: float, centres: tuple[Array, Array], surface: TriangleSurface) -> Array:
    """Return where the refracted rays to ``seen`` (k, 3) meet: the inverse of ``_seen`` but for the rays' missing each
    other."""
    a, b = centres
    (place_a, normal_a), (place_b, normal_b) = surface.hit(a, seen - a), surface.hit(b, seen - b)
    out = meet(place_a, refract(seen - a, normal_a, index), place_b, refract(seen - b, normal_b, index))
    return np.where(_behind(seen, a, surface)[:, None] & np.isfinite(out), out, seen)


def _behind(points: Array, centre: Array, surface: TriangleSurface) -> NDArray[np.bool_]:
    direction = points - centre
    place, _ = surface.hit(centre, direction)
    return np.asarray(((points - place) * direction).sum(axis=1) > 0)  # False where the ray misses (NaN)


def distort(points: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
    """Return what an uncorrected rig reports for true ``points`` (n, 3) m in phantom; only markers of kind internal
    change."""
    index, rows = float(values["index"]), np.flatnonzero(view.kinds == "internal")
    out = points.copy()
    if index != 1.0 and len(rows):
        out[rows] = _seen(points[rows], index, _centres(view), _surface(stamp_ns, view))
    return out


def spread(points: Array, covariances: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
    """Return the covariances (n, 3, 3) m2 of the true points of reported ``points`` (n, 3) m with ``covariances``.

    Depths are stretched and sides hardly: one standard deviation either way along each axis is corrected.
    """
    index, rows = float(values["index"]), np.flatnonzero(view.kinds == "internal")
    out = covariances.copy()
    if index != 1.0 and len(rows):
        surface, centres = _surface(stamp_ns, view), _centres(view)
        size, axes = np.linalg.eigh(covariances[rows])
        steps = np.moveaxis(axes * np.sqrt(np.maximum(size, 0.0))[:, None], 2, 0)  # (3, k, 3)
        there = np.stack([_straightened(points[rows] + step, index, centres, surface) for step in steps], axis=2)
        back = np.stack([_straightened(points[rows] - step, index, centres, surface) for step in steps], axis=2)
        columns = (there - back) / 2
        out[rows] = columns @ np.swapaxes(columns, 1, 2)
    return out


def correct(points: Array, stamp_ns: int, values: Mapping[str, Array], view: View) -> Array:
    """Correct reported points to true ones."""
    index, rows = float(values["index"]), np.flatnonzero(view.kinds == "internal")
    out = points.copy()
    if index != 1.0 and len(rows):
        surface, centres = _surface(stamp_ns, view), _centres(view)
        reported = points[rows]
        target = true = _straightened(reported, index, centres, surface)
        for _ in range(8):  # what the rays miss each other by is small: each step gains two digits
            step = target - _straightened(_seen(true, index, centres, surface), index, centres, surface)
            true = true + step
            if np.abs(step).max() < 1e-10:
                break
        out[rows] = true
    return out
