"""Pictures of a calibration board: the pairs in which both cameras see it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import cv2
import numpy as np

from livedeform.common.errors import CalibrationError
from livedeform.common.processes import in_threads
from livedeform.stereo_node.boards.board_size import check_size, is_board
from livedeform.stereo_node.boards.boards import Board, BoardView, Pair, counted_alike, find_board
from livedeform.stereo_node.detect.picture import Picture

__all__ = ["find_pairs", "read_picture"]

MIN_PAIRS = 4
SAME_PX = 2.0  # by which no corner moves between two pictures of a resting board
Progress = Callable[[str], None]


def find_pairs(
    pictures: Sequence[tuple[str, Picture, Picture]],
    board: Board,
    progress: Progress | None = None,
    least: int = MIN_PAIRS,
) -> list[Pair]:
    """Find the board in every pair of pictures (name, left, right).

    Pairs in which one camera does not see it are left out; ``CalibrationError`` where fewer than ``least`` remain.
    """
    _check_pictures(pictures)
    pairs: list[Pair] = []
    seen: list[tuple[Picture, BoardView]] = []
    for (name, left, right), views in zip(pictures, in_threads(partial(_looks, board), pictures), strict=True):
        seen += [(p, v) for p, v in zip((left, right), views, strict=True) if v is not None]
        if progress:
            progress(f"{name}: {_said(views, board)}")
        if views[0] is not None and views[1] is not None:
            pairs.append(Pair(name, views[0], counted_alike(views[1], views[0], board)))
    check_size(seen, board)
    pairs = without_repeats(pairs, progress)
    if len(pairs) < least:
        named = f" with {board.dictionary}" if board.kind == "charuco" else ""
        count = (
            "count the inner corners (a board of 10x7 squares is 9x6), and give at least {} pairs that show it whole"
        )
        if board.kind == "charuco":
            count = "count its squares, name the --dictionary that it was made with, and give at least {} pairs"
        raise CalibrationError(
            f"the {board.columns}x{board.rows} {board.kind}{named} was found in {len(pairs)} of {len(pictures)} pairs",
            where="--board",
            remedy=count.format(least),
        )
    return pairs


def without_repeats(pairs: Sequence[Pair], progress: Progress | None = None) -> list[Pair]:
    """Leave out pairs that show the board where one before them does, as recordings of a resting board hold: they tell
    nothing more, and a scatter between pictures must not count them."""
    kept: list[Pair] = []
    for pair in pairs:
        if not any(_same_place(pair.left, k.left) and _same_place(pair.right, k.right) for k in kept):
            kept.append(pair)
    if progress and len(kept) < len(pairs):
        progress(f"{len(pairs) - len(kept)} pairs show the board where another one does, and are left out")
    return kept


def _same_place(a: BoardView, b: BoardView) -> bool:
    _, i, j = np.intersect1d(a.rows, b.rows, return_indices=True)
    return len(i) > 0 and float(np.linalg.norm(a.pixels[i] - b.pixels[j], axis=1).max()) < SAME_PX


def _check_pictures(pictures: Sequence[tuple[str, Picture, Picture]]) -> None:
    """Raise ``CalibrationError`` where there are no pictures, of several sizes, or the same on both sides."""
    if not pictures:
        raise CalibrationError(
            "no pictures", where="--left", remedy="check the pattern: quote it, so that the shell leaves it alone"
        )
    shape = pictures[0][1].shape
    for name, left, right in pictures:
        for side, picture in (("left", left), ("right", right)):
            if picture.shape != shape:
                raise CalibrationError(
                    f"the {side} picture is {picture.shape[1]}x{picture.shape[0]}, the first is {shape[1]}x{shape[0]}",
                    where=name, remedy="calibrate with pictures of one size",
                )  # fmt: skip
        if np.array_equal(left, right):
            raise CalibrationError(
                "left and right are the same picture: the baseline would be zero",
                where=name,
                remedy="check --left and --right",
            )


def _said(views: tuple[BoardView | None, BoardView | None], board: Board) -> str:
    for side, view in zip(("left", "right"), views, strict=True):
        if view is None:
            return f"no board in {side}"
    missing = sum(len(board.points) - len(v.rows) for v in views if v is not None)
    left_out = f", {missing} corners without a good fit left out" if missing and board.kind == "checkerboard" else ""
    return f"board found{left_out}"


def _looks(board: Board, pictures: tuple[str, Picture, Picture]) -> tuple[BoardView | None, BoardView | None]:
    return _look(pictures[1], board), _look(pictures[2], board)


def _look(picture: Picture, board: Board) -> BoardView | None:
    view = find_board(picture, board)
    return view if view is not None and is_board(picture, view, board) else None


def read_picture(path: str) -> Picture:
    """Return a grey picture from a file; ``CalibrationError`` where it is none."""
    picture = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise CalibrationError("cannot be read as a picture", where=path, remedy="give png, jpeg, bmp or tiff files")
    return picture  # type: ignore[return-value]
