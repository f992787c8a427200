"""livedeform report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from livedeform.common.errors import InputError


def report(path: Annotated[Path, typer.Argument(metavar="DIR", help="A run's folder.")]) -> None:
    """Writes the report of a run again, from its run.mcap and metrics.json: after a Ctrl-C that left it out.

    Example: livedeform report out/live
    """
    from livedeform.common.experiment.yaml_file import load_experiment
    from livedeform.outputs import RECORDING
    from livedeform.progress import Progress
    from livedeform.report.run.page import write_report

    missing = [name for name in (RECORDING, "metrics.json") if not (path / name).is_file()]
    if missing:
        remedy = "name the folder of a run; a diagnosis is reported by 'livedeform diagnose'"
        raise InputError(f"holds no {missing[0]}", where=str(path), remedy=remedy)
    with Progress() as progress:
        progress("writing the report")
        typer.echo(str(write_report(path, load_experiment(path))))
