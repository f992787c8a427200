"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

After = Annotated[
    list[Path] | None,
    typer.Option(
        help="Recordings that the body went through before, the earliest first; they count where the model has a "
        "plastic set.",
        metavar="BAG...",
    ),
]
