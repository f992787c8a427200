"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ExperimentArgument = Annotated[
    Path, typer.Argument(metavar="EXPERIMENT", help="Folder with experiment.yaml, or a YAML file.")
]
OutFolder = Annotated[Path, typer.Option(help="Folder for the results.")]
Force = Annotated[bool, typer.Option("--force", help="Replace earlier results in --out.")]
After = Annotated[
    list[Path] | None,
    typer.Option(
        help="Recordings that the body went through before, the earliest first; they count where the model has a "
        "plastic set.",
        metavar="BAG...",
    ),
]
