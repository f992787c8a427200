"""Notice whether a board shows more points than were declared: then the pictures may count from different ones of them.

Beside the outermost lines of the found points, one step of the lattice farther out, a larger board shows further
corners (the squares' colours alternate round them) or further circles. A board of the declared size shows its margin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import CalibrationError
from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import Board, BoardView
from livedeform.stereo_node.detect.picture import Picture

SHARE_OF_LINE = 0.7  # of a line's places that must show a point
SHARE_OF_PICTURES = 0.5
LEAST_CONTRAST = 0.5  # of that of the points that were found
AROUND = 0.28  # of the lattice's step: where a corner's four squares are looked at
SHARE_OF_POINTS = 0.8  # that must look like a board's
CORNERS = np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
BESIDE = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
LEAST_GREY = 4.0  # by which squares differ


def check_size(seen: Iterable[tuple[Picture, BoardView]], board: Board) -> None:
    """Raise ``CalibrationError`` where most pictures that could show it show a further line of points beside the board.

    ``seen``: pictures (h, w) in which the board was found, and where. ChArUco boards are not checked: their markers say
    which corner is which.
    """
    if board.kind == "charuco":
        return
    counts = np.zeros((2, 2), np.int64)  # of columns and rows: shown, could be shown
    for picture, view in seen:
        sides = further_lines(picture, view, board).reshape(2, 2)
        more = (sides == 1).any(axis=1)
        counts += np.stack([more, more | (sides == 0).all(axis=1)], axis=1)
    for side, (n, of) in zip(("columns", "rows"), counts, strict=True):
        if n > SHARE_OF_PICTURES * of:
            what = "circles" if "circles" in board.kind else "inner corners"
            raise CalibrationError(
                f"the board has more {side} than {board.columns}x{board.rows} {what}: {n} of {of} pictures show more",
                where="--board",
                remedy=f"count the {what} in both directions (a checkerboard of 10x7 squares has 9x6)",
            )


def is_board(picture: Picture, view: BoardView, board: Board) -> bool:
    """Tell whether the points that were found look like a board's: a search for a board of another size sometimes
    returns a lattice laid over nothing."""
    if board.kind == "charuco":
        return True
    H = _board_to_picture(view, board)
    if H is None:
        return False
    places = board.points[view.rows, :2]
    value = _shows(board)(picture, H, places, view.pixels - _pixels(H, places), board, 0.0)
    return bool((value > max(0.25 * np.percentile(value, 90), LEAST_GREY)).mean() > SHARE_OF_POINTS)


def further_lines(picture: Picture, view: BoardView, board: Board) -> NDArray[np.int64]:
    """Tell (4,) whether a further line of points shows beside the first column, the last, the first row and the last;
    -1 where it would be outside the picture."""
    H = _board_to_picture(view, board)
    out = np.full(4, -1)
    if H is None:
        return out
    places = board.points[:, :2].reshape(board.rows, board.columns, 2)
    found = _pixels(H, places)
    found.reshape(-1, 2)[view.rows] = view.pixels
    off = found - _pixels(H, places)  # what the lens bends
    step = 2 * board.square if board.kind == "acircles" else board.square
    shows = _shows(board)
    contrast = float(shows(picture, H, places, off, board, 0.0).mean())
    right, down = np.array([step, 0.0]), np.array([0.0, board.square])
    # rows of asymmetric circles are shifted by one square against those beside them
    shifts = [np.array([(-1.0 if (row % 2) else 1.0) * board.square, 0.0]) for row in (0, board.rows - 1)]
    shift = shifts if board.kind == "acircles" else [np.zeros(2)] * 2
    lines = (
        (places[:, 0] - right, off[:, 0]),
        (places[:, -1] + right, off[:, -1]),
        (places[0] - down + shift[0], off[0]),
        (places[-1] + down + shift[1], off[-1]),
    )
    for k, (line, bent) in enumerate(lines):
        value = shows(picture, H, line, bent, board, np.nan)
        if np.isfinite(value).mean() > SHARE_OF_LINE:
            out[k] = (np.abs(value[np.isfinite(value)]) > LEAST_CONTRAST * contrast).mean() > SHARE_OF_LINE
    return out


def _shows(board: Board) -> Callable[[Picture, Array, Array, Array, Board, float], Array]:
    return _corners_show if board.kind == "checkerboard" else _circles_show


def _corners_show(picture: Picture, H: Array, places: Array, off: Array, board: Board, outside: float) -> Array:
    """Return by how much (grey values) the two pairs of opposite squares round each place differ, at least; 0 where
    they do not."""
    a = AROUND * board.square
    a1, a2, b1, b2 = (_grey(picture, _pixels(H, places + a * d) + off) for d in CORNERS)
    lighter = np.minimum(a1, a2) - np.maximum(b1, b2)
    darker = np.minimum(b1, b2) - np.maximum(a1, a2)
    best = np.maximum(np.maximum(lighter, darker), 0.0)
    return np.where(np.isfinite(lighter), best, outside)


def _circles_show(picture: Picture, H: Array, places: Array, off: Array, board: Board, outside: float) -> Array:
    """Return by how much (grey values) each place differs from four around it, at least and all in the same sense."""
    # asymmetric circles have others diagonally beside them, but none in their own row and column at this distance
    away = board.square * BESIDE if board.kind == "acircles" else 0.5 * board.square * CORNERS
    inside = _grey(picture, _pixels(H, places) + off)
    around = np.stack([_grey(picture, _pixels(H, places + d) + off) for d in away])
    lighter, darker = inside - around.max(axis=0), around.min(axis=0) - inside
    best = np.maximum(np.maximum(lighter, darker), 0.0)
    return np.where(np.isfinite(lighter), best, outside)


def _board_to_picture(view: BoardView, board: Board) -> Array | None:
    """Return (3, 3): places on the board, m, to pixels, without the lens."""
    H, _ = cv2.findHomography(board.points[view.rows, :2], view.pixels)
    return None if H is None else np.asarray(H, float)


def _pixels(H: Array, places: Array) -> Array:
    """Return pixels (..., 2) of places (..., 2) m on the board."""
    p = places @ H[:, :2].T + H[:, 2]
    out: Array = p[..., :2] / p[..., 2:]
    return out


def _grey(picture: Picture, pixels: Array) -> Array:
    """Return grey values at pixels (..., 2), NaN outside."""
    x, y = pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32)
    flat = cv2.remap(picture, x.reshape(1, -1), y.reshape(1, -1), cv2.INTER_LINEAR).reshape(x.shape).astype(float)
    rows, cols = picture.shape
    return np.where((x >= 0) & (y >= 0) & (x <= cols - 1) & (y <= rows - 1), flat, np.nan)
