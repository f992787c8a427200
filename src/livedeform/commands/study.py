"""livedeform study: one sub-command per study, each with its own options only."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from livedeform.commands.options import Force
from livedeform.common.errors import InputError

# option: what it hands to a study, as an error names it
MEANING = {
    "--data": "folder", "--measured": "numbers", "--sigma": "uncertainty", "--left": "pictures", "--right": "pictures",
    "--bag": "recording", "--board": "board", "--square": "board", "--kind": "board", "--top": "markers",
    "--bottom": "markers", "--picks": "picked points", "--cameras": "cameras", "--up": "direction",
}  # fmt: skip

Out = Annotated[Path | None, typer.Option(help="Folder for the results; out/study/NAME by default.")]
Data = Annotated[Path | None, typer.Option(help="Folder of the public data sets; LIVEDEFORM_DATA by default.")]


class StudyCommand(TyperCommand):
    """A sub-command that says of another study's option that this one does not take it, and which do."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse as usual; raises InputError for an option that only other studies have."""
        mine = {word for p in self.params for word in p.opts}
        for word in args:
            option = word.split("=")[0]
            if option in MEANING and option not in mine:
                what = f"the study '{self.name}' takes no {MEANING[option]}"
                raise InputError(what, where=option, remedy=_instead(ctx, mine))
        return super().parse_args(ctx, args)


def _instead(ctx: Any, mine: set[str]) -> str:
    """Say what a study takes of one's own, as a remedy."""
    own = ", ".join(option for option in MEANING if option in mine and option != "--data")
    return "leave it away" + (f"; for your own case it takes {own}" if own else f"; see '{ctx.command_path} --help'")


app = typer.Typer(
    no_args_is_help=True,
    help="""Repeat a study of the thesis, or one of public measurements; 'all' makes a booklet of them.

    Writes OUT/study.json, figures and index.html. Several take your own measurements instead.

    Examples:

    livedeform study cuboid --out out/cuboid

    livedeform study stereo --help

    livedeform study all --data ../shared/data --out out/booklet
    """,
)


def _run(name: str, out: Path | None, data: Path | None, force: bool, own: dict[str, Any], **options: Any) -> None:
    from livedeform.studies.running import run_study

    folder = out or Path("out") / "study" / name
    run_study(name, folder, data, own, options if own else {}, force=force)
    typer.echo(f"page: {folder / 'index.html'}")


def _both(measured: str, sigma: str) -> bool:
    """Return whether the user gives numbers; raises InputError for a sigma of none."""
    if sigma and not measured:
        raise InputError("is missing", where="--measured", remedy="give the numbers that --sigma is of")
    return bool(measured)


@app.command(cls=StudyCommand)
def stereo(
    out: Out = None,
    data: Data = None,
    left: Annotated[str | None, typer.Option(help="Pattern of your own left pictures, quoted.")] = None,
    right: Annotated[str | None, typer.Option(help="Pattern of the right ones.")] = None,
    bag: Annotated[Path | None, typer.Option(help="A recording of them, instead of files.")] = None,
    board: Annotated[str, typer.Option(help="Columns x rows of inner corners of the board on them.")] = "",
    square: Annotated[float, typer.Option(help="Distance of its neighbouring points, in metres.")] = 0.0,
    kind: Annotated[str, typer.Option(help="checkerboard, circles, acircles or charuco.")] = "checkerboard",
    force: Force = False,
) -> None:
    """Show how far stereo measurements are from a board of known size.

    Examples:

    livedeform study stereo --data ../shared/data --out out/stereo

    livedeform study stereo --left 'left*.png' --right 'right*.png' --board 9x6 --square 0.025 --out out/stereo
    """
    own: dict[str, Any] = {}
    if left or right or bag or board or square:
        from livedeform.calibrating import parse_board
        from livedeform.importing.board_pictures import named_pictures

        if not board or not square:
            raise InputError(
                "the board is not described",
                where="--board" if not board else "--square",
                remedy="give --board 9x6 --square 0.025, as it was printed",
            )
        own = {"board": parse_board(board, square, kind), "own": named_pictures(left, right, bag, say=typer.echo)}
    _run("stereo", out, data, force, own, left=left, right=right, bag=bag, board=board, square=square, kind=kind)


@app.command(cls=StudyCommand)
def height(
    out: Out = None,
    data: Annotated[
        Path | None, typer.Option(help="Your own SOFA position file, or a folder of *_x.txt: metres, z up.")
    ] = None,
    bag: Annotated[Path | None, typer.Option(help="A run or recording with your own markers.")] = None,
    top: Annotated[str, typer.Option(help="Numbers of its markers on top, as 5,6.")] = "",
    bottom: Annotated[str, typer.Option(help="Numbers of its markers at the bottom.")] = "",
    picks: Annotated[Path | None, typer.Option(help="CSV of points picked in a pair of pictures, instead.")] = None,
    cameras: Annotated[Path | None, typer.Option(help="Folder with left.yaml and right.yaml.")] = None,
    up: Annotated[str, typer.Option(help="Direction of the height, as 0,0,1.")] = "",
    force: Force = False,
) -> None:
    """Show how wrong a height is that is the highest minus the lowest of noisy points.

    Examples:

    livedeform study height --out out/height

    livedeform study height --bag run/run.mcap --top 1 --bottom 35,36,37 --cameras calibration --out out/height

    livedeform study height --picks picks.csv --cameras calibration --out out/height
    """
    own: dict[str, Any] = {}
    if bag or top or bottom or picks or cameras or up:
        from livedeform.studies.own.heights import read_own

        own = {"own": read_own(bag, top, bottom, picks, cameras, up)}
    options = {"bag": bag, "top": top, "bottom": bottom, "picks": picks, "cameras": cameras, "up": up}
    _run("height", out, data, force, own, **options)


@app.command(cls=StudyCommand)
def cuboid(
    out: Out = None,
    measured: Annotated[
        str,
        typer.Option(
            help="Your own: width, height, loss in mm, E in Pa, and depth, density, nu, E_sigma where they matter, "
            "as NAME=VALUE,..."
        ),
    ] = "",
    sigma: Annotated[str, typer.Option(help="One sigma of the loss, in mm.")] = "",
    force: Force = False,
) -> None:
    """Show how much a cuboid of gelatin sinks under its weight: formula, four codes and this one.

    Examples:

    livedeform study cuboid --out out/cuboid

    livedeform study cuboid --measured width=50,height=70,E=2896,loss=6.8 --sigma 0.5 --out out/cuboid
    """
    own: dict[str, Any] = {}
    if _both(measured, sigma):
        from livedeform.studies.own.cuboid import own_numbers

        own = {"own": own_numbers(measured, sigma)}
    _run("cuboid", out, None, force, own, measured=measured, sigma=sigma)


@app.command(cls=StudyCommand)
def stacked(
    out: Out = None,
    measured: Annotated[
        str, typer.Option(help="Your own four shortenings in mm (short, tall, top, bottom), as 3.7,15.2,8.9,7.6.")
    ] = "",
    sigma: Annotated[
        str, typer.Option(help="One sigma in mm; 1.1,2.3 by default, the second one with all counted.")
    ] = "",
    force: Force = False,
) -> None:
    """Show whether two cuboids on top of each other are in line with one modulus.

    Examples:

    livedeform study stacked --out out/stacked

    livedeform study stacked --measured 3.7,15.2,8.9,7.6 --sigma 1.1,2.3 --out out/stacked
    """
    own: dict[str, Any] = {}
    if _both(measured, sigma):
        from livedeform.studies.thesis.stacked_fit import own_numbers

        own = {"own": own_numbers(measured, sigma)}
    _run("stacked", out, None, force, own, measured=measured, sigma=sigma)


@app.command(cls=StudyCommand)
def gravity(
    out: Out = None,
    measured: Annotated[
        str, typer.Option(help="Your own: standing, hanging, and base in mm, density, nu, as NAME=VALUE,...")
    ] = "",
    sigma: Annotated[str, typer.Option(help="One sigma of both heights, in mm.")] = "",
    force: Force = False,
) -> None:
    """Show what a standing and a hanging height say of the modulus.

    Examples:

    livedeform study gravity --out out/gravity

    livedeform study gravity --measured standing=94.5,hanging=99.6,base=120 --sigma 0.5,1.1 --out out/gravity
    """
    own: dict[str, Any] = {}
    if _both(measured, sigma):
        from livedeform.studies.thesis.gravity import own_numbers

        own = {"own": own_numbers(measured, sigma)}
    _run("gravity", out, None, force, own, measured=measured, sigma=sigma)


@app.command(cls=StudyCommand)
def probe(
    out: Out = None,
    data: Annotated[Path | None, typer.Option(help="The folder of your own 'livedeform run'.")] = None,
    measured: Annotated[
        str, typer.Option(help="The seconds of its two frames, as before=0.0,press=2.75; found by default.")
    ] = "",
    force: Force = False,
) -> None:
    """Show what a press under the probe adds to the error, marker by marker.

    Examples:

    livedeform study probe --out out/probe

    livedeform study probe --data out/run --out out/probe
    """
    own: dict[str, Any] = {}
    if data or measured:
        from livedeform.studies.own.press import read_run

        if data is None:
            raise InputError("is missing", where="--data", remedy="name the folder of a 'livedeform run'")
        own = {"own": read_run(data, measured)}
    _run("probe", out, data, force, own, measured=measured)


@app.command(cls=StudyCommand)
def beam(out: Out = None, data: Data = None, force: Force = False) -> None:
    """Show what a static, elastic model of a released silicone beam lacks.

    Example:

    livedeform study beam --data ../shared/data --out out/beam
    """
    _run("beam", out, data, force, {})


@app.command(cls=StudyCommand)
def dots(
    out: Out = None,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the public data sets, LIVEDEFORM_DATA by default; or one with your own left.png, "
            "right.png, points.csv and picks.csv."
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Show how far the dots of a printed cylinder are from where they were printed.

    Examples:

    livedeform study dots --data ../shared/data --out out/dots

    livedeform study dots --data my-dots --out out/dots
    """
    from livedeform.studies.own.dots import is_own, read_own

    _run("dots", out, data, force, {"own": read_own(data)} if data is not None and is_own(data) else {})


@app.command(cls=StudyCommand)
def compression(
    out: Out = None,
    data: Data = None,
    own: Annotated[
        Path | None, typer.Option(help="A folder of your own tests: one folder of *.csv per material, or one material.")
    ] = None,
    diameter: Annotated[
        float, typer.Option(help="Of your cylinders, in metres, where their files do not say it.")
    ] = 0.0,
    height: Annotated[float, typer.Option(help="Of your cylinders, in metres.")] = 0.0,
    force: Force = False,
) -> None:
    """Show whether one law holds for discs that are compressed bonded and free.

    Examples:

    livedeform study compression --data ../shared/data --out out/compression

    livedeform study compression --own my-tests --diameter 0.025 --height 0.015 --out out/compression
    """
    given: dict[str, Any] = {}
    if own is None and (diameter or height):
        raise InputError("is missing", where="--own", remedy="name the folder of the tests that the size is of")
    if own is not None:
        from livedeform.studies.public.compression_tests import Size

        if bool(diameter) != bool(height):
            missing = "--height" if diameter else "--diameter"
            raise InputError("is missing", where=missing, remedy="give both, in metres")
        given = {"folder": own, "size": Size(diameter / 2, height) if diameter else None}
    _run("compression", out, data, force, given, tests=own, diameter=diameter, height=height)


@app.command("all", cls=StudyCommand)
def all_(out: Out = None, data: Data = None, force: Force = False) -> None:
    """Run every study, and bind one booklet.

    Example:

    livedeform study all --data ../shared/data --out out/booklet
    """
    _run("all", out, data, force, {})
