"""Plan what a campaign goes through: the recordings of a folder, or those that ``campaign.yaml`` names."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import Section
from livedeform.common.experiment.yaml_file import FILE_NAME
from livedeform.common.yaml_text import parse_settings
from livedeform.outputs import CONFIGURATION

CAMPAIGN_FILE = "campaign.yaml"
BAG_FILES = (".mcap", ".db3")
RESULT = "metrics.json"  # marks the folder of a run, whose experiment.yaml is a copy


class RecordingsOf(Section):
    """Recordings of one experiment: ``experiment`` is a path or pattern beside ``campaign.yaml``, and ``bags`` are such
    beside the experiment or that file.

    ``phantom``: whose body it is (default: the experiment's folder); ``rig``: which cameras and probe took them.
    """

    experiment: str
    bags: tuple[str, ...] = ()
    phantom: str = ""
    rig: str = "1"


class DiagnoseOptions(Section):
    """Say how each recording is diagnosed, as the options of ``livedeform diagnose``."""

    candidates: tuple[str, ...] | None = None
    max_effects: int | None = Field(default=None, ge=0, le=10)
    seed: int = 0


class RunOptionsOfAll(Section):
    """Say how each recording is run, as the options of ``livedeform run``."""

    at_frames: bool = False


class Cluster(Section):
    """A queue that jobs are sent to: a class of dask-jobqueue without "Cluster" (slurm, pbs, sge, lsf, htcondor), how
    many ``workers`` of one core, and that class's own ``options`` (queue, memory, walltime ...)."""

    kind: str
    workers: int = Field(1, ge=1)
    options: dict[str, Any] = Field(default_factory=dict)


class CampaignFile(Section):
    """``campaign.yaml``. ``run`` and ``diagnose`` null leave that step out; ``cluster`` null: processes here."""

    version: int = 1
    recordings: tuple[RecordingsOf, ...] = ()
    run: RunOptionsOfAll | None = RunOptionsOfAll()
    diagnose: DiagnoseOptions | None = DiagnoseOptions()
    cluster: Cluster | None = None


class CampaignRecording(Section):
    """One recording: its ``name`` in the table, and where things are."""

    name: str
    experiment: Path
    bag: Path
    phantom: str
    rig: str


def read_plan(path: Path, out: Path) -> tuple[CampaignFile, list[CampaignRecording]]:
    """Read a folder or a ``campaign.yaml``; recordings are sorted by name. Folders below ``out`` are no input.

    Raises ``InputError`` where the file is wrong or there is no recording at all.
    """
    file = path / CAMPAIGN_FILE if path.is_dir() else path
    if not path.exists():
        raise InputError("does not exist", where=str(path), remedy="name a folder or a campaign.yaml")
    settings = _read_file(file) if file.is_file() else CampaignFile()
    folder = file.resolve().parent
    entries = settings.recordings or tuple(_found(folder, out.resolve()))
    recordings = [r for entry in entries for r in _recordings(entry, folder)]
    if not recordings:
        raise InputError(
            "there is no recording", where=str(path), remedy=f"put bags beside an {FILE_NAME}, or name them in {file}"
        )
    return settings, sorted(_told_apart(recordings), key=lambda r: r.name)


def _read_file(file: Path) -> CampaignFile:
    try:
        _, document = parse_settings(file.read_text(encoding="utf-8"), str(file))
        return CampaignFile.model_validate(document or {})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        context = first.get("ctx", {})
        what = context.get("what") or first["msg"][:1].lower() + first["msg"][1:]
        raise InputError(
            what, where=f"{file}: {key}", remedy=context.get("remedy", "docs/campaigns.md has every key")
        ) from error


def _found(folder: Path, out: Path) -> Iterator[RecordingsOf]:
    """Every experiment below ``folder``, but those that are results."""
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(f for f in folders if not f.startswith(".") and Path(place, f) != out)
        if FILE_NAME in files and RESULT not in files and Path(place) != out:
            yield RecordingsOf(experiment=str(Path(place).relative_to(folder)))


def _recordings(entry: RecordingsOf, folder: Path) -> Iterator[CampaignRecording]:
    experiments = (
        sorted(folder.glob(entry.experiment)) if _is_pattern(entry.experiment) else [folder / entry.experiment]
    )
    for experiment in experiments:
        own = experiment.parent if experiment.suffix in (".yaml", ".yml") else experiment
        home = own.parent if own.name == "experiment" else own
        phantom = entry.phantom or _label(home, folder)
        for bag in _bags(entry, folder, own, home):
            name = f"{_label(home, folder)}/{bag.stem if bag.is_file() else bag.name}"
            yield CampaignRecording(name=name, experiment=experiment, bag=bag, phantom=phantom, rig=entry.rig)


def _bags(entry: RecordingsOf, folder: Path, own: Path, home: Path) -> list[Path]:
    """The bags that are named, or those that lie with the experiment: beside it, or in a folder ``bags``."""
    if not entry.bags:
        places = list(dict.fromkeys([own, own / "bags", home / "bags"]))
        found = [path for place in places if place.is_dir() for path in place.iterdir() if is_bag(path)]
        return sorted(path for path in found if path not in places and not _is_result(path))
    out: list[Path] = []
    for text in entry.bags:
        if _is_pattern(text):
            out += sorted({*folder.glob(text), *own.glob(text)})
        else:
            out.append(own / text if (own / text).exists() else folder / text)
    return out


def is_bag(path: Path) -> bool:
    """Tell whether a file or a folder looks like a bag."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or any(p.suffix in BAG_FILES for p in path.glob("*"))
    return path.suffix in BAG_FILES


def _is_result(path: Path) -> bool:
    """Tell whether a command wrote this folder: what is recorded in it is no recording of its own."""
    return (path / RESULT).is_file() or (path / CONFIGURATION).is_file()


def _is_pattern(text: str) -> bool:
    return any(c in text for c in "*?[")


def _label(place: Path, folder: Path) -> str:
    """Name a place by its way from the folder, also outside of it: bodies of one name in two folders are two."""
    where = place.resolve()
    return folder.name if where == folder else Path(os.path.relpath(where, folder)).as_posix()


def _told_apart(recordings: list[CampaignRecording]) -> Iterator[CampaignRecording]:
    """Recordings under names that occur once: what is listed twice is taken once, namesakes are numbered."""
    seen: dict[str, int] = {}
    for r in {(r.experiment.resolve(), r.bag.resolve()): r for r in recordings}.values():
        seen[r.name] = seen.get(r.name, 0) + 1
        yield r if seen[r.name] == 1 else r.model_copy(update={"name": f"{r.name}~{seen[r.name]}"})
