"""livedeform study."""

from __future__ import annotations

import importlib
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from livedeform.common.errors import InputError
from livedeform.studies import STUDIES, Study

ALL = "all"
NUMBERS = {
    "stacked": "thesis.stacked",
    "cuboid": "own.cuboid",
    "gravity": "thesis.gravity",
}  # study: module with its own_numbers


def study(
    name: Annotated[str, typer.Argument(metavar="|".join([*STUDIES, ALL]), help="Which study.")],
    out: Annotated[Path | None, typer.Option(help="Folder for the results; out/study/NAME by default.")] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the public data sets; LIVEDEFORM_DATA by default. probe: the folder of your own "
            "'livedeform run'. dots: a folder with your left.png, right.png, points.csv and picks.csv."
        ),
    ] = None,
    left: Annotated[str | None, typer.Option(help="stereo: pattern of your own left pictures, quoted.")] = None,
    right: Annotated[str | None, typer.Option(help="stereo: pattern of the right ones.")] = None,
    bag: Annotated[Path | None, typer.Option(help="stereo: a recording of them, instead of files.")] = None,
    board: Annotated[str, typer.Option(help="stereo: columns x rows of inner corners of the board on them.")] = "",
    square: Annotated[float, typer.Option(help="stereo: distance of its neighbouring points, in metres.")] = 0.0,
    kind: Annotated[str, typer.Option(help="stereo: checkerboard, circles, acircles or charuco.")] = "checkerboard",
    top: Annotated[str, typer.Option(help="height: numbers of markers on top, as 5,6, of the --bag's markers.")] = "",
    bottom: Annotated[str, typer.Option(help="height: numbers of markers at the bottom.")] = "",
    picks: Annotated[Path | None, typer.Option(help="height: CSV of points picked in a pair of pictures.")] = None,
    cameras: Annotated[Path | None, typer.Option(help="height: folder with left.yaml and right.yaml.")] = None,
    up: Annotated[str, typer.Option(help="height: direction, as 0,0,1.")] = "",
    measured: Annotated[
        str,
        typer.Option(
            help="Your own numbers. stacked: four shortenings in mm (short, tall, top, bottom), as 3.7,15.2,8.9,7.6. "
            "cuboid: width, height, loss in mm, E in Pa, and depth, density, nu, E_sigma where they matter. "
            "gravity: standing, hanging, and base, density, nu. "
            "probe: before, press: the seconds of the two frames. As NAME=VALUE,..."
        ),
    ] = "",
    sigma: Annotated[
        str,
        typer.Option(
            help="One sigma in mm. stacked: 1.1,2.3 by default, the second one with all counted; cuboid: of the loss; "
            "gravity: of both heights."
        ),
    ] = "",
    force: Annotated[bool, typer.Option("--force", help="Replace earlier results in --out.")] = False,
) -> None:
    """Repeats a study of the thesis, or one of public measurements; 'all' makes a booklet of them.

    Writes OUT/study.json, figures and index.html.

    Examples:

    livedeform study cuboid --out out/cuboid

    livedeform study stereo --left 'left*.png' --right 'right*.png' --board 9x6 --square 0.025 --out out/stereo

    livedeform study height --bag run/run.mcap --top 1 --bottom 35,36,37 --cameras calibration --out out/height

    livedeform study height --picks picks.csv --cameras calibration --out out/height

    livedeform study stacked --measured 3.7,15.2,8.9,7.6 --sigma 1.1,2.3 --out out/stacked

    livedeform study cuboid --measured width=50,height=70,E=2896,loss=6.8 --sigma 0.5 --out out/cuboid

    livedeform study gravity --measured standing=94.5,hanging=99.6,base=120 --sigma 0.5,1.1 --out out/gravity

    livedeform study probe --data out/run --out out/probe

    livedeform study dots --data my-dots --out out/dots

    livedeform study all --data ../shared/data --out out/booklet
    """
    from livedeform import outputs
    from livedeform.progress import Progress

    if name not in STUDIES and name != ALL:
        known = ", ".join([*STUDIES, ALL])
        raise InputError(f"there is no study '{name}'", where="livedeform study", remedy=f"known are {known}")
    if data is not None and not data.exists():
        raise InputError("does not exist", where=str(data), remedy="name the folder of the data with --data")
    if data is not None and name in NUMBERS:
        raise InputError(
            f"the study {name} reads no folder", where="--data", remedy="give your own numbers: --measured"
        )
    own: dict[str, object] = {}
    if name == "height" and (bag or picks or top or bottom):
        own = _own_heights(bag, top, bottom, picks, cameras, up)
    elif name == "probe" and (data or measured):
        own = _own_press(data, measured, sigma)
    elif name == "dots" and data is not None and not (measured or sigma):
        own = _own_dots(data)
    elif measured or sigma:
        own = _own_numbers(name, measured, sigma)
    elif left or right or bag or board or square:
        own = _own_board(name, left, right, bag, board, square, kind)
    given = {
        "left": left, "right": right, "bag": bag, "board": board, "square": square, "kind": kind, "top": top,
        "bottom": bottom, "picks": picks, "cameras": cameras, "up": up, "measured": measured, "sigma": sigma,
    }  # fmt: skip
    options = given if own else {}
    folder = out or Path("out") / "study" / name
    run: Study = STUDIES[name] if name != ALL else _booklet
    reads = [data, bag, picks, cameras]
    with (
        _terminated_like_interrupted(),
        outputs.prepared(folder, ("study.json", "index.html"), force=force, inputs=reads) as work,
        Progress() as progress,
    ):
        run(work, data, progress, **own)
        outputs.write_configuration(work, outputs.configuration("study", {"name": name, "data": data} | options))
    typer.echo(f"page: {folder / 'index.html'}")


def _booklet(out: Path, data: Path | None, progress: Callable[[str, float | None], None]) -> dict[str, Any]:
    from livedeform.studies.booklet import make_booklet

    return make_booklet(out, data, progress)


@contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM ends what runs as Ctrl-C does, so that it cleans up behind itself."""
    if threading.current_thread() is not threading.main_thread():  # only the main one may set handlers
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _own_numbers(name: str, measured: str, sigma: str) -> dict[str, object]:
    """The argument of a study for one's own numbers."""
    if name not in NUMBERS:
        raise InputError(
            f"the study '{name}' takes no numbers",
            where="--measured" if measured else "--sigma",
            remedy=f"leave it away; {', '.join(NUMBERS)} take some",
        )
    if not measured:
        raise InputError("is missing", where="--measured", remedy="give the numbers that --sigma is of")
    module = importlib.import_module(f"livedeform.studies.{NUMBERS[name]}")
    return {"own": module.own_numbers(measured, sigma)}


def _own_press(data: Path | None, measured: str, sigma: str) -> dict[str, object]:
    """The argument of the probe study for one's own run."""
    from livedeform.studies.own.press import read_run

    if data is None:
        raise InputError("is missing", where="--data", remedy="name the folder of a 'livedeform run'")
    if sigma:
        raise InputError("the run knows its own errors", where="--sigma", remedy="leave it away")
    return {"own": read_run(data, measured)}


def _own_dots(data: Path) -> dict[str, object]:
    """The argument of the dots study for one's own pictures; nothing where ``data`` is the public data."""
    from livedeform.studies.own.dots import is_own, read_own

    return {"own": read_own(data)} if is_own(data) else {}


def _own_board(
    name: str, left: str | None, right: str | None, bag: Path | None, board: str, square: float, kind: str
) -> dict[str, object]:
    """The arguments of the stereo study for one's own pictures."""
    if name != "stereo":
        raise InputError(
            f"the study '{name}' takes no pictures", where="livedeform study", remedy="leave --left to --square away"
        )
    from livedeform.calibrating import named_pictures, parse_board

    if not board or not square:
        raise InputError(
            "the board is not described",
            where="--board" if not board else "--square",
            remedy="give --board 9x6 --square 0.025, as it was printed",
        )
    return {"board": parse_board(board, square, kind), "own": named_pictures(left, right, bag)}


def _own_heights(
    bag: Path | None, top: str, bottom: str, picks: Path | None, cameras: Path | None, up: str
) -> dict[str, object]:
    """The arguments of the height study for one's own markers or picked points."""
    from livedeform.studies.thesis.own_heights import of_markers, of_picks, parse_ids, parse_up

    if picks is not None:
        if cameras is None:
            raise InputError("the cameras are not known", where="--cameras", remedy="name a calibration's folder")
        return {"own": of_picks(picks, cameras, parse_up(up))}
    if bag is None or not top or not bottom:
        raise InputError(
            "the markers are not named",
            where="--bag, --top, --bottom",
            remedy="give all three, or --picks and --cameras",
        )
    found = of_markers(bag, parse_ids(top, "--top"), parse_ids(bottom, "--bottom"), parse_up(up), cameras)
    return {"own": found}
