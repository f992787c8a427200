"""livedeform campaign."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from livedeform.commands.options import OutFolder
from livedeform.common.errors import InputError

NEEDED = ("distributed", "dask_jobqueue", "cryptography", "pyarrow")  # the optional extra
SHOWN = 10  # failures that are printed; the table has all


def campaign(
    source: Annotated[
        Path, typer.Argument(metavar="FOLDER|campaign.yaml", help="Experiments with their bags, or a list of them.")
    ],
    out: OutFolder,
    cores: Annotated[
        int | None, typer.Option(help="Recordings at the same time, of one core each; all cores by default.", min=1)
    ] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Do again what failed.")] = False,
) -> None:
    """Run and diagnose every recording, and show one table, one page and what they have in common.

    Writes OUT/index.html, table.csv, table.parquet, shared.json and a folder per recording. Started again, it does what
    is missing or has changed. Exit code 1 if a recording failed.

    Examples:

    livedeform campaign phantoms --out out/all

    livedeform campaign campaign.yaml --out out/all --cores 4 --retry
    """
    _refuse_without_extra()
    from livedeform.campaign.campaign import CampaignOptions, run_campaign
    from livedeform.progress import Progress

    options = CampaignOptions(source, out, cores or len(os.sched_getaffinity(0)), retry)
    with Progress() as progress:
        result = run_campaign(options, progress)
    n_failed = len(result.problems)
    typer.echo(f"{result.n} recordings: {result.n_now} done now, {result.n_before} before, {n_failed} failed")
    for name, line in list(result.problems.items())[:SHOWN]:
        typer.echo(f"  {name}: {line}")
    if n_failed > SHOWN:
        typer.echo(f"  and {n_failed - SHOWN} more: see the column 'problem' of the table")
    for name, line in result.left_out.items():
        typer.echo(f"  {name} is left out of what recordings have in common: {line}")
    typer.echo(f"page: {out / 'index.html'}")
    if n_failed:
        raise typer.Exit(1)


def _refuse_without_extra() -> None:
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        remedy = "pip install 'livedeform[campaign]'"
        raise InputError(f"{', '.join(missing)} is not installed", where="campaign", remedy=remedy)
