"""livedeform info and livedeform recover."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from livedeform.inspection import Report, TopicReport


def info(
    path: Annotated[Path, typer.Argument(help="A bag, an experiment, a run's or a diagnosis's folder.")],
    experiment: Annotated[Path | None, typer.Option(help="Say also whether the bag fits this experiment.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show what a bag, an experiment or a run holds, and whether it is sound.

    Exit code 1 if it cannot be used as it is.

    Example: livedeform info recording.mcap --experiment my-phantom
    """
    from livedeform.inspection import inspect

    report = inspect(path, experiment)
    if as_json:
        typer.echo(json.dumps(_without_nan({**asdict(report), "sound": report.sound}), indent=1))
    else:
        _show(report)
    if not report.sound:
        raise typer.Exit(1)


def recover(
    path: Annotated[Path, typer.Argument(help="A torn .mcap file, or a folder of them.")],
    out: Annotated[Path, typer.Option(help="The new bag: x.mcap, or a folder.")],
) -> None:
    """Copies what can be read of a torn recording into a new bag.

    Example: livedeform recover run.mcap --out recovered.mcap
    """
    from livedeform.common.bags.recover import recover as copy

    report = copy(path, out)
    share = 100.0 * report.n_bytes_read / max(report.n_bytes, 1)
    damaged = f", {report.n_bad_chunks} damaged chunks left out" if report.n_bad_chunks else ""
    typer.echo(f"{out}: {report.n_messages} messages recovered from {share:.1f} % of the file{damaged}")


def schema() -> None:
    """Prints the JSON schema of experiment.yaml, for editors.

    Example: livedeform schema > experiment.schema.json
    """
    from livedeform.common.experiment.yaml_file import json_schema

    typer.echo(json.dumps(json_schema(), indent=1))


def _without_nan(value: object) -> object:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _show(report: Report) -> None:
    typer.echo(f"{report.kind} {report.path}")
    width = max((len(name) for name in report.facts), default=0)
    for name, value in report.facts.items():
        typer.echo(f"  {name:{width}}  {value}")
    if report.topics:
        _table(
            ["topic", "type", "messages", "Hz", "gaps", "longest s", "back", "double", "delay s"],
            [_row(topic) for topic in report.topics],
        )
    if report.protocol:
        words = {True: "yes", False: "no", None: "?"}
        _table(
            ["protocol for a press", "asks", "found", "kept"],
            [[step.name, step.asks, step.found, words[step.kept]] for step in report.protocol],
            4,
        )
    for finding in report.findings:
        typer.echo(f"{finding.level:6}{finding.text}" + (f"; {finding.remedy}" if finding.remedy else ""))
    typer.echo("sound" if report.sound else "cannot be used as it is")


def _row(topic: TopicReport) -> list[str]:
    kind = topic.note or topic.type
    counts = [topic.n_gaps, topic.n_backwards, topic.n_duplicates]
    gaps, back, double = (str(n) if n else "-" for n in counts)
    numbers = [
        _number(topic.rate_hz, 1),
        gaps,
        _number(topic.longest_gap_s, 3),
        back,
        double,
        _number(topic.offset_s, 3),
    ]
    return [topic.name, kind, str(topic.count), *numbers]


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _table(columns: list[str], rows: list[list[str]], n_text: int = 2) -> None:
    """A table on a terminal, aligned plain text elsewhere; the first ``n_text`` columns are text."""
    import sys

    if sys.stdout.isatty():
        from rich.console import Console
        from rich.table import Table

        table = Table()
        for i, column in enumerate(columns):
            table.add_column(column, justify="left" if i < n_text else "right", overflow="fold")
        for row in rows:
            table.add_row(*row)
        Console().print(table)
        return
    widths = [max(len(line[i]) for line in [columns, *rows]) for i in range(len(columns))]
    for line in [columns, *rows]:
        cells = [f"{cell:{'<' if i < n_text else '>'}{widths[i]}}" for i, cell in enumerate(line)]
        typer.echo("  " + "  ".join(cells).rstrip())
