"""Import recordings of other formats: ``livedeform import``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

import livedeform
from livedeform.common.bags.read import read_bag
from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import Markers
from livedeform.common.experiment.yaml_file import files_of, load_experiment
from livedeform.common.types import Array, Ids
from livedeform.importing.c3d import (
    MotionCapture,
    held_note,
    read_c3d,
    register,
    residual_covariance,
    rest_positions,
    still_covariance,
    write_take,
)
from livedeform.importing.marker_ids import differences, ids_of
from livedeform.importing.silicone_beam import import_beam, takes_of
from livedeform.outputs import prepared

NOISE = {"still": still_covariance, "residual": residual_covariance}
PRESETS = ("silicone-beam",)


def import_takes(
    files: Sequence[Path],
    out: Path,
    *,
    experiment: Path | None = None,
    ids: Mapping[str, int] | None = None,
    rest: tuple[float, float] = (0.0, 0.5),
    noise: str = "still",
    force: bool = False,
) -> list[str]:
    """Writes ``out/<take>.mcap`` for every C3D file; gives warnings, and a line about each."""
    if noise not in NOISE:
        raise InputError(f"unknown '{noise}'", where="--noise", remedy=f"known are {', '.join(NOISE)}")
    known = load_experiment(experiment) if experiment is not None else None
    inputs = [*files, *(files_of(known) if known is not None else [])]
    names = [f"{path.stem}.mcap" for path in files]
    for name in names:
        if (out / name).exists() and not force:
            raise InputError("exists already", where=str(out / name), remedy="choose another --out, or add --force")
    with prepared(out, names, force=force, inputs=inputs, alone=False) as draft:
        markers = known.markers if known is not None else None
        takes = [read_c3d(path) for path in files]
        numbers, lines = numbered(takes, ids or {})
        for take, marker_ids in zip(takes, numbers, strict=True):
            lines += _import_take(take, draft, out, markers, marker_ids, rest, noise)
    return lines


def numbered(takes: Sequence[MotionCapture], given: Mapping[str, int]) -> tuple[list[Ids], list[str]]:
    """Return the ids of each take's markers, and warnings where the takes have not the same markers."""
    labels = [take.labels for take in takes]
    ids = ids_of(labels, given)
    return ids, differences([take.path.name for take in takes], labels, ids)


def _import_take(
    take: MotionCapture,
    draft: Path,
    out: Path,
    markers: Markers | None,
    marker_ids: Ids,
    rest: tuple[float, float],
    noise: str,
) -> list[str]:
    """Writes one take into ``draft``; gives warnings, and a line about the file that it becomes in ``out``."""
    name = f"{take.path.stem}.mcap"
    T, fit = registered(take, marker_ids, markers, rest)
    covariance = NOISE[noise](take)
    metadata = {"source": take.path.name, "livedeform": livedeform.__version__, "noise": noise, "registration": fit}
    n = write_take(take, draft / name, ids=marker_ids, T_phantom_tracker=T, covariance=covariance, metadata=metadata)
    line = f"{out / name}: {n} frames, {len(take.labels)} markers, noise {sigma_said(covariance)}, {fit}"
    return [*warnings_of(take), line]


def sigma_said(covariance: Array) -> str:
    """Say the median over markers of their noise (markers, 3, 3) m2 in words."""
    variance = np.trace(covariance, axis1=1, axis2=2) / 3.0
    if not np.isfinite(variance).any():
        return "unknown (too few frames)"
    return f"{1e6 * np.sqrt(np.nanmedian(variance)):.1f} um per axis"


def warnings_of(take: MotionCapture) -> list[str]:
    """Return a line about each thing that a take's file says and that is taken as something else."""
    return [f"warning: {take.path.name}: {note}" for note in (*take.notes, *held_note(take))]


def registered(
    take: MotionCapture, marker_ids: Ids, markers: Markers | None, rest: tuple[float, float]
) -> tuple[Array, str]:
    """T_phantom_tracker (4, 4) by the markers at rest, and how well they fit; the identity without ``markers``."""
    if markers is None:
        return np.eye(4), "not registered: the tracker's frame is taken as the phantom's"
    reference = _places(marker_ids, markers.ids, markers.points)
    T, misfit = register(reference, rest_positions(take, take.frames_between(*rest)))
    return T, f"registered to {np.isfinite(misfit).all(axis=1).sum()} markers, rms {1e3 * _rms(misfit):.3f} mm"


def import_preset(
    name: str, files: Sequence[Path], surface: Path | None, out: Path, *, force: bool = False
) -> list[str]:
    """Writes the experiments of a published data set; gives a line about each bag."""
    if name not in PRESETS:
        raise InputError(f"unknown preset '{name}'", where="--preset", remedy=f"known are {', '.join(PRESETS)}")
    stl = surface or files[0].parent / "beam.stl"
    if not stl.is_file():
        raise InputError("the beam's surface does not exist", where=str(stl), remedy="name it with --surface")
    names = []
    for case, takes in takes_of(files).items():
        bags = [f"bags/{path.stem}.mcap" for path in takes]
        names += [f"{case}/{name}" for name in ("experiment.yaml", "markers.csv", "beam.stl", *bags)]
    lines = []
    with prepared(out, names, force=force, inputs=[*files, stl], alone=False) as draft:
        for folder in import_beam(list(files), stl, draft):
            load_experiment(folder)
            lines += _said_of_beam(folder, takes_of(files)[folder.name], out / folder.name)
    return lines


def _said_of_beam(folder: Path, files: Sequence[Path], place: Path) -> list[str]:
    """A line about each bag in ``folder``, and one about the experiment, by the names that they will have."""
    lines, bag_place = [], place
    for path in sorted(folder / "bags" / f"{file.stem}.mcap" for file in files):
        with read_bag(path) as bag:
            about = bag.metadata
            n = bag.n_messages
        bag_place = place / "bags" / path.name
        lines.append(
            f"{bag_place}: {n} frames, released at frame {about['release_frame']} of {about['source']}, "
            f"stated places fit within {about['registration_rms_mm']} mm rms"
        )
    lines.append(f"{place}: experiment; try: livedeform run {place} --bag {bag_place} --out {place / 'run'}")
    return lines


def parse_ids(pairs: Sequence[str]) -> dict[str, int]:
    """``["Tip - 1=1", ..]`` as labels and ids."""
    out = {}
    for pair in pairs:
        label, sign, number = pair.rpartition("=")
        if not sign or not number.strip().isdigit():
            raise InputError(f"'{pair}' is not LABEL=ID", where="--ids", remedy='write --ids "Tip - 1=1"')
        out[label.strip()] = int(number)
    return out


def parse_span(text: str, where: str = "--rest") -> tuple[float, float]:
    """``"0.2:0.6"`` as two numbers."""
    try:
        start, end = (float(part) for part in text.split(":"))
    except ValueError as error:
        raise InputError(f"'{text}' is not FROM:TO", where=where, remedy="write seconds, as 0.2:0.6") from error
    if not 0 <= start < end:
        raise InputError(f"'{text}' is not a span of time", where=where, remedy="write seconds, as 0.2:0.6")
    return start, end


def _places(ids: Ids, known_ids: Ids, points: Array) -> Array:
    """The reference places (n, 3) of ``ids``, NaN for those that are not known."""
    places = np.full((len(ids), 3), np.nan)
    for i, marker_id in enumerate(ids):
        found = np.flatnonzero(known_ids == marker_id)
        if len(found):
            places[i] = points[found[0]]
    return places


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.nanmean((vectors**2).sum(axis=1))))
