"""Plan what a campaign goes through: the recordings of a folder, or those that ``campaign.yaml`` names."""

from __future__ import annotations

import glob
import itertools
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BeforeValidator, Field, ValidationError

from livedeform.closed_loop.candidates import check_known
from livedeform.common.errors import InputError
from livedeform.common.experiment.mistakes import first_mistake, in_words, locate
from livedeform.common.experiment.schema import Section, not_bool
from livedeform.common.experiment.yaml_file import FILE_NAME
from livedeform.common.yaml_text import parse_settings
from livedeform.outputs import CONFIGURATION

CAMPAIGN_FILE = "campaign.yaml"
BAG_FILES = (".mcap", ".db3")
RESULT = "metrics.json"  # marks the folder of a run, whose experiment.yaml is a copy
SOURCES = ("import", "synth")  # the commands whose folders hold recordings


Whole = Annotated[int, BeforeValidator(not_bool)]


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
    max_effects: Whole | None = Field(default=None, ge=0, le=10)
    seed: Whole = 0


class RunOptionsOfAll(Section):
    """Say how each recording is run, as the options of ``livedeform run``."""

    at_frames: bool = False


class Cluster(Section):
    """A queue that jobs are sent to: a class of dask-jobqueue without "Cluster" (slurm, pbs, sge, lsf, htcondor), how
    many ``workers`` of one core, and that class's own ``options`` (queue, memory, walltime ...)."""

    kind: str
    workers: Whole = Field(1, ge=1)
    options: dict[str, Any] = Field(default_factory=dict)


class CampaignFile(Section):
    """``campaign.yaml``. ``run`` and ``diagnose`` null leave that step out; ``cluster`` null: processes here."""

    version: Literal[1] = 1
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

    Raises ``InputError`` where the file is wrong, names what is not there, or there is no recording at all.
    """
    file = path / CAMPAIGN_FILE if path.is_dir() else path
    if not path.exists():
        raise InputError("does not exist", where=str(path), remedy="name a folder or a campaign.yaml")
    settings = _read_file(file) if file.is_file() else CampaignFile()
    folder, out = file.resolve().parent, out.resolve()
    recordings = []
    for number, entry in enumerate(settings.recordings):
        named = list(_recordings(entry, folder, out))
        if not named:
            raise _nothing_named(entry, folder, out, f"{file}: recordings.{number}")
        recordings += named
    for entry in () if settings.recordings else _found(folder, out):
        recordings += _recordings(entry, folder, out)
    if not recordings:
        raise InputError(
            "there is no recording", where=str(path), remedy=f"put bags beside an {FILE_NAME}, or name them in {file}"
        )
    _refuse_odd_names(recordings)
    return settings, sorted(_told_apart(recordings), key=lambda r: r.name)


def _read_file(file: Path) -> CampaignFile:
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        remedy = "name a folder or a campaign.yaml, as plain UTF-8 text"
        raise InputError("is no text that can be read", where=str(file), remedy=remedy) from error
    node, document = parse_settings(text, str(file))
    if document is not None and not isinstance(node, yaml.MappingNode):
        raise InputError("is not a mapping of keys", where=str(file), remedy="begin with 'version: 1'")
    try:
        settings = CampaignFile.model_validate(document or {})
    except ValidationError as error:
        assert node is not None  # an empty file has no mistake
        first = first_mistake(error)
        keys, line = locate(node, first["loc"])
        what, remedy = in_words(first, "add it; docs/campaigns.md has every key")
        raise InputError(what, where=f"{file}:{line}: {keys}".removesuffix(": "), remedy=remedy) from error
    if settings.diagnose is not None and settings.diagnose.candidates is not None:
        try:
            check_known(settings.diagnose.candidates)
        except InputError as error:
            raise InputError(error.what, where=f"{file}: diagnose.candidates", remedy=error.remedy) from error
    return settings


def _found(folder: Path, out: Path) -> Iterator[RecordingsOf]:
    """Every experiment below ``folder``, through links too, but those that are results."""
    known: set[Path] = set()
    for place, folders, files in os.walk(folder, followlinks=True):
        here = Path(place).resolve()
        if here in known or here == out:  # a link that leads back, or the campaign's own folder
            folders[:] = []
            continue
        known.add(here)
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        if FILE_NAME in files and not _is_result(here):
            yield RecordingsOf(experiment=str(Path(place).relative_to(folder)))


def _experiments(entry: RecordingsOf, folder: Path, out: Path) -> list[Path]:
    """Return the experiments that an entry names; of those that a pattern fits not the results. What is there by that
    name is no pattern."""
    named = folder / entry.experiment
    if named.exists() or not _is_pattern(entry.experiment):
        return [named]
    found = [path for path in _fitting(entry.experiment, folder) if not _is_result(_home(path))]
    return [path for path in found if not _is_below(path, out)]


def _fitting(pattern: str, folder: Path) -> list[Path]:
    """Return what a pattern fits, as seen from the folder, in the order of names."""
    return sorted(folder / path for path in glob.glob(pattern, root_dir=folder, recursive=True))


def _home(experiment: Path) -> Path:
    """Return the folder of an experiment that is named by that or by its file."""
    return experiment.parent if experiment.suffix in (".yaml", ".yml") else experiment


def _recordings(entry: RecordingsOf, folder: Path, out: Path) -> Iterator[CampaignRecording]:
    for experiment in _experiments(entry, folder, out):
        own = _home(experiment)
        home = own.parent if own.name == "experiment" else own
        phantom = entry.phantom or _label(home, folder)
        for bag in _bags(entry, folder, own, home, out):
            name = f"{_label(home, folder)}/{bag.stem if bag.is_file() else bag.name}"
            yield CampaignRecording(name=name, experiment=experiment, bag=bag, phantom=phantom, rig=entry.rig)


def _nothing_named(entry: RecordingsOf, folder: Path, out: Path, where: str) -> InputError:
    """Say why an entry of the file has no recordings."""
    there = [path for path in _experiments(entry, folder, out) if path.exists()]
    remedy = "paths are relative to the folder of the file; correct it, or take the entry out"
    if not there:
        return InputError(f"there is no experiment '{entry.experiment}'", where=where, remedy=remedy)
    what = f"'{entry.experiment}' has no recording" + (f" {', '.join(entry.bags)}" if entry.bags else "")
    return InputError(what, where=where, remedy=remedy)


def _refuse_odd_names(recordings: Iterable[CampaignRecording]) -> None:
    """Raise ``InputError`` for a name that is no UTF-8: no table, page or message could hold it."""
    for r in recordings:
        for text in (r.name, str(r.bag), str(r.experiment)):
            if any("\ud800" <= c <= "\udfff" for c in text):
                shown = text.encode("utf-8", "replace").decode()
                raise InputError("its name is not UTF-8", where=shown, remedy="rename the file or folder")


def _bags(entry: RecordingsOf, folder: Path, own: Path, home: Path, out: Path) -> list[Path]:
    """The bags that are named, or those that lie with the experiment: beside it, or in a folder ``bags``. What a
    pattern fits is a bag only where no command left it as its result."""
    if not entry.bags:
        places = list(dict.fromkeys([own, own / "bags", home / "bags"]))
        found = [path for place in places if place.is_dir() for path in place.iterdir() if is_bag(path)]
        return sorted(bag for path in found if path not in places and not _is_result(path) for bag in _bags_of(path))
    bags: list[Path] = []
    for text in entry.bags:
        if _is_pattern(text) and not (own / text).exists() and not (folder / text).exists():
            fitting = {b for p in (*_fitting(text, folder), *_fitting(text, own)) if is_bag(p) for b in _bags_of(p)}
            bags += sorted(path for path in fitting if not _is_left_behind(path, (own, folder), out))
        else:
            bags.append(own / text if (own / text).exists() else folder / text)
    return bags


def _bags_of(path: Path) -> list[Path]:
    """Return the rosbag2 folder that a file is a part of, those that a command wrote into a folder, or what it is."""
    if path.is_file():
        return [path.parent if (path.parent / "metadata.yaml").is_file() else path]
    written = (path / CONFIGURATION).is_file() and not (path / "metadata.yaml").is_file()
    return sorted(file for file in path.iterdir() if file.suffix in BAG_FILES) if written else [path]


def _is_left_behind(bag: Path, places: tuple[Path, ...], out: Path) -> bool:
    """Tell whether a command wrote the bag, or one of the folders in which it lies below one of the ``places``."""
    around = itertools.takewhile(lambda folder: folder not in places, (bag, *bag.parents))
    return _is_below(bag, out) or any(_is_result(folder) for folder in around if folder.is_dir())


def _is_below(path: Path, out: Path) -> bool:
    return out in (path.resolve(), *path.resolve().parents)


def is_bag(path: Path) -> bool:
    """Tell whether a file or a folder looks like a bag; a folder with an experiment has bags of its own."""
    if path.is_dir():
        if (path / FILE_NAME).is_file():
            return False
        return (path / "metadata.yaml").is_file() or any(p.suffix in BAG_FILES for p in path.glob("*"))
    return path.suffix in BAG_FILES


def _is_result(path: Path) -> bool:
    """Tell whether a command left this folder as its result: what is recorded in it is no recording of its own."""
    if (path / RESULT).is_file():
        return True
    try:
        command = str(json.loads((path / CONFIGURATION).read_text(encoding="utf-8"))["command"])
    except (FileNotFoundError, NotADirectoryError):
        return False
    except (OSError, ValueError, KeyError, TypeError):
        return True
    return not command.startswith(SOURCES)


def _is_pattern(text: str) -> bool:
    return any(c in text for c in "*?[")


def _label(place: Path, folder: Path) -> str:
    """Name a place by its way from the folder, also outside of it: bodies of one name in two folders are two."""
    where = place.resolve()
    return folder.name if where == folder else Path(os.path.relpath(where, folder)).as_posix()


def _told_apart(recordings: list[CampaignRecording]) -> Iterator[CampaignRecording]:
    """Recordings under names that occur once: what is listed twice is taken once, namesakes are numbered."""
    different = list({(r.experiment.resolve(), r.bag.resolve()): r for r in recordings}.values())
    taken, seen = {r.name for r in different}, set[str]()
    for r in different:
        free = (f"{r.name}~{n}" for n in itertools.count(2))
        name = r.name if r.name not in seen else next(n for n in free if n not in taken)
        taken.add(name)
        seen.add(name)
        yield r if name == r.name else r.model_copy(update={"name": name})
