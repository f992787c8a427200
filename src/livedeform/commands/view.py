"""livedeform view."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from livedeform.common.errors import InputError


def view(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="A run's or an experiment's folder, or a run.mcap.")],
    out: Annotated[
        Path | None, typer.Option(help="HTML file to write; view.html in the run's folder by default.")
    ] = None,
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Write view.rrd for rerun.io instead (pip install 'livedeform[rerun]').")
    ] = False,
    no_open: Annotated[bool, typer.Option("--no-open", help="Only write the file.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace another file; view.html is always replaced.")] = False,
) -> None:
    """Opens a run in the 3-D viewer: surface, markers and errors with a time slider, in a browser and offline.

    An experiment is shown as it is declared: body, markers, support and probe.

    run.mcap itself opens in Foxglove and RViz; config/foxglove.json is a layout.

    Examples:

    livedeform view out/demo/before

    livedeform view out/demo/before --rerun && rerun out/demo/before/view.rrd
    """
    import webbrowser

    from livedeform import outputs
    from livedeform.new.picture import write_scene
    from livedeform.progress import Progress
    from livedeform.report.rerun_log import write_rerun
    from livedeform.report.viewer import write_view

    if not path.exists():
        raise InputError("does not exist", where=str(path), remedy="name a run's folder")
    suffix = ".rrd" if rerun else ".html"
    target = out or (path if path.is_dir() else path.parent) / f"view{suffix}"
    if out is not None and out.exists() and not force:
        raise InputError("exists already", where=str(out), remedy="choose another name, or add --force")
    outputs.refuse_inputs([target], [path if path.is_file() else path / outputs.RECORDING])
    if target.is_dir() or (target.exists() and target.suffix != suffix):
        raise InputError("is no page that could be replaced", where=str(target), remedy=f"name a file x{suffix}")
    with Progress() as progress:
        if rerun:
            write_rerun(path, target)
        elif _is_experiment(path):
            write_scene(path, target)
        else:
            write_view(path, target, progress)
    typer.echo(str(target))
    if not no_open and not rerun:
        webbrowser.open(target.resolve().as_uri())


def _is_experiment(path: Path) -> bool:
    """Tell whether it is the folder or file of an experiment, and not of a run, which has its experiment in it."""
    if path.is_dir():
        return (path / "experiment.yaml").is_file() and not (path / "run.mcap").is_file()
    return path.suffix in (".yaml", ".yml")
