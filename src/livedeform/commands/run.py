"""livedeform run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from livedeform.commands.options import After, ExperimentArgument, Force, OutFolder
from livedeform.common.errors import InputError

Rate = Annotated[str, typer.Option(help="Speed of the replay: 1.0 is real time; max plays in lock step, reproducibly.")]
Model = Annotated[Path | None, typer.Option(help="A fitted experiment (experiment.fitted.yaml), whose body is used.")]
Repeat = Annotated[
    list[Path] | None,
    typer.Option(
        help="Runs (folders) of other takes of the same press with the same model: how takes differ gives the interval "
        "of the next one.",
        metavar="RUN...",
    ),
]
FailOver = Annotated[float | None, typer.Option(help="Exit code 1 if the rmse is over this many metres.", metavar="M")]


def run(
    experiment: ExperimentArgument,
    bag: Annotated[Path, typer.Option(help="Recording to replay: a .mcap file or a rosbag2 folder.")],
    out: OutFolder,
    rate: Rate = "max",
    start: Annotated[float, typer.Option(help="Seconds to leave out at the start.", min=0.0)] = 0.0,
    duration: Annotated[float | None, typer.Option(help="Seconds to play; all by default.", min=0.0)] = None,
    model: Model = None,
    at_frames: Annotated[
        bool, typer.Option("--at-frames", help="Predict once per measured frame instead of at every pose: faster.")
    ] = False,
    after: After = None,
    repeat: Repeat = None,
    fail_over: FailOver = None,
    force: Force = False,
) -> None:
    """Replay a bag through the three nodes and report the error of the model.

    Writes OUT/run.mcap (everything that was published), metrics.json, markers.csv and report.html.

    Examples:

    livedeform run bags/breast --bag bags/breast/press.mcap --out out/run

    livedeform run out/why/experiment.fitted.yaml --bag b.mcap --after a.mcap --out out/better

    livedeform run phantom --bag take2.mcap --repeat out/take1 --out out/take2

    livedeform run phantom --bag take.mcap --out out/real --rate 1.0 --duration 20 --fail-over 0.003
    """
    from livedeform.commands.summary import judge, tell_metrics
    from livedeform.progress import Progress
    from livedeform.run.running import RunOptions, run_into

    speed, before, repeats = parse_rate(rate), tuple(after or ()), tuple(repeat or ())
    options = RunOptions(experiment, bag, out, speed, start, duration, model, force, at_frames, before, repeats)
    with Progress() as progress:
        metrics, place = run_into(options, progress)
    tell_metrics(metrics, place)
    judge(metrics, fail_over)


def parse_rate(text: str) -> float | None:
    """Return a positive number, or None for "max"; raises InputError otherwise."""
    if text == "max":
        return None
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0.0 < rate < 1e3:
        raise InputError(f"'{text}' is not a speed", where="--rate", remedy="write --rate 1.0, or --rate max")
    return rate
