"""livedeform diagnose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from livedeform.commands.options import ExperimentArgument, Force, OutFolder
from livedeform.commands.summary import tell_diagnosis
from livedeform.common.errors import InputError

if TYPE_CHECKING:
    from livedeform.closed_loop.diagnosis import Diagnosis

WRITES = (
    "diagnosis.json",
    "experiment.fitted.yaml",
    "settings.json",
    "baselines.json",
    "linearised.npz",
    "report.html",
    "proposal",
)


def diagnose(
    experiment: ExperimentArgument,
    fit: Annotated[list[Path], typer.Option(help="Recordings to fit: raw ones, or run.mcap.", metavar="BAG...")],
    out: OutFolder,
    test: Annotated[
        list[Path] | None,
        typer.Option(
            help="Recordings that are only predicted; without them blocks of time are held out.", metavar="BAG..."
        ),
    ] = None,
    candidates: Annotated[
        str | None, typer.Option(help="Effects to try, separated by commas; all that can act by default.")
    ] = None,
    max_effects: Annotated[
        int | None, typer.Option(help="Stop after so many; 3 by default, 6 of a body that is let go.", min=0, max=10)
    ] = None,
    seed: Annotated[int, typer.Option(help="Of every random number.")] = 0,
    budget: Annotated[
        float | None,
        typer.Option(
            help="Seconds after which nothing more is begun: the best answer so far, with what was not tried."
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Close the loop: name the effect that the model lacks, add it, and report the error before and after.

    Writes OUT/diagnosis.json, experiment.fitted.yaml and report.html.

    Examples:

    livedeform diagnose phantom --fit monday.mcap tuesday.mcap --test wednesday.mcap --out out/why

    livedeform diagnose phantom --fit run/run.mcap --candidates stiffness,viscoelasticity --out out/why

    livedeform diagnose phantom --fit monday.mcap --budget 60 --out out/quick
    """
    from livedeform.progress import Progress

    names = [name.strip() for name in candidates.split(",") if name.strip()] if candidates else None
    options: dict[str, Any] = {"candidates": names, "max_effects": max_effects, "seed": seed, "budget": budget}
    if budget is not None and not budget > 0.0:
        raise InputError(f"{budget:g} s is no time", where="--budget", remedy="give seconds, as 60")
    with Progress() as progress:
        result = diagnose_into(out, force, experiment, fit, test or [], progress, **options)
    tell_diagnosis(result, out)


def diagnose_into(
    out: Path,
    force: bool,
    experiment: Path,
    fit: Sequence[Path],
    test: Sequence[Path],
    progress: Callable[..., None],
    **options: Any,
) -> Diagnosis:
    """Write a diagnosis and its report into ``out``; ``options`` are the loop's."""
    from livedeform import outputs
    from livedeform.closed_loop.loop import diagnose as close_the_loop
    from livedeform.common.experiment.yaml_file import files_of, load_experiment
    from livedeform.report.diagnosis.page import write_report

    declared = load_experiment(experiment)
    said = {"experiment": experiment, "fit": fit, "test": test} | {k: v for k, v in options.items() if k != "seed"}
    inputs = [*files_of(declared), *fit, *test]
    with outputs.prepared(out, WRITES, force=force, inputs=inputs) as draft:
        result = close_the_loop(experiment, fit, test, draft, **options, progress=progress)
        progress("writing the report")
        outputs.write_configuration(draft, outputs.configuration("diagnose", said, seed=options["seed"]))
        write_report(draft, result, declared)
    return result
