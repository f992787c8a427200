"""Make the folder of a new experiment, and prove that it is sound by reading it as any command would."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.experiment.markers_file import write_markers
from livedeform.common.experiment.schema import Markers
from livedeform.common.experiment.yaml_file import FILE_NAME, json_schema, load_experiment
from livedeform.common.types import Array
from livedeform.new.body import NewBody, read_new_body
from livedeform.new.inspected import inspected
from livedeform.new.markers import fit_note, read_places
from livedeform.new.picture import draw
from livedeform.new.questions import Answers, Ask, answered, questions
from livedeform.new.writing import experiment_text
from livedeform.outputs import checked, prepared, write_json, write_text

MARKERS, SCHEMA, PICTURE = "markers.csv", "experiment.schema.json", "experiment.png"


@dataclass(frozen=True)
class Sources:
    """The files that a new experiment is made of.

    ``surface_unit`` and ``markers_unit`` m or mm (None: told by the sizes); ``rest`` s and ``places`` (m) by marker are
    for markers from a take or a recording.
    """

    surface: Path
    markers: Path
    surface_unit: str | None = None
    markers_unit: str | None = None
    rest: tuple[float, float] = (0.0, 0.5)
    places: Mapping[str, Array] | None = None


def make_experiment(
    out: Path,
    sources: Sources,
    given: Mapping[str, str | None],
    *,
    ask: Ask | None = None,
    force: bool = False,
    tell: Callable[..., None] = lambda *_: None,
) -> list[str]:
    """Write ``out``; give lines about what was found, assumed and made.

    ``given`` are the answers that are known already, by question; ``ask`` asks for the others (None: what has a safe
    default is assumed). ``InputError`` for what cannot be meant; then nothing is written.
    """
    written = [FILE_NAME, MARKERS, SCHEMA, PICTURE]
    checked(out, [*written, sources.surface.name], [sources.surface, sources.markers], force=force)  # before it asks
    tell("reading the surface and the markers")
    body = read_new_body(sources.surface, sources.surface_unit)
    markers, note = read_places(
        sources.markers, body.surface, unit=sources.markers_unit, rest=sources.rest, places=sources.places or {}
    )
    answers = answered(questions(body, out), given, ask)
    cameras = answers["cameras"]
    copies = _copies(sources.surface, answers)
    names = [*written, *copies.values()]
    text = experiment_text(
        answers, sources.surface.name, body.unit, None if cameras is None else [copies[Path(file)] for file in cameras]
    )
    with prepared(out, names, force=force, inputs=[*copies, sources.markers], alone=False) as draft:
        _write(draft, copies, markers, text)
        findings = inspected(draft, {**{name: file for file, name in copies.items()}, MARKERS: sources.markers})
        tell("drawing the body")
        draw(load_experiment(draft), draft / PICTURE)
    assumed = [f"assumed: {'; '.join(answers.assumed)}"] if answers.assumed else []
    sound = f"{out / FILE_NAME}: sound; {out / PICTURE} shows it"
    of_markers = [f"read: {note}", f"markers: {fit_note(markers, body.surface)}"]
    return [_said_of_body(body), *of_markers, *assumed, *findings, sound]


def _write(draft: Path, copies: Mapping[Path, str], markers: Markers, text: str) -> None:
    """Write all but the picture into a folder."""
    for file, name in copies.items():
        shutil.copyfile(file, draft / name)
    write_markers(draft / MARKERS, markers)
    write_text(draft / FILE_NAME, text)
    write_json(draft / SCHEMA, json_schema())


def _said_of_body(body: NewBody) -> str:
    size = " x ".join(f"{1e3 * s:.1f}" for s in body.size)
    return f"body: {size} mm, the surface file is in {body.unit}"


def _copies(surface: Path, answers: Answers) -> dict[Path, str]:
    """Name the copies in the new folder of all files that the experiment needs; the probe's mesh is answered anew."""
    copies = {surface: surface.name}
    probe = answers["probe"]
    if probe is not None and "mesh" in probe:
        mesh = Path(probe["mesh"])
        copies[mesh] = mesh.name
        probe["mesh"] = mesh.name
    cameras = zip(answers["cameras"] or (), ("left.yaml", "right.yaml"), strict=False)
    copies |= {Path(file): name for file, name in cameras}
    _refuse_same_names(copies)
    return copies


def _refuse_same_names(copies: Mapping[Path, str]) -> None:
    names = list(copies.values())
    for file, name in copies.items():
        if names.count(name) > 1 or name in (FILE_NAME, MARKERS, SCHEMA, PICTURE):
            raise InputError(f"the name {name} is taken", where=str(file), remedy="rename the file")


def read_places_of(pairs: Sequence[str]) -> dict[str, Array]:
    """``["Tip=0.01,0,0.05", ..]`` as places (3,) m by label."""
    out = {}
    for pair in pairs:
        label, _, numbers = pair.rpartition("=")
        try:
            place = np.array([float(x) for x in numbers.split(",")])
        except ValueError:
            place = np.zeros(0)
        if not label or place.shape != (3,) or not np.isfinite(place).all():
            raise InputError(f"'{pair}' is not LABEL=x,y,z", where="--place", remedy='write --place "Tip=0.01,0,0.05"')
        out[label.strip()] = place
    if out and len(out) < 3:
        raise InputError(f"only {len(out)} places", where="--place", remedy="state those of at least three markers")
    return out
