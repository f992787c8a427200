"""livedeform live."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from livedeform.commands.options import After, ExperimentArgument, Force, OutFolder
from livedeform.common.errors import InputError

NODES = ("stereo", "fem", "compare")


def live(
    experiment: ExperimentArgument,
    out: OutFolder,
    nodes: Annotated[str, typer.Option(help="Nodes to run here; others may run as processes of their own.")] = ",".join(
        NODES
    ),
    model: Annotated[
        Path | None,
        typer.Option(help="A fitted experiment (experiment.fitted.yaml), whose body is used."),
    ] = None,
    expected: Annotated[
        Path | None,
        typer.Option(help="A recording of poses as they will come: the model is prepared along them.", metavar="BAG"),
    ] = None,
    after: After = None,
    fail_over: Annotated[
        float | None, typer.Option(help="Exit code 1 if the rmse is over this many metres.", metavar="M")
    ] = None,
    force: Force = False,
) -> None:
    """Runs the nodes on live topics until Ctrl-C, then reports as 'run' does.

    Waits for /stereo/left/image_raw and /stereo/right/image_raw (or /stereo/markers) and /probe/pose, and says which
    are missing. ROS_DOMAIN_ID works as for any ROS node.

    Examples:

    livedeform live phantom --out out/live

    livedeform live phantom --out out/live --expected rehearsal.mcap   (ready when it is prepared along these poses)

    livedeform live phantom --out out/live --nodes compare   (stereo_node and fem_node run elsewhere)
    """
    from livedeform.commands.summary import judge, tell_metrics
    from livedeform.progress import Progress
    from livedeform.run.running import live as run_live

    names = [name.strip() for name in nodes.split(",") if name.strip()]
    unknown = [name for name in names if name not in NODES]
    if unknown:
        raise InputError(f"unknown node '{unknown[0]}'", where="--nodes", remedy=f"known are {', '.join(NODES)}")
    if expected is not None and not expected.exists():
        raise InputError("does not exist", where=str(expected), remedy="name a recording with the probe's poses")
    with Progress() as progress:
        metrics = run_live(
            experiment, out, names, model=model, after=after or (), expected=expected, force=force, tell=progress
        )
    tell_metrics(metrics, out)
    judge(metrics, fail_over)
