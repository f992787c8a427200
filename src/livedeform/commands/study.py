"""livedeform study."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from livedeform.studies import STUDIES
from livedeform_common.errors import InputError

ALL = "all"


def study(
    name: Annotated[str, typer.Argument(metavar="|".join([*STUDIES, ALL]), help="Which study.")],
    out: Annotated[Path | None, typer.Option(help="Folder for the results; out/study/NAME by default.")] = None,
    data: Annotated[
        Path | None, typer.Option(help="Folder of the public data sets; LIVEDEFORM_DATA by default.")
    ] = None,
    left: Annotated[str | None, typer.Option(help="stereo: pattern of your own left pictures, quoted.")] = None,
    right: Annotated[str | None, typer.Option(help="stereo: pattern of the right ones.")] = None,
    bag: Annotated[Path | None, typer.Option(help="stereo: a recording of them, instead of files.")] = None,
    board: Annotated[str, typer.Option(help="stereo: columns x rows of inner corners of the board on them.")] = "",
    square: Annotated[float, typer.Option(help="stereo: distance of its neighbouring points, in metres.")] = 0.0,
    kind: Annotated[str, typer.Option(help="stereo: checkerboard, circles, acircles or charuco.")] = "checkerboard",
    force: Annotated[bool, typer.Option("--force", help="Replace earlier results in --out.")] = False,
) -> None:
    """Repeats a study of the thesis, or one of public measurements; 'all' makes a booklet of them.

    Writes OUT/study.json, figures and index.html.

    Examples:

    livedeform study cuboid --out out/cuboid

    livedeform study stereo --left 'left*.png' --right 'right*.png' --board 9x6 --square 0.025 --out out/stereo

    livedeform study all --data ../shared/data --out out/booklet
    """
    from livedeform import outputs
    from livedeform.progress import Progress

    if name not in STUDIES and name != ALL:
        known = ", ".join([*STUDIES, ALL])
        raise InputError(f"there is no study '{name}'", where="livedeform study", remedy=f"known are {known}")
    own: dict[str, object] = {}
    if left or right or bag or board or square:
        own = _own_board(name, left, right, bag, board, square, kind)
    options = {"left": left, "right": right, "bag": bag, "board": board, "square": square, "kind": kind} if own else {}
    folder = out or Path("out") / "study" / name
    outputs.prepare(folder, ("study.json", "index.html"), force=force)
    outputs.write_configuration(folder, outputs.configuration("study", {"name": name, "data": data} | options))
    with Progress() as progress:
        if name == ALL:
            from livedeform.studies.booklet import make_booklet

            make_booklet(folder, data, progress)
        else:
            STUDIES[name](folder, data, progress, **own)
    typer.echo(f"page: {folder / 'index.html'}")


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
