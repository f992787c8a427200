"""livedeform export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from livedeform.commands.options import Force

NAMES = ("surface", "markers", "probe")


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run's folder, or its run.mcap.")],
    out: Annotated[Path, typer.Option(help="Folder for the files.")],
    force: Force = False,
) -> None:
    """Write a run as time series for ParaView: the predicted surface, the markers with their errors, the probe.

    Open OUT/surface.pvd, markers.pvd and probe.pvd together. Lengths are in metres, times in seconds.

    Example: livedeform export out/run --out out/paraview
    """
    from livedeform import outputs
    from livedeform.common.errors import InputError
    from livedeform.common.experiment.yaml_file import load_experiment
    from livedeform.progress import Progress
    from livedeform.report.paraview import write_series

    bag = run / outputs.RECORDING if run.is_dir() else run
    if not bag.is_file():
        raise InputError("is no run", where=str(run), remedy="name the folder that livedeform run wrote")
    declared = bag.parent / "experiment.yaml"
    experiment = load_experiment(declared, geometry=False) if declared.is_file() else None
    names = [f"{name}.pvd" for name in NAMES]
    with outputs.prepared(out, names, force=force, inputs=[run]) as draft, Progress() as progress:
        progress("writing the series")
        written = write_series(bag, experiment, draft)
        outputs.write_configuration(draft, outputs.configuration("export", {"run": run, "out": out}))
    for name, n in written.items():
        typer.echo(f"{out / name}.pvd: {n} moments")
