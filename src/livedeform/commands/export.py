"""livedeform export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from livedeform.commands.options import Force

LAYOUTS = ("foxglove.json", "scene.rviz")
NAMES = ("surface", "markers", "probe")


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run's folder, or its run.mcap.")],
    out: Annotated[Path, typer.Option(help="Folder for the files.")],
    force: Force = False,
) -> None:
    """Write a run for other viewers: time series for ParaView, and layouts for Foxglove and RViz that fit it.

    ParaView: open OUT/surface.pvd, markers.pvd and probe.pvd together (lengths in metres, times in seconds). Foxglove:
    open the run's run.mcap and import OUT/foxglove.json. RViz: rviz2 -d OUT/scene.rviz.

    Example: livedeform export out/run --out out/paraview
    """
    import yaml

    from livedeform import outputs
    from livedeform.common.bags.read import read_bag
    from livedeform.common.errors import InputError
    from livedeform.common.experiment.yaml_file import load_experiment
    from livedeform.progress import Progress
    from livedeform.report.layouts import foxglove_layout, rviz_layout
    from livedeform.report.paraview import write_series

    bag = run / outputs.RECORDING if run.is_dir() else run
    if not bag.is_file():
        raise InputError("is no run", where=str(run), remedy="name the folder that livedeform run wrote")
    declared = bag.parent / "experiment.yaml"
    experiment = load_experiment(declared, geometry=False) if declared.is_file() else None
    names = [*(f"{name}.pvd" for name in NAMES), *LAYOUTS]
    with outputs.prepared(out, names, force=force, inputs=[run]) as draft, Progress() as progress:
        progress("writing the series")
        written = write_series(bag, experiment, draft)
        with read_bag(bag) as opened:
            topics = {name for name, info in opened.topics.items() if info.count}
        outputs.write_json(draft / LAYOUTS[0], foxglove_layout(topics))
        outputs.write_text(draft / LAYOUTS[1], yaml.safe_dump(rviz_layout(topics), sort_keys=False))
        outputs.write_configuration(draft, outputs.configuration("export", {"run": run, "out": out}))
    for name, n in written.items():
        typer.echo(f"{out / name}.pvd: {n} moments")
    typer.echo(f"layouts: {', '.join(str(out / name) for name in LAYOUTS)}")
