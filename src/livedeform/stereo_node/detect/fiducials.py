"""Markers whose identity is in the picture: ArUco and AprilTag squares, and the points of a board.

The code is the marker's id in markers.csv (of a board: the point's number, row by row from 0). A tag's centre is
where its diagonals cross: unlike the mean of its corners that is the picture of its middle under any perspective.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import Board, BoardView, find_board, rows_alike
from livedeform.stereo_node.detect.blobs import Blobs, detect_blobs
from livedeform.stereo_node.detect.picture import Picture, noise_level
from livedeform.stereo_node.detect.settings import DetectorSettings
from livedeform.stereo_node.detect.tags.fit import tag_middles

DEFAULT_DICTIONARY = {"aruco": "DICT_4X4_250", "apriltag": "DICT_APRILTAG_36h11"}
BOARDS = {"circle_grid": "circles", "checkerboard": "checkerboard"}
CORNER_SIGMA_PX = 0.05  # of a board's corner, from published pictures (0.01 on rendered ones: real boards are not flat)
SUBPIX_WINDOW = 4


def detect_markers(picture: Picture, settings: DetectorSettings, noise: float | None = None) -> Blobs:
    """Detect all markers of a grey picture (h, w) by the detector that ``settings.type`` names."""
    if settings.type == "blob":
        return detect_blobs(picture, settings, noise)
    if settings.type in DEFAULT_DICTIONARY:
        noise = noise_level(picture) if noise is None else noise
        return _tags(picture, settings.dictionary or DEFAULT_DICTIONARY[settings.type], noise)
    return _board_points(picture, settings)


@lru_cache(maxsize=8)
def _tag_detector(dictionary: str) -> Any:
    if not hasattr(cv2.aruco, dictionary):
        raise InputError(
            f"unknown dictionary '{dictionary}'",
            where="stereo.detector.dictionary",
            remedy="name one of OpenCV's, e.g. DICT_4X4_50",
        )
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = SUBPIX_WINDOW
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)), parameters)


def _tags(picture: Picture, dictionary: str, noise: float) -> Blobs:
    corners, ids, _ = _tag_detector(dictionary).detectMarkers(picture)
    if ids is None or not len(ids):
        return _coded(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, np.int64))
    quads = np.array([c.reshape(4, 2) for c in corners], float)
    names, counts = np.unique(ids.ravel(), return_counts=True)
    once = np.isin(ids.ravel(), names[counts == 1])  # a code that is there twice says nothing
    quads, codes = quads[once], ids.ravel()[once].astype(np.int64)
    centres, covariances = tag_middles(picture, quads, _modules(dictionary, codes), noise)
    seen = np.isfinite(centres[:, 0])
    quads, codes, centres, covariances = quads[seen], codes[seen], centres[seen], covariances[seen]
    size = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2).mean(axis=1) / 2
    return _coded(centres, covariances, size, codes)


def _modules(dictionary: str, codes: NDArray[np.int64]) -> Array:
    """Return the modules (n, m, m) of the tags ``codes`` (n,) with their border, 1 white and 0 black."""
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    m = known.markerSize + 2
    return np.array([known.generateImageMarker(int(code), m) > 0 for code in codes], float).reshape(-1, m, m)


def counted_as_left(left: Blobs, right: Blobs, settings: DetectorSettings) -> Blobs:
    """Return the ``right`` picture's points counted from the end from which the ``left`` one's are, where the markers
    are a board; others as they are."""
    if settings.type not in BOARDS or left.codes is None or right.codes is None or not len(left) or not len(right):
        return right
    here, there = BoardView(right.codes, right.centres), BoardView(left.codes, left.centres)
    return replace(right, codes=rows_alike(here, there, _board(settings)))


def codes_alike(codes: Any, settings: DetectorSettings) -> Sequence[Any]:
    """Return ``codes`` (n,) in every way of counting that looks alike in pictures, as they are first; of a board also
    as if it was counted from behind, which markers.csv may do."""
    if settings.type not in BOARDS:
        return [codes]
    board = _board(settings)
    return [turn[codes] for turn in (*board.turns, *board.mirrored)]


def _board(settings: DetectorSettings) -> Board:
    match = re.fullmatch(r"(\d+)x(\d+)", settings.board)
    if match is None:
        raise InputError(
            f"the detector '{settings.type}' needs the board's size",
            where="stereo.detector.board",
            remedy="give columns x rows, as 9x6",
        )
    return Board(BOARDS[settings.type], int(match[1]), int(match[2]), 0.01)  # type: ignore[arg-type]


def _board_points(picture: Picture, settings: DetectorSettings) -> Blobs:
    view = find_board(picture, _board(settings))
    if view is None:
        return _coded(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, np.int64))
    n = len(view.rows)
    return _coded(view.pixels, np.tile(np.eye(2) * CORNER_SIGMA_PX**2, (n, 1, 1)), np.full(n, 5.0), view.rows)


def _coded(centres: Array, covariances: Array, radii: Array, codes: Any) -> Blobs:
    n = len(centres)
    shapes = np.eye(2)[None] / np.maximum(radii, 1e-6)[:, None, None]
    return Blobs(centres, covariances, shapes, np.full(n, -100.0), np.ones(n), np.ones(n), None, {}, codes)
