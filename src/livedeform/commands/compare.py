"""livedeform compare."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from livedeform.commands.options import Force
from livedeform.common.errors import InputError

if TYPE_CHECKING:
    from livedeform.comparing.runs import ComparedRun, Difference

WRITES = ("compare.html", "compare.json", "runs.csv", "markers.csv")


def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Runs' folders; the first is the reference.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the page and the tables; without it, print only.")
    ] = None,
    force: Force = False,
) -> None:
    """Put runs side by side: their errors, and the differences to the first, paired by stamp and marker.

    Runs of several recordings with one model are takes: what they let expect of the next one is said as well.

    Writes OUT/compare.html, compare.json, runs.csv and markers.csv.

    Example: livedeform compare out/before out/after --out out/both
    """
    from livedeform import outputs
    from livedeform.comparing.page import write_comparison
    from livedeform.comparing.runs import compared, load_runs

    if len(runs) < 2:
        raise InputError("one run has nothing to be compared with", where="RUN", remedy="name two runs or more")
    loaded = load_runs(runs)
    differences = [compared(loaded[0], run) for run in loaded[1:]]
    _tell(loaded, differences)
    if out is not None:
        with outputs.prepared(out, WRITES, force=force, inputs=list(runs)) as draft:
            outputs.write_configuration(draft, outputs.configuration("compare", {"runs": runs, "out": out}))
            write_comparison(draft, loaded, differences)
        typer.echo(f"page: {out / 'compare.html'}")


def _tell(loaded: Sequence[ComparedRun], differences: Sequence[Difference | None]) -> None:
    """The runs, their differences to the first, and what takes let expect of the next."""
    from livedeform.comparing import page

    _print_table(page.HEADER, [page.table_row(run) for run in loaded])
    if any(differences):
        typer.echo(f"against {loaded[0].name}, paired by stamp and marker:")
        _print_table(page.AGAINST, [page.against_row(d) for d in differences if d is not None])
    for run, difference in zip(loaded[1:], differences, strict=True):
        if difference is None:
            typer.echo(
                f"{run.name} is not paired with {loaded[0].name}: another recording, no marker or no moment in common"
            )
        else:
            typer.echo(page.sentence(difference, loaded[0].name))
    for name in page.parts_of(loaded):
        typer.echo(f"{name} ran only a part of its recording: it is no take")
    takes = page.takes_of(loaded)
    if takes:
        freedom = takes[0].expected["rmse"].freedom
        typer.echo(f"takes with one model (scatter between takes with {freedom:g} degrees of freedom):")
        _print_table(page.TAKES, [page.takes_row(t) for t in takes])


def _print_table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """Aligned text: the first column flush left."""
    widths = [max(len(line[i]) for line in [header, *rows]) for i in range(len(header))]
    for line in [header, *rows]:
        cells = [f"{cell:{'<' if i == 0 else '>'}{widths[i]}}" for i, cell in enumerate(line)]
        typer.echo("  " + "  ".join(cells).rstrip())
