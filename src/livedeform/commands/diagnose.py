"""livedeform diagnose."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from livedeform.commands.summary import tell_diagnosis

WRITES = (
    "diagnosis.json",
    "experiment.fitted.yaml",
    "settings.json",
    "baselines.json",
    "report.html",
    "proposal",
)


def diagnose(
    experiment: Annotated[
        Path, typer.Argument(metavar="EXPERIMENT", help="Folder with experiment.yaml, or a YAML file.")
    ],
    fit: Annotated[list[Path], typer.Option(help="Recordings to fit: raw ones, or run.mcap.", metavar="BAG...")],
    out: Annotated[Path, typer.Option(help="Folder for the results.")],
    test: Annotated[
        list[Path] | None,
        typer.Option(
            help="Recordings that are only predicted; without them blocks of time are held out.", metavar="BAG..."
        ),
    ] = None,
    candidates: Annotated[
        str | None, typer.Option(help="Effects to try, separated by commas; all that can act by default.")
    ] = None,
    max_effects: Annotated[int, typer.Option(help="Stop after so many.", min=0, max=10)] = 3,
    seed: Annotated[int, typer.Option(help="Of every random number.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Replace earlier results in --out.")] = False,
) -> None:
    """Closes the loop: names the effect that the model lacks, adds it, and reports the error before and after.

    Writes OUT/diagnosis.json, experiment.fitted.yaml and report.html.

    Examples:

    livedeform diagnose phantom --fit monday.mcap tuesday.mcap --test wednesday.mcap --out out/why

    livedeform diagnose phantom --fit run/run.mcap --candidates stiffness,viscoelasticity --out out/why
    """
    from livedeform import outputs
    from livedeform.closed_loop.loop import diagnose as close_the_loop
    from livedeform.common.experiment.yaml_file import load_experiment
    from livedeform.progress import Progress
    from livedeform.report.diagnosis.page import write_report

    names = [name.strip() for name in candidates.split(",") if name.strip()] if candidates else None
    options = {
        "experiment": experiment,
        "fit": fit,
        "test": test or [],
        "candidates": names,
        "max_effects": max_effects,
    }
    with outputs.prepared(out, WRITES, force=force), Progress() as progress:
        result = close_the_loop(
            experiment, fit, test or [], out, candidates=names, max_effects=max_effects, seed=seed, progress=progress
        )
        progress("writing the report")
        outputs.write_configuration(out, outputs.configuration("diagnose", options, seed=seed))
        write_report(out, result, load_experiment(experiment))
    tell_diagnosis(result, out)
