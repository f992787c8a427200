"""Calibration boards and how their points are found in pictures, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import CalibrationError
from livedeform.common.types import Array
from livedeform.stereo_node.boards.corner_fit import REACH, fit_corners
from livedeform.stereo_node.boards.lattice import fitting, predict
from livedeform.stereo_node.detect.blob_fit import fit_blobs, start_parameters
from livedeform.stereo_node.detect.picture import Picture, noise_level

__all__ = [
    "Board", "BoardView", "Pair", "charuco_corners", "counted_alike", "find_board", "find_markers", "refine_corners",
    "rows_alike",
]  # fmt: skip

Kind = Literal["checkerboard", "circles", "acircles", "charuco"]
FEWEST_CORNERS = 6
LEAST_SHARE = 0.5  # of a checkerboard's corners
UNCERTAIN, UNCERTAIN_PX = 4.0, 0.1  # times the view's median sigma; px
MIN_SQUARE, MAX_SQUARE = 5e-4, 0.5  # m; outside, the length was given in another unit


@dataclass(frozen=True)
class Board:
    """A flat board.

    ``columns`` x ``rows`` are inner corners (checkerboard), circles, or squares (ChArUco); ``square`` m is the distance
    of neighbours (asymmetric circles: the diagonal neighbours lie (square, square) apart in x and y).
    """

    kind: Kind
    columns: int
    rows: int
    square: float
    marker: float = 0.0  # m, side of a ChArUco marker
    dictionary: str = "DICT_4X4_50"
    option: str = "--square"  # where an error about the length points to

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3:
            raise CalibrationError(
                f"a board of {self.columns}x{self.rows} is too small",
                where="--board",
                remedy="give inner corners, e.g. 9x6",
            )
        if not MIN_SQUARE <= self.square <= MAX_SQUARE:
            unit = "millimetres" if self.square > MAX_SQUARE else "kilometres"
            raise CalibrationError(
                f"a square of {self.square:g} m is not plausible",
                where=self.option,
                remedy=f"give metres (0.025 for 25 mm); it seems to be in {unit}"
                if 0 < self.square < np.inf
                else "give its length in metres",
            )
        if self.kind == "charuco":
            self._check_markers()

    def _check_markers(self) -> None:
        """Raise ``CalibrationError`` for ChArUco markers that do not fit into their squares, or are of no dictionary of
        OpenCV's."""
        if self.marker and not 0 < self.marker < self.square:  # false for NaN
            in_mm = 0.1 * self.square < 1e-3 * self.marker < self.square
            unit = "; it seems to be in millimetres" if in_mm else ""
            raise CalibrationError(
                f"a marker of {self.marker:g} m does not fit into a square of {self.square:g} m",
                where="--marker",
                remedy=f"give the side of a marker in metres, less than the square{unit}",
            )
        if not (self.dictionary.startswith("DICT_") and hasattr(cv2.aruco, self.dictionary)):
            raise CalibrationError(
                f"unknown dictionary '{self.dictionary}'",
                where="--dictionary",
                remedy="name one of OpenCV's, e.g. DICT_4X4_50",
            )

    @property
    def oriented(self) -> bool:
        """Return whether the board's colours tell its first point from its last one."""
        if self.kind == "checkerboard":
            return (self.columns + self.rows) % 2 == 1
        return self.kind == "charuco" or (self.kind == "acircles" and self.rows % 2 == 1)

    @property
    def turns(self) -> list[NDArray[np.int64]]:
        """Return the ways (n,) of counting its points that look alike, the first one as they are counted: by half
        turns where no colour tells the board's ends, and by quarter turns where it has as many columns as rows."""
        if self.oriented:
            return [np.arange(len(self.points), dtype=np.int64)]
        grid = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        quarters = (1, 3) if self.columns == self.rows and self.kind != "acircles" else ()
        return [np.rot90(grid, k).ravel() for k in (0, 2, *quarters)]

    @property
    def mirrored(self) -> list[NDArray[np.int64]]:
        """Return the ways (n,) of counting a checkerboard's or circles' points as seen from behind, as `turns` does
        from the front; where the colours tell the ends, from the same end."""
        grid = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        if self.oriented:  # the first cell stays the dark one where the lines that are turned round are even
            return [(grid[::-1] if self.rows % 2 == 0 else grid[:, ::-1]).ravel()]
        return [grid[::-1].ravel()[turn] for turn in self.turns]

    @property
    def points(self) -> Array:
        """(n, 3) m, z = 0: all points of the board, row by row."""
        columns, rows = (self.columns - 1, self.rows - 1) if self.kind == "charuco" else (self.columns, self.rows)
        j, i = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
        if self.kind == "acircles":
            x, y = (2 * i + j % 2) * self.square, j * self.square
        else:
            x, y = i * self.square, j * self.square
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(float)

    def charuco(self) -> Any:
        """Return OpenCV's ChArUco board."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square, self.marker or 0.7 * self.square, dictionary
        )


@dataclass(frozen=True)
class BoardView:
    """Points of a board in one picture: ``rows`` (n,) into ``Board.points`` and ``pixels`` (n, 2); of circles the
    outlines' ``shapes`` (n, 2, 2) 1/px as ``detect.Blobs.shapes``."""

    rows: NDArray[np.int64]
    pixels: Array
    shapes: Array | None = None


@dataclass(frozen=True)
class Pair:
    """A board seen by both cameras."""

    name: str
    left: BoardView
    right: BoardView


def find_board(picture: Picture, board: Board) -> BoardView | None:
    """Return the board's points in a grey picture (h, w), or None where it is not (wholly; ChArUco: partly) in view."""
    if board.kind == "charuco":
        return _find_charuco(picture, board)
    size = (board.columns, board.rows)
    if board.kind == "checkerboard":
        return _find_corners(picture, board, size)
    return _find_circles(picture, board, size)


def rows_alike(view: BoardView, other: BoardView, board: Board) -> NDArray[np.int64]:
    """Return the rows (n,) of ``view`` counted from the same end as those of ``other``, another camera's view at the
    same moment, where colours do not tell the board's ends: by the way that is turned least in the picture."""
    place = np.full((len(board.points), 2), np.nan)
    place[other.rows] = other.pixels - other.pixels.mean(axis=0)
    here = view.pixels - view.pixels.mean(axis=0)
    along = [float(np.nansum(place[turn[view.rows]] * here)) for turn in board.turns]
    return board.turns[int(np.argmax(along))][view.rows]


def counted_alike(view: BoardView, other: BoardView, board: Board) -> BoardView:
    """Return ``view`` with its `rows_alike` in order."""
    rows = rows_alike(view, other, board)
    order = np.argsort(rows)
    return BoardView(rows[order], view.pixels[order], None if view.shapes is None else view.shapes[order])


def _find_corners(picture: Picture, board: Board, size: tuple[int, int]) -> BoardView | None:
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(picture, size, flags=flags | cv2.CALIB_CB_FAST_CHECK)
    if not found:  # each finds some boards that the other misses; the corners are fitted afterwards in any case
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        found, corners = cv2.findChessboardCornersSB(picture, size, flags=flags)
    if not found:
        return None
    grid = corners.reshape(size[1], size[0], 2).astype(float)
    middle = grid[:2, :2].mean(axis=(0, 1)), grid[:2, 1:3].mean(axis=(0, 1))
    first, second = (
        picture[int(np.clip(y, 0, picture.shape[0] - 1)), int(np.clip(x, 0, picture.shape[1] - 1))] for x, y in middle
    )
    if (
        board.oriented and first > second
    ):  # the first cell is the dark one, so that every picture counts from the same end
        grid = grid[::-1, ::-1]
    pixels = refine_corners(picture, grid.reshape(-1, 2), size)
    view = fit_on_lattice(picture, board, np.arange(len(pixels)), pixels)
    return view if view is not None and len(view.rows) >= LEAST_SHARE * len(pixels) else None


def fit_on_lattice(
    picture: Picture, board: Board, rows: NDArray[np.int64], pixels: Array, clear: float = 1.0
) -> BoardView | None:
    """Fit corners, found near ``pixels`` (n, 2), as two crossing edges each; leave out what is no corner.

    A corner whose fit runs away, is far less certain than the others, or lies beside where its neighbours say, is
    tried once more from there, and dropped if that fails too. ``clear``: share of the distance to the next corner
    within which there are no other edges. None where fewer than ``FEWEST_CORNERS`` remain.
    """
    steps = board.points[rows, :2] / board.square
    good = fitting(steps, pixels, np.ones(len(rows), bool))
    if good.sum() < FEWEST_CORNERS:
        return None
    pixels = pixels.copy()
    keep = np.zeros(len(rows), bool)
    typical = np.nan
    for attempt in range(2):
        lattice = predict(steps, pixels, good)
        trial = ~keep & np.isfinite(lattice.places).all(axis=1)
        pixels = np.where((trial & ~good)[:, None], lattice.places, pixels)
        trial &= _inside(picture, pixels)
        if not trial.any():
            break
        reach = clear * lattice.spacing[trial]
        first, second = (d[trial] for d in lattice.directions)
        fitted, covariance = fit_corners(picture, pixels[trial], first, second, reach)
        sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
        typical = float(np.nanmedian(sigma)) if attempt == 0 and np.isfinite(sigma).any() else typical
        certain = sigma < max(UNCERTAIN * typical, UNCERTAIN_PX)  # false for NaN
        at = np.flatnonzero(trial)[certain]
        pixels[at], keep[at] = fitted[certain], True
        keep = fitting(steps, pixels, keep)
        good = keep
        if keep.all() or keep.sum() < FEWEST_CORNERS:
            break
    return BoardView(rows[keep], pixels[keep]) if keep.sum() >= FEWEST_CORNERS else None


def _inside(picture: Picture, pixels: Array) -> NDArray[np.bool_]:
    """Tell which pixels (n, 2) lie in the picture, with a margin of two."""
    h, w = picture.shape
    return np.asarray(((pixels >= 2) & (pixels <= [w - 3, h - 3])).all(axis=1))


def _find_circles(picture: Picture, board: Board, size: tuple[int, int]) -> BoardView | None:
    flags = cv2.CALIB_CB_SYMMETRIC_GRID if board.kind == "circles" else cv2.CALIB_CB_ASYMMETRIC_GRID
    for shown in (picture, cv2.bitwise_not(picture)):
        parameters = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]
        parameters.minArea, parameters.maxArea = 12.0, picture.size / (4.0 * size[0] * size[1])
        detector = cv2.SimpleBlobDetector_create(parameters)  # type: ignore[attr-defined]
        for extra in (0, cv2.CALIB_CB_CLUSTERING):
            found, centres = cv2.findCirclesGrid(shown, size, flags=flags | extra, blobDetector=detector)
            if found:
                grid = centres.reshape(size[1], size[0], 2).astype(float)
                return _fit_circles(picture, _not_mirrored(grid).reshape(-1, 2))
    return None


def _not_mirrored(grid: Array) -> Array:
    """Return places (rows, columns, 2) px in an order that a board seen from its front has: OpenCV counts a grid of
    circles in either, and every second row of an asymmetric one of an even number before the one above it."""
    rows = grid.mean(axis=1)
    grid = grid[np.argsort(rows @ (rows[-2:].mean(axis=0) - rows[:2].mean(axis=0)))]
    along, down = (np.diff(grid, axis=axis).mean(axis=(0, 1)) for axis in (1, 0))
    return grid if along[0] * down[1] > along[1] * down[0] else grid[::-1]


def _fit_circles(picture: Picture, centres: Array) -> BoardView | None:
    """Return centres and shapes of the blurred ellipses that fit best, from rough centres."""
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    spacing = distance.min(axis=1)
    at = np.round(centres).astype(int)
    inside = picture[at[:, 1], at[:, 0]].astype(float)
    around = np.array(
        [
            np.median(
                picture[
                    max(y - int(s / 2), 0) : y + int(s / 2) + 1,
                    [max(x - int(s / 2), 0), min(x + int(s / 2), picture.shape[1] - 1)],
                ]
            )
            for (x, y), s in zip(at, spacing, strict=True)
        ]
    )
    start = start_parameters(centres, spacing / 4, around, inside - around)
    fit = fit_blobs(picture, start, 2.0, 0.5 * noise_level(picture), 40)
    if (fit[:, 15] <= 0).any() or (np.abs(fit[:, :2] - centres).max(axis=1) > spacing / 4).any():
        return None
    return BoardView(np.arange(len(fit)), fit[:, :2].copy(), fit[:, [2, 3, 3, 4]].reshape(-1, 2, 2))


def _find_charuco(picture: Picture, board: Board) -> BoardView | None:
    rough = charuco_corners(picture, board, *find_markers(picture, board))
    if rough is None:
        return None
    rows, pixels = rough
    share = (board.marker or 0.7 * board.square) / board.square
    # a marker's corner lies (1 - share) / 2 of a square beside a corner, along both sides
    return fit_on_lattice(picture, board, rows, pixels, min(np.sqrt(2) * (1 - share) / 2 / REACH, 1.0))


def find_markers(picture: Picture, board: Board) -> tuple[Any, Any]:
    """Return corners and numbers of the markers of the board's dictionary, as OpenCV gives them."""
    corners, ids, _ = cv2.aruco.ArucoDetector(board.charuco().getDictionary()).detectMarkers(picture)
    return corners, ids


def charuco_corners(picture: Picture, board: Board, markers: Any, ids: Any) -> tuple[NDArray[np.int64], Array] | None:
    """Return rows into the board's points and rough pixels (n, 2) of the corners beside the ``markers``.

    None where there are too few, or all on one line.
    """
    if ids is None or len(ids) == 0:
        return None
    parameters = cv2.aruco.CharucoParameters()
    parameters.checkMarkers = False  # it refuses the whole picture for one corner that is wrong
    detector = cv2.aruco.CharucoDetector(board.charuco(), parameters)
    corners, ids, _, _ = detector.detectBoard(picture, markerCorners=markers, markerIds=ids)
    if ids is None or len(ids) < FEWEST_CORNERS:
        return None
    order = np.argsort(ids.ravel())
    rows, pixels = ids.ravel()[order].astype(np.int64), corners.reshape(-1, 2)[order].astype(float)
    places = board.points[rows, :2]
    if np.linalg.matrix_rank(places - places.mean(axis=0), tol=1e-6) < 2:
        return None
    return rows, pixels


def refine_corners(picture: Picture, corners: Array, size: tuple[int, int]) -> Array:
    """Refine checkerboard corners (n, 2) by OpenCV's gradient condition in a window that suits their spacing."""
    grid = corners.reshape(size[1], size[0], 2)
    spacing = min(
        np.linalg.norm(np.diff(grid, axis=0), axis=2).min(), np.linalg.norm(np.diff(grid, axis=1), axis=2).min()
    )
    half = int(np.clip(spacing / 4, 2, 11))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    refined = cv2.cornerSubPix(picture, corners.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), criteria)
    return refined.reshape(-1, 2).astype(float)
