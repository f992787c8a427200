"""Understand a ChArUco board whose declaration cannot be right: its dictionary too small, its sides swapped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from livedeform.common.errors import CalibrationError
from livedeform.common.processes import in_threads
from livedeform.stereo_node.boards.boards import Board, charuco_corners, find_markers
from livedeform.stereo_node.boards.lattice import fitting
from livedeform.stereo_node.detect.picture import Picture

SIZES = (50, 100, 250, 1000)  # of OpenCV's families DICT_4X4_50 .. DICT_7X7_1000; each begins with the smaller ones
N_LOOKS = 3  # pictures by which the sides are judged
CLEARLY = 1.5  # times as many corners


def understood(board: Board, pictures: Sequence[Picture], say: Callable[[str], None]) -> Board:
    """Return the ChArUco board that the ``pictures`` show, and say what differs from what was declared; other boards
    as they are. ``CalibrationError`` where no dictionary of the family has enough markers."""
    if board.kind != "charuco":
        return board
    board = _large_enough(board, say)
    swapped = replace(board, columns=board.rows, rows=board.columns)
    if board.columns == board.rows or not pictures:
        return board
    step = max(len(pictures) // N_LOOKS, 1)
    looks = pictures[::step][:N_LOOKS]
    counts = np.sum(list(in_threads(partial(_counts, (board, swapped)), looks)), axis=0)
    if counts[1] <= CLEARLY * counts[0]:
        return board
    say(
        f"the board is taken as {swapped.columns}x{swapped.rows} squares, not {board.columns}x{board.rows}: "
        f"{counts[1]} corners are found that way instead of {counts[0]}"
    )
    return swapped


def _counts(boards: Sequence[Board], picture: Picture) -> list[int]:
    """Return how many corners of each board lie where their neighbours say, beside the same markers."""
    markers = find_markers(picture, boards[0])
    out = []
    for board in boards:
        rough = charuco_corners(picture, board, *markers)
        if rough is None:
            out.append(0)
            continue
        rows, pixels = rough
        out.append(int(fitting(board.points[rows, :2] / board.square, pixels, np.ones(len(rows), bool)).sum()))
    return out


def _large_enough(board: Board, say: Callable[[str], None]) -> Board:
    needed = board.columns * board.rows // 2
    board.charuco()  # refuses a dictionary that is unknown
    has = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary)).bytesList)
    if has >= needed:
        return board
    family = board.dictionary.rpartition("_")[0]
    larger = [f"{family}_{n}" for n in SIZES if n >= needed and hasattr(cv2.aruco, f"{family}_{n}")]
    if not larger:
        raise CalibrationError(
            f"{board.dictionary} has {has} markers, a board of {board.columns}x{board.rows} squares has {needed}",
            where="--dictionary", remedy="name the dictionary that the board was made with",
        )  # fmt: skip
    say(f"{board.dictionary} has {has} markers, the board {needed}: {larger[0]} is taken")
    return replace(board, dictionary=larger[0])
