"""Jobs keyed by what they are made of: bag, experiment, mesh, options and versions. What has its key is done."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from livedeform.campaign.plan import CampaignFile, CampaignRecording
from livedeform.common.errors import LivedeformError
from livedeform.common.experiment.yaml_file import files_of, load_experiment
from livedeform.outputs import versions, write_json

DIGESTS = "digests.json"
ROW = "row.parquet"
FAILURE = "failure.json"
CHUNK = 1 << 20


class ChangedError(LivedeformError):
    """The files of a job are no longer those that it was planned with."""


@dataclass(frozen=True, eq=False)
class Job:
    """One recording to go through, in a ``folder`` of its own that is named by its key.

    ``wrong``: why there is no key (the experiment or the bag cannot be read); ``options``: of its steps.
    """

    recording: CampaignRecording
    folder: Path
    options: dict[str, Any] = field(default_factory=dict)
    wrong: str = ""

    @property
    def key(self) -> str:
        """The key of its content; empty where it has none."""
        return "" if self.wrong else self.folder.name

    @property
    def is_done(self) -> bool:
        """Tell whether its row is there, which is written last."""
        return not self.wrong and (self.folder / ROW).is_file()

    @property
    def failure(self) -> str:
        """The one line of an earlier failure that would come again; empty without one."""
        if self.wrong:
            return self.wrong
        try:
            said = json.loads((self.folder / FAILURE).read_text())
            return "" if said["passing"] else str(said["problem"])
        except (OSError, ValueError, KeyError, TypeError):
            return ""


class Digests:
    """Digests of files, kept by place, size and time of change, so that gigabytes are read once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fresh: dict[str, list[Any]] = {}
        try:
            self.known = dict(json.loads(path.read_text()))
        except (OSError, ValueError, TypeError):
            self.known = {}

    def __call__(self, path: Path) -> str:
        """Return the SHA-256 of a file's content."""
        state = path.stat()
        stamp = [state.st_size, state.st_mtime_ns, state.st_ino]
        kept = self.known.get(str(path))
        if not isinstance(kept, list) or kept[:3] != stamp:
            digest = hashlib.sha256()
            with path.open("rb") as file:
                while piece := file.read(CHUNK):
                    digest.update(piece)
            kept = [*stamp, digest.hexdigest()]
        self.fresh[str(path)] = kept
        return str(kept[3])

    def save(self) -> None:
        """Keep the digests of the files that were asked for."""
        if self.fresh != self.known:
            write_json(self.path, self.fresh)


def jobs_of(recordings: Sequence[CampaignRecording], settings: CampaignFile, out: Path) -> Iterator[Job]:
    """Give each recording its job, below ``out/jobs``; what cannot be read is a job that is wrong."""
    digests = Digests(out / DIGESTS)
    experiments: dict[Path, list[list[str]]] = {}
    options = {
        "run": None if settings.run is None else settings.run.model_dump(mode="json"),
        "diagnose": None if settings.diagnose is None else settings.diagnose.model_dump(mode="json"),
    }
    for recording in recordings:
        try:
            if recording.experiment not in experiments:
                experiments[recording.experiment] = _content(recording.experiment, digests)
            key = _key(experiments[recording.experiment], _bag(recording.bag, digests), options)
            yield Job(recording, out / "jobs" / key, options)
        except LivedeformError as error:
            yield Job(recording, out / "jobs", options, wrong=str(error))
        except OSError as error:
            line = f"{error.filename or recording.bag}: cannot be read ({error.strerror})"
            yield Job(recording, out / "jobs", options, wrong=line)
    digests.save()


def refuse_changed(job: Job) -> None:
    """Raise ``ChangedError`` where the files of a job are others than when its key was made of them: what it found
    would be kept under the key of what it was not made of."""
    recording, digests = job.recording, Digests(job.folder.parents[1] / DIGESTS)
    now = _key(_content(recording.experiment, digests), _bag(recording.bag, digests), job.options)
    if now != job.key:
        raise ChangedError(
            "the experiment or the recording was changed while the campaign went on",
            where=recording.name,
            remedy="start the campaign again",
        )


def _key(experiment: list[list[str]], bag: list[list[str]], options: dict[str, Any]) -> str:
    parts = {"versions": versions(), "options": options, "experiment": experiment, "bag": bag}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:24]


def _content(path: Path, digests: Digests) -> list[list[str]]:
    """Return an experiment's files; its mesh is made of these, and again the same by the same versions."""
    return [[file.name, digests(file)] for file in files_of(load_experiment(path, geometry=False))]


def _bag(path: Path, digests: Digests) -> list[list[str]]:
    """Return what a bag is made of: one file, or those of its folder, with the name by which an experiment says what
    acts in it."""
    files = [path] if path.is_file() else sorted(p for p in path.glob("*") if p.is_file())
    if not files:
        raise LivedeformError("the bag does not exist", where=str(path), remedy="name a .mcap file or a rosbag2 folder")
    folder = [] if path.is_file() else [[path.name, ""]]
    return folder + [[file.name, digests(file)] for file in files]
