"""livedeform calibrate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def calibrate(
    out: Annotated[Path, typer.Option(help="Folder for left.yaml, right.yaml, calibration.json and the page.")],
    board: Annotated[str, typer.Option(help="Columns x rows of inner corners (circles; squares of a ChArUco board).")],
    square: Annotated[float, typer.Option(help="Distance of neighbouring points, in metres.")],
    left: Annotated[str | None, typer.Option(help="Pattern of the left pictures, quoted; or a video.")] = None,
    right: Annotated[str | None, typer.Option(help="Pattern of the right pictures, quoted; or a video.")] = None,
    bag: Annotated[Path | None, typer.Option(help="A recording with both cameras' pictures, instead of files.")] = None,
    kind: Annotated[str, typer.Option(help="checkerboard, circles, acircles or charuco.")] = "checkerboard",
    marker: Annotated[float, typer.Option(help="ChArUco: side of a marker, in metres (0: 0.7 squares).")] = 0.0,
    dictionary: Annotated[str, typer.Option(help="ChArUco: OpenCV's name of the dictionary.")] = "DICT_4X4_50",
    check_left: Annotated[str | None, typer.Option(help="Left pictures of an independent board.")] = None,
    check_right: Annotated[str | None, typer.Option(help="Right pictures of it.")] = None,
    check_bag: Annotated[Path | None, typer.Option(help="A recording of it, instead of files.")] = None,
    check_board: Annotated[str | None, typer.Option(help="Its columns x rows (default: --board).")] = None,
    check_square: Annotated[float, typer.Option(help="Its square in metres, measured by itself.")] = 0.0,
    shift: Annotated[float | None, typer.Option(help="Videos: right minus left, s (found by what moves).")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace what is in --out.")] = False,
) -> None:
    """Calibrates a stereo pair from pictures of a board, and says how well it measures.

    Examples:

    livedeform calibrate --left 'left*.png' --right 'right*.png' --board 9x6 --square 0.025 --out calibration

    livedeform calibrate --bag boards.mcap --board 11x8 --square 0.02 --kind charuco --out calibration"""
    options = {name: value for name, value in locals().items() if name not in ("out", "force")}
    from livedeform import outputs
    from livedeform.calibrating import FILES, parse_board, run_calibration
    from livedeform.importing.board_pictures import named_pictures
    from livedeform.progress import Progress

    shown = parse_board(board, square, kind, marker, dictionary)
    pictures, check = named_pictures(left, right, bag, shift=shift, say=typer.echo), None
    if any((check_left, check_right, check_bag, check_board, check_square)):
        other = parse_board(check_board or board, check_square, kind, marker, dictionary, "--check-square")
        check = named_pictures(check_left, check_right, check_bag, "--check-", say=typer.echo), other
    with outputs.prepared(out, FILES, force=force, inputs=[bag, check_bag]) as draft, Progress() as progress:
        lines = run_calibration(pictures, shown, draft, progress, check)
        outputs.write_configuration(draft, outputs.configuration("calibrate", options))
    typer.echo("\n".join(lines).replace(str(draft), str(out)))
