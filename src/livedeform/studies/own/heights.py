"""Heights of one's own phantom with their uncertainty (thesis, 2.2 and 2.4): from markers of a recording, or from
points that were picked in a pair of pictures."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError
from livedeform.common.types import Array, MarkerFrame
from livedeform.stereo_node.camera.calibration_file import read_camera
from livedeform.stereo_node.camera.calibration_uncertainty import calibration_uncertainty, read_bundle
from livedeform.stereo_node.camera.heights import Height, height, plane_height
from livedeform.stereo_node.camera.rig import StereoRig
from livedeform.stereo_node.camera.triangulate import triangulate

COLUMNS = ("kind", "u_left", "v_left", "u_right", "v_right")
PICK_SIGMA = 0.5  # px, of a point that a hand picked


@dataclass(frozen=True)
class OwnHeights:
    """``how`` they were measured; ``seconds`` (n,) from the first one; ``values``; whether the calibration's own part
    is in their sigmas."""

    how: str
    seconds: Array
    values: tuple[Height, ...]
    with_calibration: bool


def read_own(bag: Path | None, top: str, bottom: str, picks: Path | None, cameras: Path | None, up: str) -> OwnHeights:
    """Measure the heights that the command line names; raises InputError where it names too little."""
    if picks is not None:
        if cameras is None:
            raise InputError("the cameras are not known", where="--cameras", remedy="name a calibration's folder")
        return of_picks(picks, cameras, parse_up(up))
    if bag is None or not top or not bottom:
        raise InputError(
            "the markers are not named",
            where="--bag, --top, --bottom",
            remedy="give all three, or --picks and --cameras",
        )
    return of_markers(bag, parse_ids(top, "--top"), parse_ids(bottom, "--bottom"), parse_up(up), cameras)


def parse_ids(text: str, option: str) -> list[int]:
    """Marker numbers of "5,6,7"."""
    try:
        return [int(word) for word in text.split(",")]
    except ValueError as error:
        raise InputError(f"'{text}' is not a list of marker numbers", where=option, remedy="write 5,6,7") from error


def parse_up(text: str) -> Array | None:
    """A direction of "0,0,1"; None of an empty text."""
    if not text:
        return None
    try:
        up = np.array([float(word) for word in text.split(",")])
    except ValueError:
        up = np.zeros(0)
    if up.shape != (3,) or not np.linalg.norm(up) > 0:
        raise InputError(f"'{text}' is no direction", where="--up", remedy="write three numbers: 0,0,1")
    return up


def of_markers(
    bag: Path, top: Sequence[int], bottom: Sequence[int], up: Array | None = None, cameras: Path | None = None
) -> OwnHeights:
    """Measure the height in every frame in which all the markers are.

    It is that of the mean of ``top`` above the plane through ``bottom``, if these are three or more and ``up`` is not
    given, or else above their mean along ``up`` (default: the phantom's z).
    """
    frames = [f for f in load_recording(bag).marker_frames if np.isin([*top, *bottom], f.ids).all()]
    if not frames:
        raise InputError(
            f"no frame shows the markers {', '.join(map(str, [*top, *bottom]))} together",
            where=str(bag),
            remedy="give a run's run.mcap, or a recording with /stereo/markers, and markers that are seen",
        )
    _, scale = _scale(cameras)
    values = [_of(*_rows(f, top), *_rows(f, bottom), up, scale) for f in frames]
    stamps = np.array([f.stamp_ns for f in frames], float)
    plane = up is None and len(bottom) >= 3
    how = f"markers {_list(top)} above {'the plane through' if plane else 'the mean of'} {_list(bottom)}"
    return OwnHeights(how, (stamps - stamps[0]) * 1e-9, tuple(values), scale > 0)


def of_picks(picks: Path, cameras: Path, up: Array | None = None) -> OwnHeights:
    """Measure the height of points picked in a pair of pictures.

    ``picks`` is a CSV file with ``COLUMNS``, kind top or bottom, pixels from 0.
    """
    rig, _ = _scale(cameras)
    assert rig is not None
    kinds, pixels = _read_picks(picks)
    bottom = kinds == "bottom"
    if not bottom.any() or bottom.all():
        raise InputError("needs points of kind top and of kind bottom", where=str(picks), remedy="pick some of each")
    if up is None and bottom.sum() < 3:
        raise InputError(
            "the direction of the height is not known",
            where=str(picks),
            remedy="pick three bottom points or more, or give --up in the left camera's frame (0,-1,0 for its up)",
        )
    measured = triangulate(rig, pixels[:, :2], pixels[:, 2:], sigma_px=PICK_SIGMA)
    bundle = read_bundle(cameras / "left.yaml", rig)
    scale = 0.0 if bundle is None else calibration_uncertainty(bundle, rig, measured.points).of_lengths
    X, C = measured.points, measured.covariances
    value = _of(X[~bottom], C[~bottom], X[bottom], C[bottom], up, scale)
    how = f"{(~bottom).sum()} picked points above {bottom.sum()}, each known to {PICK_SIGMA} px"
    return OwnHeights(how, np.zeros(1), (value,), bundle is not None)


def _of(top: Array, top_cov: Array, bottom: Array, bottom_cov: Array, up: Array | None, scale: float) -> Height:
    if up is None and len(bottom) >= 3:
        return plane_height(top.mean(axis=0), bottom, top_cov.sum(axis=0) / len(top) ** 2, bottom_cov, scale)
    return height(top, bottom, np.array([0.0, 0.0, 1.0]) if up is None else up, top_cov, bottom_cov, scale)


def _rows(frame: MarkerFrame, ids: Sequence[int]) -> tuple[Array, Array]:
    rows = [int(np.flatnonzero(frame.ids == i)[0]) for i in ids]
    return frame.points[rows], frame.covariances[rows]


def _scale(cameras: Path | None) -> tuple[StereoRig | None, float]:
    """The rig of a calibration's folder, and how well it knows lengths of 0.1 m half a metre away (relative)."""
    if cameras is None:
        return None, 0.0
    rig = StereoRig(read_camera(cameras / "left.yaml"), read_camera(cameras / "right.yaml"))
    bundle = read_bundle(cameras / "left.yaml", rig)
    if bundle is None:
        return rig, 0.0
    near = np.array([[x, y, 0.5 + z] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
    return rig, calibration_uncertainty(bundle, rig, near).of_lengths


def _read_picks(path: Path) -> tuple[Array, Array]:
    try:
        rows = list(csv.DictReader(path.read_text().splitlines()))
        kinds = np.array([row["kind"].strip() for row in rows])
        pixels = np.array([[float(row[c]) for c in COLUMNS[1:]] for row in rows])
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror})", where=str(path), remedy="give a CSV file with --picks"
        ) from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"is not a table of {', '.join(COLUMNS)}", where=str(path), remedy="one row per point, pixels from 0"
        ) from error
    if not np.isin(kinds, ("top", "bottom")).all():
        raise InputError("a kind is neither top nor bottom", where=str(path), remedy="write top or bottom")
    return kinds, pixels.reshape(-1, 4)


def _list(ids: Sequence[int]) -> str:
    return ", ".join(map(str, ids))
