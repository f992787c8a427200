"""livedeform demo."""

from __future__ import annotations

from pathlib import Path

import typer

from livedeform.commands.options import Force, OutFolder


def demo(
    out: OutFolder = Path("out/demo"),
    force: Force = False,
) -> None:
    """The main job on the shipped experiment: replays its bag, closes the loop, and runs again with the fitted model.

    Writes OUT/before (the declared model), OUT/diagnosis (what it lacks) and OUT/after (the fitted model).

    Example: livedeform demo --out out/demo
    """
    from livedeform.demo import demonstrate
    from livedeform.progress import Progress

    with Progress() as progress:
        lines = demonstrate(out, force, progress)
    for line in lines:
        typer.echo(line)
