"""livedeform import."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from livedeform.common.errors import InputError

Crop = Annotated[str | None, typer.Option(help="Keep these seconds only, FROM:TO.")]
Thin = Annotated[int, typer.Option(min=1, help="Keep every n-th point.")]
Preview = Annotated[bool, typer.Option("--preview", help="Say what is understood, and write nothing.")]
RestOfFile = Annotated[
    str, typer.Option(help="Seconds of rest from the file's start, FROM:TO, to register by; else the first 0.5 kept.")
]
Near = Annotated[
    bool,
    typer.Option("--near", help="Search from where the points lie: the body looks alike from two sides."),
]
Keep = Annotated[bool, typer.Option("--keep", help="Leave as it comes what the surface does not tell (a ball's turn).")]
Replace = Annotated[bool, typer.Option("--force", help="Replace what is in --out.")]

app = typer.Typer(
    no_args_is_help=True,
    help="""Turn what other programs recorded into experiments and bags.

    Example:

    livedeform import c3d take1.c3d --experiment my-phantom --out bags
    """,
)


@app.command()
def c3d(
    files: Annotated[list[Path], typer.Argument(help="C3D files, one take each.")],
    out: Annotated[Path, typer.Option(help="Folder for the bags (and, with --preset, the experiments).")],
    experiment: Annotated[
        Path | None, typer.Option(help="Register the tracker to this experiment's markers at rest.")
    ] = None,
    ids: Annotated[
        list[str] | None, typer.Option(help="LABEL=ID, once per marker; else by the numbers in their names, or from 1.")
    ] = None,
    rest: Annotated[str, typer.Option(help="Seconds of rest, FROM:TO, for the registration.")] = "0:0.5",
    noise: Annotated[
        str, typer.Option(help="Covariance from 'still' (scatter while still) or 'residual' (the tracker's own).")
    ] = "still",
    preset: Annotated[str | None, typer.Option(help="A published data set: silicone-beam.")] = None,
    surface: Annotated[
        Path | None, typer.Option(help="The preset's surface (default: beam.stl beside the takes).")
    ] = None,
    force: Replace = False,
) -> None:
    """Motion capture (C3D) as bags of /stereo/markers.

    Examples:

    livedeform import c3d take1.c3d take2.c3d --experiment my-phantom --ids "Tip - 1=1" --ids "Tip - 2=2" --out bags

    livedeform import c3d DATA/silicone_beam/*.c3d --preset silicone-beam --out beam
    """
    from livedeform.importing.imports import import_preset, import_takes, parse_ids, parse_span
    from livedeform.outputs import configuration, write_configuration

    options = {"files": files, "experiment": experiment, "ids": ids, "rest": rest, "noise": noise, "preset": preset}
    if preset is not None:
        lines = import_preset(preset, files, surface, out, force=force)
    else:
        lines = import_takes(
            files, out, experiment=experiment, ids=parse_ids(ids or []), rest=parse_span(rest), noise=noise, force=force
        )
    write_configuration(out, configuration("import c3d", options))
    for line in lines:
        typer.echo(line)


@app.command()
def points(
    files: Annotated[list[Path], typer.Argument(help="Takes: c3d, trc, csv, txt, tsv or npy.")],
    out: Annotated[Path, typer.Option(help="Folder for the bags.")] = Path("bags"),
    units: Annotated[str, typer.Option(help="m, cm, mm, um or in, where the file does not say it.")] = "",
    rate: Annotated[float, typer.Option(help="Frames a second, where the file does not say it.")] = 0.0,
    experiment: Annotated[
        Path | None, typer.Option(help="Register the tracker to this experiment's markers at rest.")
    ] = None,
    ids: Annotated[list[str] | None, typer.Option(help="NAME=ID, once per marker; else as they are numbered.")] = None,
    rest: RestOfFile = "",
    crop: Crop = None,
    release: Annotated[str, typer.Option(help="When the body is let go: seconds, or 'auto'.")] = "",
    noise: Annotated[str, typer.Option(help="Covariance from 'still' or 'residual' (C3D).")] = "still",
    dic: Annotated[bool, typer.Option("--dic", help="The files are moments of one take, as DIC tools write.")] = False,
    thin: Thin = 1,
    preview: Preview = False,
    force: Replace = False,
) -> None:
    """Points that another program measured (motion capture, DIC) as bags of /stereo/markers.

    Examples:

    livedeform import points take1.csv take2.trc --units mm --preview

    livedeform import points dic/step_*.csv --dic --rate 5 --units mm --experiment my-phantom --out bags
    """
    from livedeform.importing.imports import parse_ids, parse_span
    from livedeform.importing.points import Understanding, import_points
    from livedeform.outputs import configuration, write_configuration

    span = parse_span(crop, "--crop") if crop is not None else None
    how = Understanding(units.lower(), rate, span, release, thin, dic)
    lines = import_points(
        files, out, how, experiment=experiment, ids=parse_ids(ids or []), noise=noise, preview=preview,
        rest=parse_span(rest) if rest else None, force=force,
    )  # fmt: skip
    if not preview:
        options = {"files": files, "experiment": experiment, "ids": ids, "rest": rest, "noise": noise, **vars(how)}
        write_configuration(out, configuration("import points", options))
    typer.echo("\n".join(lines))


@app.command()
def surface(
    files: Annotated[
        list[Path], typer.Argument(help="Moments of one take: tables (csv, txt) or scans (ply, stl, obj).")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the bag.")] = Path("bags"),
    units: Annotated[str, typer.Option(help="m, cm, mm, um or in, where the files do not say it.")] = "",
    rate: Annotated[float, typer.Option(help="Moments a second.")] = 0.0,
    experiment: Annotated[
        Path | None, typer.Option(help="Lay the points at rest on this experiment's body; else they are in its frame.")
    ] = None,
    rest: Annotated[str, typer.Option(help="Seconds of rest, FROM:TO, for that.")] = "0:0.5",
    near: Near = False,
    keep: Keep = False,
    crop: Crop = None,
    thin: Thin = 1,
    preview: Preview = False,
    force: Replace = False,
) -> None:
    """Points of a surface of which nobody knows which is which (DIC tables, scans) as a bag of /stereo/surface.

    With --experiment they are registered to its body at rest, else taken to be in the phantom's frame. A run compares
    surfaces then, which is blind to sliding along them.

    Example: livedeform import surface scans/*.ply --rate 5 --units mm --experiment my-phantom --out bags
    """
    from livedeform.importing.clouds import Placing, import_clouds
    from livedeform.importing.imports import parse_span
    from livedeform.importing.points import Understanding
    from livedeform.outputs import configuration, write_configuration

    how = Understanding(units.lower(), rate, parse_span(crop, "--crop") if crop is not None else None, thin=thin)
    if experiment is None and (near or keep):
        raise InputError("is missing", where="--experiment", remedy="name the experiment to whose body they belong")
    placing = Placing(experiment, parse_span(rest), near, keep)
    lines = import_clouds(files, out, how, placing, preview=preview, force=force)
    if not preview:
        write_configuration(out, configuration("import surface", {"files": files, **vars(how), **vars(placing)}))
    typer.echo("\n".join(lines))


@app.command()
def dots(
    folder: Annotated[Path, typer.Argument(help="The public data set dot_cylinder.")],
    out: Annotated[Path, typer.Option(help="Folder for the experiment and its bag.")],
    force: Replace = False,
) -> None:
    """The published dot cylinder's two pictures as an experiment with a bag.

    Example: livedeform import dots DATA/dot_cylinder --out cylinder
    """
    from livedeform.outputs import configuration, prepared, write_configuration
    from livedeform.studies.public.dots import EXPERIMENT_FILES, write_experiment

    with prepared(out, EXPERIMENT_FILES, force=force, inputs=[folder]) as draft:
        lines = [line.replace(str(draft), str(out)) for line in write_experiment(folder, draft)]
        write_configuration(draft, configuration("import dots", {"folder": folder, "out": out}))
    for line in lines:
        typer.echo(line)
