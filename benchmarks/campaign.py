"""Figures of a campaign: equal tables, throughput, overhead per job, cost per recording, pooling.

    python -m benchmarks.campaign workers EXPERIMENT --bags BAG... [--copies 4]   # 1, 2 and 4 workers
    python -m benchmarks.campaign overhead EXPERIMENT --bag BAG
    python -m benchmarks.campaign rows [--most 10000]                              # of table and page
    python -m benchmarks.campaign pooling [--seeds 20]

`workers` runs each recording under ``--copies`` names, with a byte of its own in each copy, since equal content is done
once. Every figure is CPU time of this process and its children beside the wall clock: on a shared machine only the
first says something.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import resource
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks import pooling
from livedeform.campaign.campaign import CampaignOptions, run_campaign
from livedeform.campaign.page import PAGE, write_campaign_page
from livedeform.campaign.row import MEASURED, Row, read_row, write_row
from livedeform.campaign.table import CSV, PARQUET, read_table, write_table

RUN = {"at_frames": True}


def cpu() -> float:
    """CPU seconds of this process and of its children that have ended."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in both)


def quiet(text: str, fraction: float | None = None) -> None:
    """Show failures only."""
    if text.startswith("failed"):
        print(text, flush=True)


# --- tables of 1, 2 and 4 workers, and throughput --------------------------------------------------------------------


def laboratory(folder: Path, experiment: Path, bags: Sequence[Path], copies: int, steps: dict[str, Any]) -> Path:
    """Copy an experiment and its bags, ``copies`` times; return the campaign's folder."""
    for k in range(copies):
        home = folder / f"phantom-{k}"
        shutil.copytree(experiment, home)
        with (home / "experiment.yaml").open("a") as file:
            file.write(f"\n# copy {k}\n")  # equal content would be done once
        for bag in bags:
            (shutil.copytree if bag.is_dir() else shutil.copy)(bag, home / bag.name)
    (folder / "campaign.yaml").write_text(json.dumps({"version": 1, **steps}))
    return folder


def workers(experiment: Path, bags: Sequence[Path], copies: int, diagnose: bool) -> None:
    """Print that 1, 2 and 4 workers give equal tables, and the recordings per core and hour of each."""
    steps: dict[str, Any] = {"run": RUN} if diagnose else {"run": RUN, "diagnose": None}
    with tempfile.TemporaryDirectory() as place:
        source = laboratory(Path(place) / "laboratory", experiment, bags, copies, steps)
        digests = {}
        for n in (1, 2, 4):
            out = Path(place) / f"out-{n}"
            wall = time.perf_counter()
            result = run_campaign(CampaignOptions(source, out, n), quiet)
            wall = time.perf_counter() - wall
            costs = [json.loads(p.read_text()) for p in out.glob("jobs/*/cost.json")]
            jobs = sum(c["cpu_s"] for c in costs)
            digests[n] = [hashlib.sha256((out / name).read_bytes()).hexdigest()[:12] for name in (PARQUET, CSV)]
            print(
                f"{n} workers: {result.n_now} recordings, {wall:.1f} s, jobs {jobs:.1f} s of CPU; "
                f"cores are at work on jobs {jobs / wall / min(n, os.cpu_count() or 1):.2f} of the time; "
                f"table {digests[n]}",
                flush=True,
            )
        print("tables are equal" if len({tuple(d) for d in digests.values()}) == 1 else "TABLES DIFFER")


def overhead(experiment: Path, bag: Path, n: int = 4) -> None:
    """Print the CPU of a job beyond that of the same run in a process that has done it before."""
    from livedeform.run.running import RunOptions, run_into

    with tempfile.TemporaryDirectory() as place:
        work = []
        for k in range(2):
            start = cpu()
            run_into(RunOptions(experiment, bag, Path(place) / f"run-{k}", **RUN), quiet)
            work.append(cpu() - start)
        source = laboratory(Path(place) / "laboratory", experiment, [bag], n, {"run": RUN, "diagnose": None})
        start = time.process_time()
        run_campaign(CampaignOptions(source, Path(place) / "out", 1), quiet)
        own = (time.process_time() - start) / n
        jobs = [json.loads(p.read_text())["cpu_s"] for p in (Path(place) / "out").glob("jobs/*/cost.json")]
    mean = sum(jobs) / n
    print(f"a run takes {work[0]:.2f} s of CPU in a new process without its imports, {work[1]:.2f} s the second time")
    print(f"a job takes {mean:.2f} s, and {own:.2f} s of the scheduler: {mean + own - work[1]:.2f} s more (goal 3)")


# --- cost per row ----------------------------------------------------------------------------------------------------

EFFECTS = ("stiffness", "viscoelasticity", "skin", "stereo_scale", "camera_motion", "density", "probe_offset")


def synthetic_rows(n: int) -> Iterator[Row]:
    """Rows of a table, 20 recordings to a phantom."""
    rng = random.Random(0)
    for i in range(n):
        labels = {"recording": f"phantom-{i // 20:04d}/take-{i % 20:02d}", "phantom": f"phantom-{i // 20:04d}"}
        yield {**labels, "rig": f"rig-{i % 3}", "key": f"{i:024x}", **synthetic_row(rng)}


def synthetic_row(rng: random.Random) -> Row:
    """A row of a recording that was run and diagnosed, or failed."""
    row: Row = dict.fromkeys(MEASURED.names)
    if rng.random() < 0.02:
        return row | {"status": "failed", "problem": "take.mcap: the bag is broken; livedeform recover mends it"}
    before = rng.lognormvariate(-6.5, 0.5)
    name = rng.choice(EFFECTS)
    return row | {
        "status": "done",
        "started_ns": 1_700_000_000_000_000_000 + rng.randrange(10**16),
        "duration_s": 20.0,
        "run_verdict": rng.choice(["OK", "OK", "WARN", "ERROR"]),
        "frames_compared": 200,
        "frames_measured": 200,
        "coverage": rng.uniform(0.8, 1.0),
        "rmse_m": before,
        "noise_floor_m": 1e-4,
        "verdict": rng.choice(["effect", "effect", "none", "undecided", "unexplained"]),
        "error_before_m": before,
        "error_after_m": before * rng.uniform(0.1, 1.0),
        "effects": f"{name}: ratio {rng.uniform(0.5, 2):.3g} [{rng.uniform(0.4, 0.5):.3g}, {rng.uniform(2, 3):.3g}]",
        "effects_json": "[]",
        "rivals": rng.choice(["", "", rng.choice(EFFECTS)]),
        "unexplained": "What is left is explained by noise.",
        "version": "0",
    }


def rows(most: int, keep: Path | None) -> None:
    """Print what gathering and the page cost per recording, over 10 to ``most`` recordings."""
    with tempfile.TemporaryDirectory() as place:
        rng, file, n = random.Random(0), Path(place) / "row.parquet", 200
        start = cpu()
        for _ in range(n):
            write_row(synthetic_row(rng), file)
        written, start = cpu() - start, cpu()
        for _ in range(n):
            read_row(file)
        read = cpu() - start
        print(
            f"a job's own row: {1e3 * written / n:.2f} ms of CPU to write, {1e3 * read / n:.2f} ms to read", flush=True
        )
    n = 10
    while n <= most:
        with tempfile.TemporaryDirectory() as place:
            out = keep or Path(place)
            out.mkdir(parents=True, exist_ok=True)
            given = list(synthetic_rows(n))
            start = cpu()
            write_table(iter(given), out)
            table, start = cpu() - start, cpu()
            write_campaign_page(read_table(out), [], out, f"{n} recordings")
            page = cpu() - start
            sizes = ", ".join(f"{name} {(out / name).stat().st_size / n:.0f} B" for name in (PARQUET, CSV, PAGE))
        print(
            f"{n} recordings: per recording {1e3 * table / n:.3f} ms of CPU for the table, "
            f"{1e3 * page / n:.3f} ms for the page; {sizes}",
            flush=True,
        )
        n *= 10


def main() -> None:
    """Print the figures that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="figure", required=True)
    of_workers = commands.add_parser("workers")
    of_workers.add_argument("experiment", type=Path)
    of_workers.add_argument("--bags", type=Path, nargs="+", required=True)
    of_workers.add_argument("--copies", type=int, default=4)
    of_workers.add_argument("--diagnose", action="store_true")
    of_overhead = commands.add_parser("overhead")
    of_overhead.add_argument("experiment", type=Path)
    of_overhead.add_argument("--bag", type=Path, required=True)
    of_rows = commands.add_parser("rows")
    of_rows.add_argument("--most", type=int, default=10_000)
    of_rows.add_argument("--keep", type=Path, help="Keep table and page here.")
    of_pooling = commands.add_parser("pooling")
    of_pooling.add_argument("--seeds", type=int, default=20)
    asked = parser.parse_args()
    if asked.figure == "workers":
        workers(asked.experiment, asked.bags, asked.copies, asked.diagnose)
    elif asked.figure == "overhead":
        overhead(asked.experiment, asked.bag)
    elif asked.figure == "rows":
        rows(asked.most, asked.keep)
    else:
        pooling.figures(asked.seeds)


if __name__ == "__main__":
    main()
