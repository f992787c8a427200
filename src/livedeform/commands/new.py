"""livedeform new."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from livedeform.commands.options import Force


def new(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The new experiment's folder.")],
    surface: Annotated[Path, typer.Option(help="The body's closed surface: STL, OBJ or PLY.")],
    markers: Annotated[
        Path,
        typer.Option(help="Markers at rest: a table id,x,y,z (.csv), a take (.c3d) or a recording."),
    ],
    unit: Annotated[str | None, typer.Option(help="Unit of the surface file, m or mm; told by its size.")] = None,
    markers_unit: Annotated[str | None, typer.Option(help="Unit of the table, m or mm; told by what fits.")] = None,
    rest: Annotated[str, typer.Option(help="Seconds of a take or recording in which nothing moves.")] = "0:0.5",
    place: Annotated[
        list[str] | None,
        typer.Option(help="LABEL=x,y,z in metres, three times or more: where a take's or recording's markers are."),
    ] = None,
    name: Annotated[str | None, typer.Option(help="What the experiment is called; the folder's name.")] = None,
    configuration: Annotated[
        str | None, typer.Option(help="loaded: scanned under its own weight; unloaded: the shape without weight.")
    ] = None,
    gravity: Annotated[str | None, typer.Option(help="x,y,z in m/s2; 0,0,-9.81.")] = None,
    density: Annotated[str | None, typer.Option(help="kg/m3; 1000.")] = None,
    material: Annotated[str | None, typer.Option(help="Material law; neo_hookean.")] = None,
    modulus: Annotated[str | None, typer.Option(help="Young's modulus in Pa.")] = None,
    modulus_sigma: Annotated[str | None, typer.Option(help="Its standard deviation in Pa; unknown.")] = None,
    poisson: Annotated[str | None, typer.Option(help="Poisson's ratio; 0.49.")] = None,
    support: Annotated[str | None, typer.Option(help="fixed or sliding; fixed.")] = None,
    support_below: Annotated[str | None, typer.Option(help="Height in m up to which it is held; a flat base.")] = None,
    probe: Annotated[
        str | None, typer.Option(help="ball:R, cylinder:R,H, box:L,W,H in metres, mesh:FILE, or none.")
    ] = None,
    edge_radius: Annotated[str | None, typer.Option(help="Radius of the probe's edges in m; 0.")] = None,
    friction: Annotated[str | None, typer.Option(help="Coefficient of friction of the probe; 0.")] = None,
    cameras: Annotated[str | None, typer.Option(help="LEFT.yaml,RIGHT.yaml, recorded, or none; none.")] = None,
    element_size: Annotated[str | None, typer.Option(help="Edge of the tetrahedra in m; about 4000 of them.")] = None,
    threshold: Annotated[str | None, typer.Option(help="Error in m up to which a run is good; 0.005.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Ask nothing: assume what has a safe default.")] = False,
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
    import sys

    from livedeform.importing.imports import parse_span
    from livedeform.new.make import Sources, make_experiment, read_places_of
    from livedeform.progress import Progress

    given = {
        "name": name, "configuration": configuration, "gravity": gravity, "density": density, "material": material,
        "modulus": modulus, "modulus_sigma": modulus_sigma, "poisson": poisson, "support": support,
        "support_below": support_below, "probe": probe, "edge_radius": edge_radius, "friction": friction,
        "cameras": cameras, "element_size": element_size, "threshold": threshold,
    }  # fmt: skip
    sources = Sources(surface, markers, unit, markers_unit, parse_span(rest), read_places_of(place or []))
    ask = None if yes or not sys.stdin.isatty() else _ask
    with Progress() as progress:
        lines = make_experiment(folder, sources, given, ask=ask, force=force, tell=progress)
    for line in lines:
        typer.echo(line)
    typer.echo(f"look at it: livedeform view {folder}; then record, and: livedeform info BAG --experiment {folder}")


def _ask(question: str, default: str | None) -> str:
    return str(typer.prompt(question, default=default))
