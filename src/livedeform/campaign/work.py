"""One job, in a process of its own on one core: run, diagnose, and the row that says that it is done."""

from __future__ import annotations

import ctypes
import fcntl
import json
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any

from livedeform.campaign.jobs import FAILURE, ROW, ChangedError, Job, refuse_changed
from livedeform.campaign.row import row_of, write_row
from livedeform.common.errors import LivedeformError
from livedeform.outputs import UNWRITABLE, write_json

LOG, COST, LOCK = "log.txt", "cost.json", ".lock"
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
ONE_THREAD = dict.fromkeys(THREADS, "1")


@dataclass(frozen=True)
class Outcome:
    """The end of a job: ``problem`` is the one line of a failure, which is ``passing`` where another try may do (a full
    disk, a process that was killed)."""

    problem: str = ""
    passing: bool = False


def work(job: Job) -> None:
    """Do a job in this process, which does not outlive its worker; its folder then holds a row or a failure."""
    _end_with_the_worker()
    job.folder.mkdir(parents=True, exist_ok=True)
    with _alone(job.folder):
        if job.is_done:
            return
        _clear(job.folder)
        with _said_to(job.folder / LOG):
            start = time.perf_counter()
            try:
                refuse_changed(job)
                row = _steps(job)
                refuse_changed(job)
                _write_cost(job.folder, time.perf_counter() - start)
                write_row(row, job.folder / ROW)
            except BaseException as error:
                _clear(job.folder, keep=(LOG,))
                with suppress(OSError):
                    _write_failure(job.folder, error)
                raise SystemExit(1) from error


def _end_with_the_worker() -> None:
    """End this process as soon as the worker has, which is not its parent: between them is the fork server, and that
    stays for as long as it has children."""
    worker = multiprocessing.parent_process()
    if worker is None:  # not started by one
        return

    def watch() -> None:
        connection.wait([worker.sentinel])
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def outcome(job: Job, exit_code: int | None) -> Outcome:
    """Tell how the job's process ended, from what it left."""
    if job.is_done:
        return Outcome()
    try:
        said = json.loads((job.folder / FAILURE).read_text())
        return Outcome(said["problem"], said["passing"])
    except (OSError, ValueError, KeyError):
        pass
    if exit_code is not None and exit_code < 0:
        return Outcome(f"its process was ended by {signal.Signals(-exit_code).name}", True)
    return Outcome("its process ended without a word: is the disk full?", True)


def _steps(job: Job) -> dict[str, Any]:
    """Run and diagnose the recording as the options say; return its row."""
    from livedeform.common.bags.read import read_bag
    from livedeform.common.bags.recording import stamp_range

    recording, options = job.recording, job.options
    with read_bag(recording.bag) as bag:
        times = stamp_range(bag)
    metrics = diagnosis = None
    if options["run"] is not None:
        metrics = _run(job, options["run"])
    if options["diagnose"] is not None:
        diagnosis = _diagnose(job, options["diagnose"])
    return row_of(metrics, diagnosis, times)


def _run(job: Job, options: dict[str, Any]) -> dict[str, Any]:
    from livedeform.run.running import RunOptions, run_into

    out = job.folder / "run"
    run_into(RunOptions(job.recording.experiment, job.recording.bag, out, **options), _tell)
    return dict(json.loads((out / "metrics.json").read_text()))


def _diagnose(job: Job, options: dict[str, Any]) -> dict[str, Any]:
    from livedeform.commands.diagnose import diagnose_into

    ran = job.folder / "run" / "run.mcap"
    bag = ran if ran.is_file() else job.recording.bag  # pictures are measured once
    diagnose_into(job.folder / "diagnosis", False, job.recording.experiment, [bag], [], _tell, processes=1, **options)
    return dict(json.loads((job.folder / "diagnosis" / "diagnosis.json").read_text()))


def _tell(text: str, fraction: float | None = None) -> None:
    if fraction is None:
        sys.stderr.write(text + "\n")


def _write_failure(folder: Path, error: BaseException) -> None:
    cause = error if isinstance(error, OSError) else error.__cause__
    passing = isinstance(error, ChangedError) or (isinstance(cause, OSError) and cause.errno in UNWRITABLE)
    if isinstance(error, OSError) and passing:
        line = f"{folder}: cannot be written: {UNWRITABLE[error.errno or 0]}"
    elif isinstance(error, LivedeformError):
        line = str(error)
    elif isinstance(error, KeyboardInterrupt | SystemExit):
        line, passing = "stopped", True
    else:
        line = f"internal error, {type(error).__name__}: {' '.join(str(error).split())}"
    write_json(folder / FAILURE, {"problem": line, "passing": passing})


def _write_cost(folder: Path, seconds: float) -> None:
    """Return what the job took, which is no part of its row: two runs of it would differ."""
    own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    cpu = own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime
    write_json(folder / COST, {"cpu_s": round(cpu, 3), "wall_s": round(seconds, 3)})


def _clear(folder: Path, keep: tuple[str, ...] = ()) -> None:
    """Remove what an attempt left."""
    for path in folder.iterdir():
        if path.name not in (LOCK, *keep):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Wait until nobody else works in the folder: a worker that lost its scheduler may still be at it."""
    with (folder / LOCK).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextmanager
def _said_to(path: Path) -> Iterator[None]:
    """Let everything that is printed, by libraries too, go to a file."""
    sys.stdout.flush()
    with path.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    try:
        yield
    finally:
        ctypes.CDLL(None).fflush(None)
