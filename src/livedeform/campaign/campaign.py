"""A campaign from its recordings to its table and its page; what is done already is not done again."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow as pa

from livedeform import outputs
from livedeform.campaign.engine import perform_all, workers
from livedeform.campaign.jobs import ROW, Job, jobs_of
from livedeform.campaign.page import write_campaign_page
from livedeform.campaign.plan import Cluster, read_plan
from livedeform.campaign.pooling import pool_jobs
from livedeform.campaign.row import read_row
from livedeform.campaign.table import read_table, rows_of, write_table
from livedeform.common.errors import InputError, LivedeformError

LOCK = ".campaign.lock"
Tell = Callable[..., None]


@dataclass(frozen=True)
class CampaignOptions:
    """``source``: a folder or a campaign.yaml; ``cores`` local workers; ``retry``: do again what failed."""

    source: Path
    out: Path
    cores: int
    retry: bool = False


@dataclass(frozen=True)
class CampaignResult:
    """The numbers of recordings, of those that were done before and now, the lines of those that failed, and those of
    what was left out of the pooled fit, by recording."""

    n: int
    n_before: int
    n_now: int
    problems: dict[str, str]
    left_out: dict[str, str] = field(default_factory=dict)


def run_campaign(options: CampaignOptions, tell: Tell) -> CampaignResult:
    """Do what is not done yet of a campaign, and write its table and its page into ``options.out``."""
    out = options.out.resolve()  # a queue's workers may begin elsewhere
    settings, recordings = read_plan(options.source, out)
    inputs = [p for r in recordings for p in (r.experiment, r.bag)]
    _refuse_others_folder(out, inputs)
    with alone_in(out), _disk_full_in_one_line(out):
        about = {"source": options.source, "cores": options.cores, "settings": settings.model_dump(mode="json")}
        outputs.write_configuration(out, outputs.configuration("campaign", about))
        tell(f"reading {len(recordings)} recordings", None)
        jobs = list(jobs_of(recordings, settings, out))
        _forget_torn_rows(jobs, tell)
        n_before = sum(job.is_done for job in jobs)
        failed, todo = _to_do(jobs, retry=options.retry)
        if n_before:
            tell(f"{n_before} of {len(jobs)} recordings are done already", None)
        failed |= _perform(todo, options.cores, settings.cluster, out, tell)
        problems = {job.recording.name: failed[job] for job in jobs if job in failed}
        tell("writing the table and the page", None)
        left_out = write_results(jobs, problems, out, title=_title(options.source.resolve()))
    n_now = len(jobs) - len(problems) - n_before
    return CampaignResult(len(jobs), n_before, n_now, problems, left_out)


def write_results(jobs: Sequence[Job], problems: dict[str, str], out: Path, *, title: str) -> dict[str, str]:
    """Write the table, what the recordings have in common, and the page; return what was left out of the pooled fit."""
    write_table(rows_of(jobs, problems), out)
    pooled = pool_jobs(jobs, out)
    write_campaign_page(read_table(out), pooled.shared, out, title, left_out=pooled.left_out)
    return pooled.left_out


def _title(source: Path) -> str:
    return source.name if source.is_dir() else source.stem


def _forget_torn_rows(jobs: Sequence[Job], tell: Tell) -> None:
    """Delete rows that cannot be read, as a disk's fault leaves them, so that their jobs are done again."""
    for job in {job.folder: job for job in jobs if job.is_done}.values():
        try:
            read_row(job.folder / ROW)
        except (OSError, IndexError, pa.ArrowException) as error:
            tell(f"{job.recording.name} is done again: its row cannot be read ({' '.join(str(error).split())})", None)
            (job.folder / ROW).unlink(missing_ok=True)


def _to_do(jobs: Sequence[Job], *, retry: bool) -> tuple[dict[Job, str], list[Job]]:
    """Sort out what failed before and would fail again, with its line, and what is to be done."""
    failures = {job: "" if retry and not job.wrong else job.failure for job in jobs if not job.is_done}
    return {job: line for job, line in failures.items() if line}, [job for job, line in failures.items() if not line]


def _perform(todo: Sequence[Job], cores: int, cluster: Cluster | None, out: Path, tell: Tell) -> dict[Job, str]:
    """Do the jobs, those of equal content once; return the lines of those that failed."""
    if not todo:
        return {}
    lines: dict[Path, str] = {}
    different = list({job.folder: job for job in todo}.values())
    n_workers = min(cores, len(different)) if cluster is None else cluster.workers
    with workers(n_workers, cluster, out) as client:
        for n, (job, ended) in enumerate(perform_all(client, different, n_workers), start=1):
            if ended.problem:
                lines[job.folder] = ended.problem
                tell(f"failed: {job.recording.name}: {ended.problem}", None)
            tell(f"{n} of {len(different)} recordings", n / len(different))
    return {job: lines[job.folder] for job in todo if job.folder in lines}


def _refuse_others_folder(out: Path, inputs: Sequence[Path]) -> None:
    """Raise ``InputError`` where ``out`` holds something that is no campaign, or would touch an input."""
    outputs.refuse_inputs([out / "jobs", out / "table.csv"], inputs)
    if out.exists() and not out.is_dir():
        raise InputError("is a file", where=str(out), remedy="name a folder with --out")
    if out.is_dir() and any(out.iterdir()):
        try:
            mine = json.loads((out / outputs.CONFIGURATION).read_text())["command"] == "campaign"
        except (OSError, ValueError, KeyError, TypeError):
            mine = (out / LOCK).exists()
        if not mine:
            raise InputError("holds something else than a campaign", where=str(out), remedy="choose another --out")


@contextmanager
def alone_in(out: Path) -> Iterator[None]:
    """Hold a campaign's folder; ``InputError`` where another campaign does. Whoever is killed lets go."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = (out / LOCK).open("a+")
    except OSError as error:
        raise InputError(f"cannot be made ({error.strerror})", where=str(out), remedy="name another --out") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            lock.seek(0)
            who = lock.read().strip() or "another process"
            remedy = "wait until it ends, or choose another --out"
            raise InputError(f"a campaign runs in it ({who})", where=str(out), remedy=remedy) from error
        with suppress(OSError):
            lock.truncate(0)
            lock.write(f"process {os.getpid()} on {os.uname().nodename}")
            lock.flush()
        yield


@contextmanager
def _disk_full_in_one_line(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in outputs.UNWRITABLE:
            raise
        what = f"cannot be written: {outputs.UNWRITABLE[error.errno]}"
        raise LivedeformError(what, where=str(out), remedy="make room, and start the campaign again") from error
