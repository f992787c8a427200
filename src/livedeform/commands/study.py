"""livedeform study."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from livedeform.studies import STUDIES
from livedeform_common.errors import InputError

ALL = "all"


def study(
    name: Annotated[str, typer.Argument(metavar="|".join([*STUDIES, ALL]), help="Which study.")],
    out: Annotated[Path | None, typer.Option(help="Folder for the results; out/study/NAME by default.")] = None,
    data: Annotated[
        Path | None, typer.Option(help="Folder of the public data sets; LIVEDEFORM_DATA by default.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace earlier results in --out.")] = False,
) -> None:
    """Repeats a study of the thesis, or one of public measurements; 'all' makes a booklet of them.

    Writes OUT/study.json, figures and index.html.

    Examples:

    livedeform study cuboid --out out/cuboid

    livedeform study all --data ../shared/data --out out/booklet
    """
    from livedeform import outputs
    from livedeform.progress import Progress

    if name not in STUDIES and name != ALL:
        known = ", ".join([*STUDIES, ALL])
        raise InputError(f"there is no study '{name}'", where="livedeform study", remedy=f"known are {known}")
    folder = out or Path("out") / "study" / name
    outputs.prepare(folder, ("study.json", "index.html"), force=force)
    outputs.write_configuration(folder, outputs.configuration("study", {"name": name, "data": data}))
    with Progress() as progress:
        if name == ALL:
            from livedeform.studies.booklet import make_booklet

            make_booklet(folder, data, progress)
        else:
            STUDIES[name](folder, data, progress)
    typer.echo(f"page: {folder / 'index.html'}")
