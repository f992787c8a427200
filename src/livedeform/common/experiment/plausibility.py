"""Does an experiment make sense in space? Sizes, units, markers on the body, lesions in it, supports that hold it."""

from __future__ import annotations

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import Experiment, Region
from livedeform.common.experiment.surface import Surface, read_mesh_boundary, read_surface
from livedeform.common.published_effects import impossible
from livedeform.common.types import EffectValues

SMALLEST_BODY = 0.003  # m
LARGEST_BODY = 3.0  # m
MAX_TETRAHEDRA = 5e6
FAR_FRACTION = 0.25  # of the body's diagonal: a marker farther off is not carried by the body
LARGEST_ERROR = 0.25  # of the diagonal: an error that is larger says nothing of where a marker is
SUPPORT_REACH = 10.0  # markers on the support may be that much farther off
TIMES_THE_BODY, LARGEST_BESIDE = 5.0, 0.5  # of the diagonal, m: plates are larger than what they press, and tools long
LARGEST_FITTED = 0.1  # m; up to here a fit may make a region larger than a small body
WITHIN, OUTSIDE = {"radius", "thickness"}, {"translation"}  # parameters of effects that are lengths, m
NEXT_TO = 0.01  # of the diagonal: a box so near to the surface may meet the mesh's
TETRAHEDRON_VOLUME = 1.0 / (6.0 * np.sqrt(2.0))  # of a regular one with edge 1


def read_body(experiment: Experiment) -> Surface:
    """The body's surface in metres."""
    phantom = experiment.phantom
    if phantom.surface is not None:
        return read_surface(phantom.surface, phantom.unit)
    assert phantom.mesh is not None  # schema
    return read_mesh_boundary(phantom.mesh, phantom.unit)


def check_geometry(experiment: Experiment) -> Surface:
    """Reads the body's surface and raises ``InputError`` at the first thing that cannot be; gives the surface."""
    phantom = experiment.phantom
    surface = read_body(experiment)
    _check_size(experiment, surface)
    _check_element_size(experiment, surface)
    _check_markers(experiment, surface)
    _check_lesions(experiment, surface)
    _check_lengths(experiment, surface)
    for i, support in enumerate(phantom.support):
        _check_region(experiment, surface, support.region, f"phantom.support.{i}.region")
        if support.region.contains(surface.vertices).all():
            raise InputError(
                "the region holds the whole body",
                where=_where(experiment, f"phantom.support.{i}.region"),
                remedy="regions are in metres, whatever phantom.unit is: 1 mm is 0.001",
            )
    for i, effect in enumerate(experiment.effects):
        _check_effect(experiment, surface, i, effect)
    for i, load in enumerate(experiment.loads):
        _check_region(experiment, surface, load.region, f"loads.{i}.region")
    return surface


def _where(experiment: Experiment, key: str) -> str:
    return f"{experiment.path}: {key}"


def _check_size(experiment: Experiment, surface: Surface) -> None:
    size = float((surface.upper - surface.lower).max())
    other = {"m": "mm", "mm": "m"}[experiment.phantom.unit]
    if not SMALLEST_BODY <= size <= LARGEST_BODY:
        raise InputError(
            f"with unit {experiment.phantom.unit} the body is {size:.4g} m across",
            where=_where(experiment, "phantom.unit"),
            remedy=f"write 'unit: {other}' if that is the unit of the file",
        )
    if surface.volume <= 0:
        raise InputError(
            "the surface encloses no volume",
            where=_where(experiment, "phantom.surface"),
            remedy="check the orientation of its triangles",
        )


def _check_element_size(experiment: Experiment, surface: Surface) -> None:
    h = experiment.phantom.element_size
    if h is None:
        return
    size = surface.upper - surface.lower
    if h > size.max() / 2:
        raise InputError(
            f"element_size {h:g} m is more than half of the body ({size.max():.3g} m)",
            where=_where(experiment, "phantom.element_size"),
            remedy=f"give it in metres, for example {size.min() / 6:.1g}",
        )
    n = surface.volume / (TETRAHEDRON_VOLUME * h**3)
    if n > MAX_TETRAHEDRA:
        raise InputError(
            f"element_size {h:g} m makes about {n:.1g} tetrahedra",
            where=_where(experiment, "phantom.element_size"),
            remedy=f"give it in metres, for example {size.min() / 6:.1g}",
        )


def _check_markers(experiment: Experiment, surface: Surface) -> None:
    markers = experiment.markers
    if not len(markers.ids):
        return
    reach = FAR_FRACTION * surface.diagonal
    off = np.linalg.norm(
        np.maximum(surface.lower - markers.points, 0) + np.maximum(markers.points - surface.upper, 0), axis=1
    )
    if (off > reach).all() and len(off) > 1:
        for factor, remedy in ((1e-3, "divide them by 1000"), (1e3, "multiply them by 1000")):
            scaled = markers.points * factor
            if ((scaled >= surface.lower - reach) & (scaled <= surface.upper + reach)).all():
                raise InputError(
                    "all markers lie far from the body, and would fit with another unit",
                    where=str(experiment.phantom.markers),
                    remedy=f"markers are in metres, whatever phantom.unit is: {remedy}",
                )
    tiny = float(np.ptp(markers.points, axis=0).max()) < 0.01 * float((surface.upper - surface.lower).max())
    if tiny and len(off) > 3:
        raise InputError(
            f"all markers lie within {np.ptp(markers.points, axis=0).max() * 1e3:.3g} mm",
            where=str(experiment.phantom.markers),
            remedy="markers are in metres: check the unit",
        )
    _check_places(experiment, surface, reach)


def _check_places(experiment: Experiment, surface: Surface, reach: float) -> None:
    """Check marker by marker: none further than ``reach`` m from the body, and internal ones inside."""
    markers = experiment.markers
    distance = surface.distance(markers.points)
    allowed = np.where(markers.kinds == "support", SUPPORT_REACH * reach, reach)
    far = np.flatnonzero(distance > allowed)
    far = far[~surface.contains(markers.points[far])]
    if len(far):
        worst = far[distance[far].argmax()]
        raise InputError(
            f"marker {markers.ids[worst]} is {distance[worst]:.3g} m from the body",
            where=str(experiment.phantom.markers),
            remedy="check its coordinates: metres, in the surface file's frame",
        )
    internal = np.flatnonzero(markers.kinds == "internal")
    outside = internal[~surface.contains(markers.points[internal])]
    if len(outside):
        raise InputError(
            f"marker {markers.ids[outside[0]]} is called internal, but lies outside the body",
            where=str(experiment.phantom.markers),
            remedy="correct its place or its kind",
        )


def _check_lesions(experiment: Experiment, surface: Surface) -> None:
    for i, lesion in enumerate(experiment.lesions):
        centre = np.array([lesion.centre])
        if not surface.contains(centre)[0]:
            away = float(surface.distance(centre)[0])
            raise InputError(
                f"the centre of lesion '{lesion.name}' lies outside the body, {away:.3g} m from it",
                where=_where(experiment, f"phantom.lesions.{i}.centre"),
                remedy="give it in metres, in the surface file's frame",
            )


def _check_lengths(experiment: Experiment, surface: Surface) -> None:
    """Refuse lengths that are millimetres by all likelihood: of what lies in the body, and of what presses on it."""
    across = surface.diagonal
    lengths = [(f"phantom.lesions.{i}.diameter", x.diameter) for i, x in enumerate(experiment.lesions)]
    lengths += [("thresholds.error", experiment.thresholds.error)]
    sigmas = experiment.markers.sigmas[np.isfinite(experiment.markers.sigmas)]
    if len(sigmas) and sigmas.max() > LARGEST_ERROR * across:
        _refuse_length(str(experiment.phantom.markers), "sigma", float(sigmas.max()), surface)
    for key, length in lengths:
        if length > across:
            _refuse_length(_where(experiment, key), key.rpartition(".")[2], length, surface)
    for key, sizes in [] if experiment.probe is None else experiment.probe.shape:
        if sizes is None:
            continue
        size = float(np.ptp(read_surface(sizes).vertices, axis=0).max() if key == "mesh" else np.max(sizes))
        if size > _far(surface):
            _refuse_length(_where(experiment, f"probe.shape.{key}"), key, size, surface)


def _check_effect(experiment: Experiment, surface: Surface, i: int, effect: EffectValues) -> None:
    """Refuse values that this body cannot have, or that are millimetres by all likelihood."""
    where, values = _where(experiment, f"effects.{i}"), effect.values
    if wrong := impossible(effect.name, values, height=float(surface.upper[2] - surface.lower[2])):
        raise InputError(wrong, where=where, remedy="correct the value")
    for keys, most in ((WITHIN, max(surface.diagonal, LARGEST_FITTED)), (OUTSIDE, _far(surface))):
        for key in keys & values.keys():
            size = float(np.linalg.norm(values[key]))
            if size > most:
                _refuse_length(where, f"'{key}' of effect '{effect.name}'", size, surface)
    if effect.name == "inclusion":
        centre, radius = np.reshape(values["centre"], (1, 3)), float(values["radius"])
        away = float(surface.distance(centre)[0]) - radius
        if away > FAR_FRACTION * surface.diagonal and not surface.contains(centre)[0]:
            what = f"the effect 'inclusion' lies outside the body, {away:.3g} m from it"
            raise InputError(what, where=where, remedy="give centre and radius in metres, in the surface file's frame")


def _far(surface: Surface) -> float:
    """Return the length (m) from which on something beside the body is in millimetres by all likelihood."""
    return max(TIMES_THE_BODY * surface.diagonal, LARGEST_BESIDE)


def _refuse_length(where: str, name: str, length: float, surface: Surface) -> None:
    what = f"{name} is {length:.4g} m, but the body is {surface.diagonal:.3g} m across"
    raise InputError(what, where=where, remedy="lengths are in metres: 2 mm is 0.002")


def _check_region(experiment: Experiment, surface: Surface, region: Region, key: str) -> None:
    """Refuses a region that the surface does not reach; what it selects of the mesh is the solver's to check."""
    z_min, z_max = surface.lower[2], surface.upper[2]
    if region.below_z is not None:
        misses, body = region.below_z < z_min, f"the body's lowest point is at z = {z_min:.4g}"
    elif region.above_z is not None:
        misses, body = region.above_z > z_max, f"the body's highest point is at z = {z_max:.4g}"
    elif region.box is not None:
        lower, upper = np.array(region.box)
        slack = NEXT_TO * surface.diagonal
        misses = bool((lower > surface.upper).any() or (upper < surface.lower).any())
        body = f"the body lies between {_point(surface.lower)} and {_point(surface.upper)}"
        if not misses and not surface.meets_box(lower - slack, upper + slack):
            misses, body = True, f"the box lies inside its surface, or beside it, by more than {slack:.2g}"
    elif region.sphere is not None:
        away = float(surface.distance(np.array([region.sphere.centre]))[0])
        misses, body = away > region.sphere.radius, f"the surface is {away:.3g} m from its centre"
    else:
        assert region.plane is not None  # schema
        heights = region.plane.height(surface.vertices)
        tolerance = region.plane.tolerance
        misses = bool((heights > tolerance).all() or (heights < -tolerance).all())
        body = f"the body is {np.abs(heights).min():.3g} m from the plane"
    if misses:
        raise InputError(
            f"the region touches no part of the body's surface: {body} m",
            where=_where(experiment, key),
            remedy="correct it",
        )


def _point(p: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in p) + ")"
