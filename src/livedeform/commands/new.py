"""livedeform new."""

from __future__ import annotations

import sys
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from livedeform.commands.options import Force

if TYPE_CHECKING:
    from livedeform.progress import Progress


class LengthUnit(StrEnum):
    """A unit that a file may be in."""

    M = "m"
    MM = "mm"


Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="The new experiment's folder.")]
Surface = Annotated[Path, typer.Option(help="The body's closed surface: STL, OBJ or PLY.")]
Markers = Annotated[Path, typer.Option(help="Markers at rest: a table id,x,y,z (.csv), a take (.c3d) or a recording.")]
Unit = Annotated[LengthUnit | None, typer.Option(help="Unit of the surface file, m or mm; told by its size.")]
MarkersUnit = Annotated[LengthUnit | None, typer.Option(help="Unit of the table, m or mm; told by what fits.")]
Rest = Annotated[str, typer.Option(help="Seconds of a take or recording in which nothing moves.")]
Place = Annotated[
    list[str] | None,
    typer.Option(help="LABEL=x,y,z in metres, three times or more: where a take's or recording's markers are."),
]
Name = Annotated[str | None, typer.Option(help="What the experiment is called; the folder's name.")]
Configuration = Annotated[
    str | None, typer.Option(help="loaded: scanned under its own weight; unloaded: the shape without weight.")
]
Gravity = Annotated[str | None, typer.Option(help="x,y,z in m/s2; 0,0,-9.81.")]
Density = Annotated[str | None, typer.Option(help="kg/m3; 1000.")]
Material = Annotated[str | None, typer.Option(help="Material law; neo_hookean.")]
Modulus = Annotated[str | None, typer.Option(help="Young's modulus in Pa.")]
DensitySigma = Annotated[str | None, typer.Option(help="Its standard deviation in kg/m3; unknown.")]
ModulusSigma = Annotated[str | None, typer.Option(help="Its standard deviation in Pa; unknown.")]
Poisson = Annotated[str | None, typer.Option(help="Poisson's ratio; 0.49.")]
SupportType = Annotated[str | None, typer.Option(help="fixed or sliding; fixed.")]
SupportBelow = Annotated[str | None, typer.Option(help="Height in m up to which it is held; a flat base.")]
ProbeShape = Annotated[str | None, typer.Option(help="ball:R, cylinder:R,H, box:L,W,H in metres, mesh:FILE, or none.")]
EdgeRadius = Annotated[str | None, typer.Option(help="Radius of the probe's edges in m; 0.")]
Friction = Annotated[str | None, typer.Option(help="Coefficient of friction of the probe; 0.")]
Cameras = Annotated[str | None, typer.Option(help="LEFT.yaml,RIGHT.yaml, recorded, or none; none.")]
ElementSize = Annotated[str | None, typer.Option(help="Edge of the tetrahedra in m; about 4000 of them.")]
Threshold = Annotated[str | None, typer.Option(help="Error in m up to which a run is good; 0.005.")]
Yes = Annotated[bool, typer.Option("--yes", help="Ask nothing: assume what has a safe default.")]
# the questions that an option answers
ANSWERED = ("name", "configuration", "gravity", "density", "density_sigma", "material", "modulus", "modulus_sigma",
            "poisson", "support", "support_below", "probe", "edge_radius", "friction", "cameras", "element_size",
            "threshold")  # fmt: skip


def new(
    context: typer.Context,
    folder: Folder,
    surface: Surface,
    markers: Markers,
    unit: Unit = None,
    markers_unit: MarkersUnit = None,
    rest: Rest = "0:0.5",
    place: Place = None,
    name: Name = None,
    configuration: Configuration = None,
    gravity: Gravity = None,
    density: Density = None,
    density_sigma: DensitySigma = None,
    material: Material = None,
    modulus: Modulus = None,
    modulus_sigma: ModulusSigma = None,
    poisson: Poisson = None,
    support: SupportType = None,
    support_below: SupportBelow = None,
    probe: ProbeShape = None,
    edge_radius: EdgeRadius = None,
    friction: Friction = None,
    cameras: Cameras = None,
    element_size: ElementSize = None,
    threshold: Threshold = None,
    yes: Yes = False,
    force: Force = False,
) -> None:
    """Make an experiment of your own surface and markers.

    Writes FOLDER/experiment.yaml with a comment at every key, markers.csv, copies of the files, the schema for editors,
    and a picture of body, markers, support and probe. On a terminal it asks for what it cannot know; elsewhere, and
    with --yes, every answer without a safe default must be given as an option.

    Examples:

    livedeform new my-phantom --surface body.stl --markers markers.csv --probe ball:0.01

    livedeform new my-phantom --surface body.stl --markers take.c3d --probe none --modulus 4000 --configuration loaded
    """
    from livedeform.importing.imports import parse_span
    from livedeform.new.make import Sources, make_experiment, read_places_of
    from livedeform.progress import Progress

    given = {name: context.params[name] for name in ANSWERED}
    sources = Sources(surface, markers, unit, markers_unit, parse_span(rest), read_places_of(place or []))
    with Progress() as progress:
        lines = make_experiment(folder, sources, given, ask=_asks(progress, yes), force=force, tell=progress)
    typer.echo("\n".join([*lines, _next(folder)]))


def _next(folder: Path) -> str:
    """Say what to do with the experiment."""
    return f"look at it: livedeform view {folder}; then record, and: livedeform info BAG --experiment {folder}"


def _asks(progress: Progress, yes: bool) -> Callable[[str, str | None], str] | None:
    """Return what asks a question on the terminal, without the progress; None where there is none, or nothing is to be
    asked (``yes``)."""

    def ask(question: str, default: str | None) -> str:
        with progress.paused():
            return str(typer.prompt(question, default=default))

    return ask if sys.stdin.isatty() and not yes else None
