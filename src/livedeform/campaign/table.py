"""The table of a campaign: one row per recording, gathered from the jobs' rows a few at a time."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq

from livedeform.campaign.jobs import ROW, Job
from livedeform.campaign.row import SCHEMA, Row, failed_row, read_row

PARQUET, CSV = "table.parquet", "table.csv"
BATCH = 1000  # rows that are in memory at a time, and of a row group


def rows_of(jobs: Iterable[Job], problems: dict[str, str]) -> Iterator[Row]:
    """Give the rows of the jobs in their order; ``problems``: the lines of those that failed, by recording."""
    for job in jobs:
        recording = job.recording
        labels = {"recording": recording.name, "phantom": recording.phantom, "rig": recording.rig, "key": job.key}
        problem = problems.get(recording.name, "" if job.is_done else "not done yet")
        try:
            yield labels | (failed_row(problem) if problem else read_row(job.folder / ROW))
        except (OSError, pa.ArrowException) as error:  # a disk's fault: it was written whole
            yield labels | failed_row(f"{job.folder / ROW}: cannot be read ({error}); delete the folder")


def write_table(rows: Iterable[Row], out: Path) -> int:
    """Write ``table.parquet`` and ``table.csv`` into ``out``, whole or not at all; return how many rows they have.

    Equal rows make equal files, byte for byte.
    """
    drafts = {name: out / f".{name}.draft-{os.getpid()}" for name in (PARQUET, CSV)}
    n = 0
    try:
        with (
            pq.ParquetWriter(drafts[PARQUET], SCHEMA, compression="zstd", store_schema=False) as parquet,
            pc.CSVWriter(drafts[CSV], SCHEMA) as csv,
        ):
            waiting = iter(rows)
            while batch := list(islice(waiting, BATCH)):
                table = pa.Table.from_pylist(batch, SCHEMA)
                parquet.write_table(table)
                csv.write_table(table)
                n += len(table)
        for name, draft in drafts.items():
            draft.replace(out / name)
    finally:
        for draft in drafts.values():
            draft.unlink(missing_ok=True)
    return n


def read_table(out: Path) -> Iterator[dict[str, Any]]:
    """Give the rows of a table that is written, a batch in memory at a time."""
    with pq.ParquetFile(out / PARQUET) as file:
        for batch in file.iter_batches(BATCH):
            yield from batch.to_pylist()
