"""Dask does the jobs: on processes here, or on workers that dask-jobqueue submits to a queue.

A Dask worker keeps a fork server (of the standard library) in which everything heavy is imported once. Each job is a
fresh copy of that: memory, threads and crashes are its own, and it starts in no time.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

from livedeform.campaign.jobs import Job
from livedeform.campaign.plan import Cluster
from livedeform.campaign.work import ONE_THREAD, Outcome, outcome, work
from livedeform.common.errors import InputError

AHEAD = 4  # jobs per worker that are handed over before they can begin: the scheduler stays small
PATIENCE = 600  # s in which a worker of a queue must find the scheduler, imports from a slow disk included
TRIES = 3  # of a job whose process or worker is killed
PRELOADED = {  # what a job of these steps needs, imported once per worker
    "": ("livedeform.campaign.work", "livedeform.common.bags.recording"),
    "run": ("livedeform.run.running", "livedeform.report.run.page", "plotly.offline"),
    "diagnose": ("livedeform.closed_loop.loop", "livedeform.report.diagnosis.page", "plotly.offline"),
}
DASK = {
    "distributed.worker.daemon": False,  # a worker has a process per job
    "distributed.scheduler.allowed-failures": TRIES,
    "distributed.scheduler.work-stealing": False,
    "distributed.worker.memory.terminate": False,  # the job is the system's to limit, or the queue's
    "distributed.worker.memory.pause": False,
    "distributed.comm.timeouts.connect": "120s",  # on a busy machine
    "distributed.admin.tick.limit": "1h",
    "distributed.admin.tick.interval": "1s",  # jobs take seconds at least: nobody wakes 50 times in one
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.worker.profile.enabled": False,
}


class Killed(Exception):
    """A job's process was killed, or could not write: another try may do."""


def perform(job: Job) -> Outcome:
    """Do a job in a fresh process of this worker's, and tell how it ended; raises `Killed` where to try again."""
    process = _server(job.options).Process(target=work, args=(job,))
    process.start()
    process.join()
    ended = outcome(job, process.exitcode)
    if ended.passing:
        raise Killed(ended.problem)
    return ended


def _server(steps: Mapping[str, Any]) -> ForkServerContext:
    """Return this process's fork server, with what jobs of these ``steps`` need already imported."""
    os.environ.update(ONE_THREAD)
    context = multiprocessing.get_context("forkserver")
    wanted = [step for step in PRELOADED if not step or steps.get(step) is not None]
    context.set_forkserver_preload([module for step in wanted for module in PRELOADED[step]])
    return context


@contextmanager
def workers(cores: int, cluster: Cluster | None, out: Path) -> Iterator[Any]:
    """Yield a Dask client with so many local workers, or with those of a queue, of one core each.

    Who reaches the scheduler's port may run what he likes: it lets in only who has this campaign's certificate, which
    is of this user's own, in memory or, for a queue, in the folder ``out``.
    """
    import dask
    from distributed import Client, LocalCluster

    with dask.config.set(DASK):
        if cluster is None:
            options: dict[str, Any] = {"threads_per_worker": 1, "memory_limit": 0, "dashboard_address": "127.0.0.1:0"}
            options["silence_logs"] = logging.CRITICAL  # what happens to a job is told with the job
            made = LocalCluster(n_workers=cores, security=True, **options)
        else:
            made = _queue(cluster, out)
        with made, Client(made) as client:
            yield client


def _queue(cluster: Cluster, out: Path) -> Any:
    """Submit workers of one core to a queue; each takes jobs until there are none."""
    import dask_jobqueue

    names = [name for name in dir(dask_jobqueue) if name.endswith("Cluster")]
    kinds = {name.removesuffix("Cluster").lower(): getattr(dask_jobqueue, name) for name in names}
    if cluster.kind not in kinds:
        known = ", ".join(sorted(kinds))
        raise InputError(f"unknown queue '{cluster.kind}'", where="cluster.kind", remedy=f"known are {known}")
    own = [f"export {name}={value}" for name, value in ONE_THREAD.items()]
    own += [f"export {_variable(key)}={value}" for key, value in DASK.items() if ".scheduler." not in key]
    places = {"shared_temp_directory": str(out), "log_directory": str(out / "workers")}
    usual = {"cores": 1, "processes": 1, "memory": "4GB", "death_timeout": PATIENCE, "security": True}
    options = {**usual, **places, **cluster.options}
    options["job_script_prologue"] = [*options.get("job_script_prologue", ()), *own]
    made = kinds[cluster.kind](**options)
    made.adapt(minimum_jobs=cluster.workers, maximum_jobs=cluster.workers)  # a worker whose time is up is replaced
    return made


def _variable(key: str) -> str:
    """Return the environment variable by which a process of a queue is told a setting of Dask's."""
    return "DASK_" + key.replace(".", "__").replace("-", "_").upper()


def perform_all(client: Any, jobs: Sequence[Job], n_workers: int) -> Iterator[tuple[Job, Outcome]]:
    """Do all jobs, and give each with how it ended, in the order in which they end."""
    from distributed import as_completed

    waiting = iter(jobs)
    of_future: dict[str, Job] = {}
    done = as_completed()

    def hand_over() -> None:
        job = next(waiting, None)
        if job is not None:
            future = client.submit(perform, job, key=f"{job.recording.name}-{job.key}", retries=TRIES - 1)
            of_future[future.key] = job
            done.add(future)

    for _ in range(AHEAD * n_workers):
        hand_over()
    for future in done:
        hand_over()
        job = of_future.pop(future.key)
        yield job, _outcome(future)


def _outcome(future: Any) -> Outcome:
    if future.status == "finished":
        ended: Outcome = future.result()
        return ended
    error = future.exception()
    line = str(error) if isinstance(error, Killed) else f"its worker was killed {TRIES} times ({type(error).__name__})"
    return Outcome(line, passing=True)
