"""Reference markers from a table, a motion capture take or a recording, and whether they fit the body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError
from livedeform.common.experiment.markers_file import read_markers
from livedeform.common.experiment.schema import Markers
from livedeform.common.experiment.surface import METRES_PER_UNIT, Surface
from livedeform.common.frames import apply
from livedeform.common.types import Array, Ids
from livedeform.importing.c3d import read_c3d, register, rest_positions
from livedeform.importing.marker_ids import assign_ids

INSIDE = 0.03  # of the body's diagonal: a marker deeper than this is in the body, not on it
BESIDE, BASE = 0.05, 0.02  # of the diagonal, of the height: a marker so far beside the base is on the support
REACH = 0.25  # of the diagonal: a marker farther off is not the body's (as plausibility has it)
CLOSE = 0.01  # of the diagonal: markers that lie all closer together are in another unit (as plausibility has it)
BAG_SUFFIXES = (".mcap", ".db3", "")


@dataclass(frozen=True)
class RestMarkers:
    """Markers before they are checked: ``kinds`` is empty where the file states none; ``note`` says how they came."""

    ids: Ids
    points: Array
    sigmas: Array
    kinds: tuple[str, ...]
    note: str


def read_places(
    file: Path, surface: Surface, *, unit: str | None, rest: tuple[float, float], places: Mapping[str, Array]
) -> tuple[Markers, str]:
    """Read the markers and sort them into surface and internal ones; return them, and how they came, in words.

    ``unit`` m or mm (None: what fits); ``rest`` the seconds of a take or recording in which nothing moves; ``places``
    (m, in the surface's frame) of at least three markers, by label or id, where the tracker has another frame.
    ``InputError`` where the markers are off the body.
    """
    read = _read(file, surface, unit, rest, places)
    return settled(read, surface, file), read.note


def _read(
    file: Path, surface: Surface, unit: str | None, rest: tuple[float, float], places: Mapping[str, Array]
) -> RestMarkers:
    if not file.exists():
        raise InputError("the markers do not exist", where=str(file), remedy="name a .csv, a .c3d or a recording")
    if file.suffix == ".csv":
        return _in_metres(file, surface, unit)
    if file.suffix == ".c3d":
        take = read_c3d(file)
        return _registered(take.labels, rest_positions(take, take.frames_between(*rest)), places, file, surface)
    if file.suffix in BAG_SUFFIXES:
        return _of_recording(file, rest, places, surface)
    raise InputError("is neither a table, a take nor a recording", where=str(file), remedy="name .csv, .c3d or .mcap")


def _in_metres(file: Path, surface: Surface, unit: str | None) -> RestMarkers:
    """The table's markers, in the unit that is given, or else in that in which they fit the body."""
    read = read_markers(file)
    chosen = unit or _unit_of(read.points, surface)
    factor = METRES_PER_UNIT[chosen]
    kinds = tuple(str(kind) for kind in read.kinds) if read.kinds_stated else ()
    note = f"{len(read.ids)} markers of {file.name}, in {chosen}"
    return RestMarkers(read.ids, read.points * factor, read.sigmas * factor, kinds, note)


def _unit_of(points: Array, surface: Surface) -> str:
    """Millimetres where only these fit the body, metres otherwise.

    Read as millimetres, metres are all at the body's origin, which may be nearer to it than markers that stand off its
    skin are: those that lie so close together are none of its markers.
    """
    off = {unit: float(np.median(_off(points * METRES_PER_UNIT[unit], surface))) for unit in ("m", "mm")}
    apart = np.ptp(points, axis=0) if len(points) > 1 else points[0]
    close = float(np.linalg.norm(apart)) * METRES_PER_UNIT["mm"] < CLOSE * surface.diagonal
    return "m" if off["m"] <= REACH * surface.diagonal or close or off["m"] < off["mm"] else "mm"


def _off(points: Array, surface: Surface) -> Array:
    """Return how far (n,) m points lie outside of the body's box."""
    outside = np.maximum(surface.lower - points, 0) + np.maximum(points - surface.upper, 0)
    return np.asarray(np.linalg.norm(outside, axis=1))


def _of_recording(file: Path, rest: tuple[float, float], places: Mapping[str, Array], surface: Surface) -> RestMarkers:
    """The median place of every marker in the seconds of rest."""
    recording = load_recording(file)
    start = recording.start_ns
    frames = [f for f in recording.marker_frames if rest[0] <= (f.stamp_ns - start) * 1e-9 < rest[1]]
    if not frames:
        remedy = "give --markers a table id,x,y,z, or another --rest"
        raise InputError(f"holds no points between {rest[0]:g} and {rest[1]:g} s", where=str(file), remedy=remedy)
    ids = np.unique(np.concatenate([f.ids for f in frames]))
    seen = [np.vstack([f.points[f.ids == i] for f in frames]) for i in ids]
    medians = np.array([np.median(p, axis=0) for p in seen])
    return _registered([str(i) for i in ids], medians, places, file, surface, ids)


def _registered(
    labels: Sequence[str],
    points: Array,
    places: Mapping[str, Array],
    file: Path,
    surface: Surface,
    ids: Ids | None = None,
) -> RestMarkers:
    """The markers in the surface's frame: by a rigid fit to ``places`` where there are some.

    ``InputError`` where these do not lie as the markers do, so that what is on the surface ends in the body.
    """
    numbers = ids if ids is not None else assign_ids(tuple(labels), {})
    known = np.isfinite(points).all(axis=1)
    note = f"{int(known.sum())} markers of {file.name} at rest"
    if places:
        unknown = [label for label in places if label not in labels]
        if unknown:
            remedy = f"its markers are {', '.join(labels)}"
            raise InputError(f"there is no marker '{unknown[0]}'", where="--place", remedy=remedy)
        stated = np.array([places.get(label, np.full(3, np.nan)) for label in labels])
        T, misfit = register(stated, points)
        rms = float(np.sqrt(np.nanmean((misfit**2).sum(axis=1))))
        if rms > INSIDE * surface.diagonal:
            what = f"the stated places are {1e3 * rms:.2f} mm (rms) from those that the markers have to each other"
            remedy = "measure them again, or look whether labels are exchanged"
            raise InputError(what, where="--place", remedy=remedy)
        note += f", moved to {len(places)} stated places (misfit {1e3 * rms:.2f} mm rms)"
        points = apply(T, points)
    n = int(known.sum())
    return RestMarkers(numbers[known], points[known], np.full(n, np.nan), (), note)


def settled(places: RestMarkers, surface: Surface, file: Path) -> Markers:
    """Refuse markers off the body, and call those deep inside internal where no kind is stated."""
    diagonal = surface.diagonal
    distance = surface.distance(places.points)
    inside = surface.contains(places.points)
    kinds = places.kinds or _guessed(places.points, surface, distance, inside)
    far = np.flatnonzero(~inside & (distance > REACH * diagonal) & (np.array(kinds) != "support"))
    if len(far):
        worst = far[distance[far].argmax()]
        what = f"marker {places.ids[worst]} is {1e3 * distance[worst]:.1f} mm from the body"
        remedy = "the frames differ: state three markers' places with --place LABEL=x,y,z, or correct the table"
        raise InputError(what, where=str(file), remedy=remedy)
    return Markers(places.ids, places.points, places.sigmas, np.array(kinds))


def _guessed(points: Array, surface: Surface, distance: Array, inside: NDArray[np.bool_]) -> tuple[str, ...]:
    """Kinds by the place: deep inside, beside the body at its lowest height, or on its surface."""
    diagonal = surface.diagonal
    low = points[:, 2] <= surface.lower[2] + BASE * (surface.upper[2] - surface.lower[2])
    deep = inside & (distance > INSIDE * diagonal)
    beside = ~inside & low & (distance > BESIDE * diagonal)
    return tuple("internal" if d else "support" if b else "surface" for d, b in zip(deep, beside, strict=True))


def fit_note(markers: Markers, surface: Surface) -> str:
    """Say how far the surface markers lie from the surface."""
    on = markers.kinds == "surface"
    kinds = ", ".join(f"{int((markers.kinds == k).sum())} {k}" for k in np.unique(markers.kinds))
    if not on.any():
        return kinds
    distance = 1e3 * surface.distance(markers.points[on])
    return f"{kinds}; surface ones lie {np.median(distance):.2f} mm (at most {distance.max():.2f}) from the surface"
